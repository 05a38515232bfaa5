"""Config sections: each key is defined once, with type, range, default and meaning. `config.loading` reads configs."""

from vjepa2_ac.config.data import DataConfig, DiskCacheConfig, IdleConfig
from vjepa2_ac.config.model import (
    AdapterConfig,
    EncoderConfig,
    EncoderSizes,
    ModelConfig,
    ModelSizes,
    PredictorSizes,
    SizesConfig,
)
from vjepa2_ac.config.planning import LimitsConfig, PlanningConfig
from vjepa2_ac.config.run import Config, ReplayConfig
from vjepa2_ac.config.section import Section
from vjepa2_ac.config.sources import LeRobotData, LeRobotFields, RawDroidData, RldsData, RldsFields
from vjepa2_ac.config.training import CheckpointConfig, DecoderConfig, TrackingConfig, TrainingConfig, ValidationConfig
