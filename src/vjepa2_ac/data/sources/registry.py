"""The registry of sources: which class reads which form of data."""

from __future__ import annotations

from vjepa2_ac.config import DataConfig
from vjepa2_ac.episode import EpisodeSource


def open_source(config: DataConfig) -> EpisodeSource:
    """Return the source that `data.source` names; nothing is read yet."""
    if config.source == "rlds":
        from vjepa2_ac.data.sources.rlds.source import RldsSource

        return RldsSource(config)
    if config.source == "droid_raw":
        from vjepa2_ac.data.sources.droid_raw.source import RawDroidSource

        return RawDroidSource(config)
    if config.source == "lerobot":
        from vjepa2_ac.data.sources.lerobot.source import LeRobotSource

        return LeRobotSource(config)
    if config.source == "latents":
        from vjepa2_ac.data.sources.latents.source import LatentSource

        return LatentSource(config)
    from vjepa2_ac.data.sources.npz.source import NpzSource

    return NpzSource(config)
