"""Figures are the subject here."""

import pytest


@pytest.fixture(autouse=True)
def _drawn(drawn: None) -> None:
    """Each test draws."""
