"""Make the data sets, base models and randomly initialised predictors that cells need."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
from environments import TASKS, data_of, record
from methods import SHIFTS, TRAINING, Base

from vjepa2_ac import encode, read_clips
from vjepa2_ac.config import Config, DataConfig, ModelConfig, RldsData
from vjepa2_ac.config.data import Split
from vjepa2_ac.config.loading import load_config
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.encoding.encode_dataset import encode_config, use_finished_cache
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.export import export_run
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.simulation.domains import DOMAIN_A
from vjepa2_ac.simulation.record import RecordingSpec, record_dataset
from vjepa2_ac.training.loop import train

BUILTIN = "builtin:sim-tiny"
EPISODES_A, EPISODES_SHIFTED = 400, 100
BASE_EPISODES, BASE_SEED = 800, 3  # the training data of the base model, as in the comment of configs/demo_base.yaml
SEED_A, SEED_SHIFTED = 11, 21  # seeds of recordings, which differ from those of the demo and its base model
TRAINING_OPTIONS = (
    "training.steps=4000", "training.learning_rate=4e-3", "training.warmup_steps=50", "training.allow_weak_base=true",
)  # fmt: skip
"""Training options of the base model of a third-party environment, as in `configs/pick.yaml`."""
BASE_CONFIG = "builtin:demo_base"  # the sizes and settings of the demo's base model


def data_a(folder: Path) -> DataConfig:
    """Return the data of domain A, on which the one-camera base model is trained."""
    return RldsData(
        path=str(folder / "data-A"),
        frames=4,
        stride=4,
        validation_share=0.05,
        test_share=0.05,
        workers=0,
        cache="auto",
        cache_dir=str(folder / "latents"),
    )


def base_data(folder: Path) -> DataConfig:
    """Return the training data of the built-in base model."""
    return data_a(folder).model_copy(update={"path": str(folder / "data-base")})


def prepare_base_data(folder: Path, workers: int) -> None:
    """Record and encode the training data of the built-in base model, if missing."""
    data = base_data(folder)
    if not Path(data.path).exists():
        record_dataset(data.path, RecordingSpec("random", seed=BASE_SEED), episodes=BASE_EPISODES, workers=workers)
    cache_latents(data, BUILTIN)


def data_before(folder: Path, shift: str) -> DataConfig:
    """Return the data on which the one-camera base model was trained, before a domain shift."""
    return data_a(folder) if shift in SHIFTS else data_of(folder, shift, "before")


def data_shifted(folder: Path, shift: str) -> DataConfig:
    """Return the data of a shifted domain: half of the episodes are for training, the others are held out."""
    if shift not in SHIFTS:
        return data_of(folder, shift, "after")
    update = {"path": str(folder / f"data-{shift}"), "validation_share": 0.12, "test_share": 0.35}
    return data_a(folder).model_copy(update=update)


def base_model(folder: Path, base: Base, seed: int, shift: str = "look") -> str:
    """Return the value of `model.base` for a base model, or for a predictor with random weights."""
    if base == "many cameras":
        return BUILTIN
    one_camera = "base-one-camera" if shift in SHIFTS else f"base-{shift}"
    return str(folder / (f"scratch-{seed}" if base == "none" else one_camera))


def prepare_world(folder: Path, task: str, reporter: Reporter = SILENT) -> None:
    """Make the inputs of a third-party task: demonstrations before and after the change, and a base model."""
    for when in ("before", "after"):
        record(folder, task, when)
        cache_latents(data_of(folder, task, when), BUILTIN)  # all models have this encoder
    base = Path(base_model(folder, "one camera", 0, task))
    if not base.exists():
        config = load_config(BASE_CONFIG, [f"run_dir={folder / f'run-{base.name}'}", *TRAINING_OPTIONS])
        model = config.model.with_base(BUILTIN)  # pre-trained on the simulated arm
        config = config.model_copy(update={"data": data_of(folder, task, "before"), "model": model})
        export_run(train(config, reporter), base)


def prepare_shifts(folder: Path, shifts: Collection[str], seeds: int, reporter: Reporter = SILENT) -> None:
    """Make all missing inputs. For the simulated arm this takes about 25 minutes on one core."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed in range(seeds):
        _save_fresh_predictor(Path(base_model(folder, "none", seed)), seed)
    for task in filter(TASKS.__contains__, shifts):
        prepare_world(folder, task, reporter)
    if not any(shift in SHIFTS for shift in shifts):
        return
    _record(data_a(folder), "A", EPISODES_A, SEED_A)
    for shift in SHIFTS:
        _record(data_shifted(folder, shift), shift, EPISODES_SHIFTED, SEED_SHIFTED)
    if not Path(base_model(folder, "one camera", 0)).exists():
        config = load_config(BASE_CONFIG, [f"run_dir={folder / 'run-base'}"])
        run = train(config.model_copy(update={"data": data_a(folder)}), reporter)
        export_run(run, Path(base_model(folder, "one camera", 0)))
    for data in (data_a(folder), *(data_shifted(folder, shift) for shift in SHIFTS)):
        for base in ("one camera", "many cameras"):
            cache_latents(data, base_model(folder, base, 0))


def cache_latents(data: DataConfig, base: str) -> None:
    """Encode all episodes that are not cached; each cell uses a different subset of them."""
    model = ModelConfig(base=base, dtype="float32")
    encode_config(Config(run_dir="none", data=data, model=model, training=TRAINING))


def encode_clips(config: Config, model: WorldModel, split: Split, clips: int) -> list[LatentBatch]:
    """Return clips of a split, from the latents that training used."""
    dataset = use_finished_cache(config, open_dataset(config.data), model)
    return [encode(model, batch, chunk=64) for batch in read_clips(dataset, split, clips=clips, batch_size=32)]


def exclude_episodes(data: DataConfig, count: int, seed: int) -> tuple[str, ...]:
    """Return the training episodes to *exclude* so that `count` remain, drawn by the seed.

    Raises:
        ValueError: There are fewer than `count` training episodes.
    """
    dataset = open_dataset(data)
    names = [dataset.table.identity(int(number)) for number in np.flatnonzero(dataset.split_mask("train"))]
    if len(names) < count:
        raise ValueError(f"{data.path} has {len(names)} training episodes, not {count}")
    order = np.random.default_rng([seed, 77]).permutation(len(names))
    return tuple(sorted(names[index] for index in order[count:]))


def _record(data: DataConfig, domain: str, episodes: int, seed: int) -> None:
    if not Path(data.path).exists():
        record_dataset(data.path, RecordingSpec(SHIFTS.get(domain, DOMAIN_A), seed=seed), episodes=episodes)


def _save_fresh_predictor(folder: Path, seed: int) -> None:
    """Write the shared frozen encoder with a randomly initialised predictor, which starts close to persistence."""
    if not folder.exists():
        model = load_base(ModelConfig(base=BUILTIN, dtype="float32"), seed=0)
        model.predictor = WorldModel.random(model.sizes, seed=1000 + seed, near_persistence=True).predictor
        model.save_pretrained(folder)
