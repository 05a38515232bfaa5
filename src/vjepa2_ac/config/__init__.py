"""Config knobs: each is defined once, with type, range, default and meaning. `config.loading` reads them."""

from vjepa2_ac.config.data import AugmentConfig, DataConfig, DiskCacheConfig, IdleConfig
from vjepa2_ac.config.decoder import DecoderConfig
from vjepa2_ac.config.model import AdapterConfig, EncoderConfig, EncoderSizes, ModelConfig, ModelSizes, PredictorSizes
from vjepa2_ac.config.planning import EnergyConfig, LimitsConfig, PlanningConfig
from vjepa2_ac.config.replay import ReplayConfig
from vjepa2_ac.config.run import Config
from vjepa2_ac.config.section import Section
from vjepa2_ac.config.sources import (
    LatentsData,
    LeRobotData,
    LeRobotFields,
    NpzData,
    RawDroidData,
    RawDroidOptions,
    RldsData,
    RldsFields,
)
from vjepa2_ac.config.training import CheckpointConfig, TrackingConfig, TrainingConfig, ValidationConfig

__all__ = [
    "AdapterConfig", "AugmentConfig", "CheckpointConfig", "Config", "DataConfig", "DecoderConfig", "DiskCacheConfig",
    "EncoderConfig", "EncoderSizes", "EnergyConfig", "IdleConfig", "LatentsData", "LeRobotData", "LeRobotFields",
    "LimitsConfig", "ModelConfig", "ModelSizes", "NpzData", "PlanningConfig", "PredictorSizes",
    "RawDroidData", "RawDroidOptions", "ReplayConfig", "RldsData", "RldsFields", "Section", "TrackingConfig",
    "TrainingConfig", "ValidationConfig",
]  # fmt: skip
