"""The registry of sources: each form of data names the class that reads it."""

from __future__ import annotations

import importlib

from vjepa2_ac.config import DataConfig
from vjepa2_ac.episode import EpisodeSource


def open_source(config: DataConfig) -> EpisodeSource:
    """Return the source of the data; nothing is read yet, and no other form's libraries are imported."""
    module, _, name = config.reader.partition(":")
    source: EpisodeSource = getattr(importlib.import_module(module), name)(config)
    return source
