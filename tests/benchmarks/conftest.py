"""The fixture `load`, which imports a benchmark, for all tests of this folder."""

from benches import load  # noqa: F401 - a fixture
