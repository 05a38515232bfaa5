"""Fixture: an existing bucket, for the tests of the mirror."""

import pytest

from gcs import Gcs


@pytest.fixture
def bucket(gcs: Gcs) -> Gcs:
    gcs.put("bucket/other", b"1")
    gcs.forget()
    return gcs
