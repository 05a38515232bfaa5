"""Every test of a benchmark loads it."""

from benches import load  # noqa: F401 - a fixture
