"""Run config: the sections that make up a complete run."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field, model_validator

from vjepa2_ac import places
from vjepa2_ac.config.data import DataConfig
from vjepa2_ac.config.decoder import DecoderConfig
from vjepa2_ac.config.model import AdapterConfig, ModelConfig
from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.config.replay import ReplayConfig
from vjepa2_ac.config.section import Affects, Section
from vjepa2_ac.config.sources import RldsData  # noqa: F401 - all forms of data
from vjepa2_ac.config.training import CheckpointConfig, TrackingConfig, TrainingConfig, ValidationConfig


def _run_folder(path: str) -> str:
    try:
        return places.on_this_machine(path)
    except ValueError as error:
        if not places.is_url(path):
            raise
        raise ValueError(f"{error}; to keep a copy there as the run goes, set checkpoint.remote to it") from None


class Config(Section):
    """A complete run."""

    run_dir: Annotated[str, AfterValidator(_run_folder), Affects.NOTHING]
    """Folder of the run, on this machine: resolved config, checkpoints, metrics. `checkpoint.remote` keeps a copy."""
    seed: Annotated[int, Field(ge=0, lt=2**31), Affects.RUN | Affects.PLAN] = 0
    """Decides the order of clips, fresh weights and dropout."""
    plugins: Annotated[tuple[str, ...], Affects.NOTHING] = ()
    """Modules of your own, imported before this config is checked: they register forms of data, losses, planners,
    metrics, energies and trackers (docs/extending.md). Installed packages register theirs without being named."""
    data: DataConfig
    """The data set, and the clips made of it."""
    replay: ReplayConfig | None = None
    """A second data set that a share of the training clips comes from; null: none."""
    model: ModelConfig
    """Which world model to start from."""
    adapter: Annotated[AdapterConfig, Affects.RUN] = AdapterConfig()
    """What is trained."""
    training: Annotated[TrainingConfig, Affects.RUN] = TrainingConfig()
    """How the weights change."""
    validation: Annotated[ValidationConfig, Affects.RUN] = ValidationConfig()
    """Validation before the first step and during training."""
    checkpoint: Annotated[CheckpointConfig, Affects.NOTHING] = CheckpointConfig()
    """Checkpoints, here and elsewhere."""
    tracking: Annotated[TrackingConfig, Affects.NOTHING] = TrackingConfig()
    """Where metrics go."""
    planning: Annotated[PlanningConfig, Affects.PLAN] = PlanningConfig()
    """How a robot is controlled afterwards; training does not use it."""
    decoder: Annotated[DecoderConfig, Affects.NOTHING] = DecoderConfig()
    """The decoder of `vjepa2-ac decoder`; training does not use it."""

    @model_validator(mode="after")
    def _parts_fit(self) -> Config:
        if self.training.rollout_steps >= self.data.frames:
            raise ValueError(
                f"training.rollout_steps {self.training.rollout_steps} needs data.frames of at least"
                f" {self.training.rollout_steps + 1}, not {self.data.frames}"
            )
        if self.model.random is not None and self.adapter.kind == "lora":
            raise ValueError("model.random with adapter.kind lora would adapt noise; set adapter.kind: none")
        if self.training.precision == "fp32" and self.model.dtype != "float32":
            raise ValueError("training.precision fp32 needs model.dtype float32: bfloat16 weights compute in bfloat16")
        if self.training.compile != "off" and self.adapter.kind == "lora" and self.adapter.dora:
            raise ValueError("training.compile blocks cannot trace adapter.dora; set one of them off")
        if self.checkpoint.keep_best == "ranking" and not self.validation.ranking_clips:
            raise ValueError("checkpoint.keep_best ranking needs validation.ranking_clips of 1 or more")
        if self.training.patience is not None and self.checkpoint.keep_best == "off":
            raise ValueError("training.patience waits for a better checkpoint, and checkpoint.keep_best is off")
        sizes = self.model.random or self.model.sizes
        for data in self.data_sets:
            if sizes.predictor.use_extrinsics and not data.has_camera_poses:
                raise ValueError(
                    f"predictor.use_extrinsics needs camera poses, which a data.source of {data.source} does not have"
                )
        return self

    @model_validator(mode="after")
    def _adapter_fits_the_predictor(self) -> Config:
        if self.adapter.kind == "lora" and not (self.model.random or self.model.sizes).predictor.use_states:
            for knob in ("targets", "modules_to_save"):
                if "state_encoder" in getattr(self.adapter, knob):
                    raise ValueError(f"adapter.{knob}: no state_encoder where predictor.use_states is false")
        return self

    @model_validator(mode="after")
    def _replay_fits(self) -> Config:
        if self.replay is not None and (misfits := self.replay.misfits(self.data)):
            raise ValueError("; ".join(misfits))
        return self

    @property
    def data_sets(self) -> tuple[DataConfig, ...]:
        """The data set, and that of `replay` where there is one."""
        return (self.data,) if self.replay is None else (self.data, self.replay.data)

    def for_replay(self) -> Config:
        """Return the config of a run on the data set of `replay` alone.

        Raises:
            ValueError: There is none.
        """
        if self.replay is None:
            raise ValueError("a config without replay")
        return self.model_copy(update={"data": self.replay.data, "replay": None})
