"""What is spoiled, and how is it read? A small valid example of each form, and what a command does with it."""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import mutations
import numpy as np
import torch
from PIL import Image

from evaluation_results import evaluation
from latent_sets import write_cache
from lerobot_sets import recorded, write_v21, write_v30
from recordings import write_raw_droid
from synthetic import draw_frame, synthetic_states, write_synthetic_droid
from vjepa2_ac.config import (
    AdapterConfig,
    DataConfig,
    DiskCacheConfig,
    EncoderSizes,
    ModelSizes,
    PredictorSizes,
    TrainingConfig,
)
from vjepa2_ac.config.loading import config_as_yaml, load_config, parse_config
from vjepa2_ac.data.clips.dataset import open_dataset
from vjepa2_ac.data.filters.idle_ranges import _read_list
from vjepa2_ac.data.sources.droid_raw.source import RawDroidSource
from vjepa2_ac.data.sources.latents.cache_key import CacheKey
from vjepa2_ac.data.sources.latents.source import LatentSource
from vjepa2_ac.data.sources.lerobot.source import LeRobotSource
from vjepa2_ac.data.sources.npz.source import NpzSource
from vjepa2_ac.data.sources.rlds.source import RldsSource
from vjepa2_ac.evaluation.evaluate_run import training_curves
from vjepa2_ac.media.image_file import read_image
from vjepa2_ac.model.adapter.lora import add_adapter, load_trained, save_trained
from vjepa2_ac.model.checkpoints.official import load_official, to_official
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.reports.comparison import compare
from vjepa2_ac.reports.metrics_json import write_metrics
from vjepa2_ac.runs.checkpoint import ADAPTER, OPTIMIZER, RunState, newest_checkpoint, read_state, write_checkpoint
from vjepa2_ac.runs.files import write_manifest, write_torch
from vjepa2_ac.training.optim import make_optimizer, trained_parameters
from vjepa2_ac.training.resume import _read as read_checkpoint

SIZES = ModelSizes(
    image_size=48,
    encoder=EncoderSizes(width=24, depth=1, heads=2, mlp_ratio=2.0),
    predictor=PredictorSizes(width=36, depth=1, heads=3, mlp_ratio=2.0),
)
STEPS = 6
FRAMES = [draw_frame(state, size=(24, 32)) for state in synthetic_states(STEPS)]


@dataclass(frozen=True)
class Reader:
    """A form of file."""

    write: Callable[[Path], None]  # a valid example, into an empty folder
    files: str  # those of it that are spoiled
    read: Callable[[Path], object]
    mutators: tuple[mutations.Mutator, ...]
    reseal: Callable[[Path], None] = lambda _: None  # what stands elsewhere in the folder is made to fit


def _disk_cache() -> DiskCacheConfig:
    return DiskCacheConfig(dir=os.environ["VJEPA2_AC_CACHE"])


# Configs


def _write_config(folder: Path) -> None:
    values = {"run_dir": "r", "data": {"path": "d", "exclude": ["a", "b"]}, "model": {"base": "b.pt"}}
    patterns = {"adapter": {"rank_pattern": {"fc1": 3}}}
    (folder / "config.yaml").write_text(config_as_yaml(parse_config(values | patterns, where="")))


def _read_config(folder: Path) -> None:
    config = load_config(folder / "config.yaml")
    (folder / "again.yaml").write_text(config_as_yaml(config))
    if load_config(folder / "again.yaml") != config:
        raise AssertionError("a config reads back as another")


# Models


@cache
def _base() -> WorldModel:
    return WorldModel.random(SIZES, seed=0)


def _write_adapter(folder: Path) -> None:
    model = WorldModel.random(SIZES, seed=0)
    add_adapter(model, AdapterConfig(rank=2, rank_pattern={"fc1": 3}, modules_to_save=("state_encoder",)), seed=0)
    save_trained(model, folder)


def _read_adapter(folder: Path) -> None:
    load_trained(WorldModel.random(SIZES, seed=0), folder)


def _write_model(folder: Path) -> None:
    _base().save_pretrained(folder / "model")


def _read_model(folder: Path) -> None:
    WorldModel.from_pretrained(folder / "model", torch.float32)


def _write_official(folder: Path) -> None:
    torch.save(to_official(_base()), folder / "official.pt")


def _read_official(folder: Path) -> None:
    load_official(folder / "official.pt", SIZES)


# Runs


def _write_run(folder: Path) -> None:
    model = WorldModel.random(SIZES, seed=0)
    add_adapter(model, AdapterConfig(rank=2), seed=0)
    optimizer = make_optimizer(model, TrainingConfig())
    for parameter in trained_parameters(model):
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()

    def write(inner: Path) -> None:
        save_trained(model, inner / ADAPTER)
        with (inner / OPTIMIZER).open("wb") as file:
            write_torch(optimizer.state_dict(), file)

    state = RunState(
        3, "run", 12, 4, 4, broken={"a": "b"}, windows=9, best_step=3, best_error=0.5, measured_on={"a": "b"}
    )
    write_checkpoint(folder / "checkpoints", state, write, keep=2)


def _reseal_run(folder: Path) -> None:
    checkpoint = next((folder / "checkpoints").glob("step-*"))
    (checkpoint / "manifest.json").unlink()
    write_manifest(checkpoint)


def _read_states(folder: Path) -> None:
    checkpoint = newest_checkpoint(folder / "checkpoints")
    if checkpoint is not None:
        read_state(checkpoint)


def _read_run(folder: Path) -> None:
    checkpoint = newest_checkpoint(folder / "checkpoints")
    model = WorldModel.random(SIZES, seed=0)
    add_adapter(model, AdapterConfig(rank=2), seed=0)
    optimizer = make_optimizer(model, TrainingConfig())
    if checkpoint is None:
        return
    read_checkpoint(checkpoint, model, optimizer)
    for parameter in trained_parameters(model):
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()


def _write_journal(folder: Path) -> None:
    rows = [{"kind": "train", "step": step, "loss": 1.0 / step, "by_horizon": [1.0, None]} for step in range(1, 9)]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


def _write_metrics_of_two(folder: Path) -> None:
    for name in ("a", "b"):
        (folder / name).mkdir()
        write_metrics(evaluation(episodes=3, clips=6), folder / name / "metrics.json")


# Data sets


def _contents(source: Any) -> None:
    """Read all of a data set, as training and evaluation do."""
    for number, info in enumerate(source.infos()):
        episode = source.read(number)
        steps = range(info.num_steps) if episode.frame_steps is None else episode.frame_steps.tolist()
        if len(steps):
            episode.read_frames(list(steps))
        if episode.read_latents is not None and len(steps):
            episode.read_latents(list(steps))


def _write_rlds(folder: Path) -> None:
    write_synthetic_droid(folder / "set", steps=[3, 4], size=(24, 32), shards=1)


def _read_rlds(folder: Path) -> None:
    _contents(RldsSource(DataConfig(path=str(folder / "set"), disk_cache=_disk_cache())))


def _write_raw(folder: Path) -> None:
    states = synthetic_states(STEPS)
    poses = {"22": np.zeros((STEPS, 6))}
    target = folder / "LAB/success/2023-07-07/one"
    write_raw_droid(target, states, pictures={"22": FRAMES}, extrinsics=poses, joint_velocities=np.zeros((STEPS, 7)))


def _read_raw(folder: Path) -> None:
    _contents(RawDroidSource(DataConfig(source="droid_raw", path=str(folder), disk_cache=_disk_cache())))


def _write_lerobot(folder: Path) -> None:
    write_v30(folder / "set", [recorded(number, STEPS, size=(24, 32)) for number in range(2)], pictures="png")


def _write_lerobot_old(folder: Path) -> None:
    write_v21(folder / "set", [recorded(number, STEPS, size=(24, 32)) for number in range(2)])


def _read_lerobot(folder: Path) -> None:
    _contents(LeRobotSource(DataConfig(source="lerobot", path=str(folder / "set"), disk_cache=_disk_cache())))


def _write_npz(folder: Path) -> None:
    arrays = {"states": synthetic_states(STEPS), "frames": np.stack(FRAMES), "fps_hz": 15.0, "language": "lift it"}
    np.savez(folder / "one.npz", success=True, extrinsics=np.zeros(6), joint_velocities=np.zeros((STEPS, 7)), **arrays)


def _read_npz(folder: Path) -> None:
    _contents(NpzSource(DataConfig(source="npz", path=str(folder), disk_cache=_disk_cache())))


def _latent_config(folder: Path) -> DataConfig:
    return DataConfig(
        source="npz", path=str(folder / "npz"), frames=2, stride=2, cache="require", cache_dir=str(folder / "cache"),
        idle={"rule": "motion", "shortest_kept_steps": 1, "cut_last_steps": 0}, disk_cache=_disk_cache(),
    )  # fmt: skip


def _write_latents(folder: Path) -> None:
    (folder / "npz").mkdir()
    _write_npz(folder / "npz")
    write_cache(open_dataset(_latent_config(folder)))


def _cache_of(folder: Path) -> Path:
    return next(path.parent for path in folder.rglob("cache.json"))


def _read_latents(folder: Path) -> None:
    config = _latent_config(folder).model_dump() | {"source": "latents", "path": str(_cache_of(folder)), "cache": "off"}
    _contents(LatentSource(DataConfig(**config)))
    open_dataset(DataConfig(**config)).windows("train")


def _reseal_cache(folder: Path) -> None:
    path = _cache_of(folder) / "cache.json"
    try:
        manifest = json.loads(path.read_text())
        manifest["digest"] = CacheKey(manifest["key"]).digest
        names = [name for name in ("episodes.npz", "kept.npz") if (path.parent / name).is_file()]
        manifest["checksums"] |= {name: zlib.crc32((path.parent / name).read_bytes()) for name in names}
        path.write_text(json.dumps(manifest))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return


def _write_index(folder: Path) -> None:
    _write_npz(folder)
    os.environ["VJEPA2_AC_CACHE"] = str(folder / "kept")
    _read_npz(folder)


def _read_index(folder: Path) -> None:
    os.environ["VJEPA2_AC_CACHE"] = str(folder / "kept")
    _read_npz(folder)


def _of_index(data: bytes, random: np.random.Generator) -> bytes:
    """Return the file of an index with another table in it, and its checksum."""
    table = mutations.of_arrays(data[4:], random)
    return zlib.crc32(table).to_bytes(4, "little") + table


# Pictures


def _write_pictures(folder: Path) -> None:
    for name in ("a.png", "b.jpg"):
        Image.fromarray(FRAMES[0]).save(folder / name)
    Image.fromarray(FRAMES[0]).save(folder / "c.jpg", progressive=True)


def _read_pictures(folder: Path) -> None:
    for path in sorted(folder.glob("*.*g")):
        read_image(path)


def _write_ranges(folder: Path) -> None:
    (folder / "ranges.json").write_text(json.dumps({f"episode {number}": [[0, 9], [12, 30]] for number in range(9)}))


def _read_ranges(folder: Path) -> None:
    from vjepa2_ac.data.filters.idle_ranges import _checked

    for name, ranges in _read_list(str(folder / "ranges.json")).items():
        _checked(ranges, name, 40, "ranges.json")


BYTES, TEXT, JSON = (mutations.of_bytes,), (mutations.of_text,), (mutations.of_json,)

READERS: dict[str, Reader] = {
    "config.yaml": Reader(_write_config, "config.yaml", _read_config, TEXT),
    "adapter_config.json": Reader(_write_adapter, "adapter_config.json", _read_adapter, JSON),
    "adapter's card": Reader(_write_adapter, "vjepa2_ac.json", _read_adapter, JSON),
    "adapter's weights": Reader(_write_adapter, "*.safetensors", _read_adapter, (*BYTES, mutations.of_tensors)),
    "model config.json": Reader(_write_model, "model/config.json", _read_model, JSON),
    "model's weights": Reader(_write_model, "model/**/*.safetensors", _read_model, (*BYTES, mutations.of_tensors)),
    "official .pt": Reader(_write_official, "official.pt", _read_official, BYTES),
    "state.json": Reader(_write_run, "**/state.json", _read_states, JSON, _reseal_run),
    "manifest.json": Reader(_write_run, "**/manifest.json", _read_states, JSON),
    "optimizer.pt": Reader(_write_run, "**/optimizer.pt", _read_run, BYTES, _reseal_run),
    "metrics.jsonl": Reader(_write_journal, "metrics.jsonl", training_curves, (mutations.of_json_lines,)),
    "metrics.json": Reader(
        _write_metrics_of_two, "*/metrics.json", lambda folder: compare([folder / "a", folder / "b"]), JSON
    ),
    "TFRecord": Reader(_write_rlds, "set/*.tfrecord-*", _read_rlds, (*BYTES, mutations.of_records)),
    "dataset_info.json": Reader(_write_rlds, "set/dataset_info.json", _read_rlds, JSON),
    "HDF5": Reader(_write_raw, "**/trajectory.h5", _read_raw, BYTES),
    "metadata of raw DROID": Reader(_write_raw, "**/metadata_*.json", _read_raw, JSON),
    "MP4": Reader(_write_raw, "**/*.mp4", _read_raw, BYTES),
    "MP4 of LeRobot": Reader(_write_lerobot_old, "**/*.mp4", _read_lerobot, BYTES),
    "Parquet": Reader(_write_lerobot, "set/data/**/*.parquet", _read_lerobot, BYTES),
    "Parquet of episodes": Reader(_write_lerobot, "set/meta/**/*.parquet", _read_lerobot, BYTES),
    "info.json": Reader(_write_lerobot, "set/meta/info.json", _read_lerobot, JSON),
    "episodes.jsonl": Reader(_write_lerobot_old, "set/meta/episodes.jsonl", _read_lerobot, (mutations.of_json_lines,)),
    "npz": Reader(_write_npz, "one.npz", _read_npz, (*BYTES, mutations.of_arrays)),
    "latent cache: cache.json": Reader(_write_latents, "**/cache.json", _read_latents, JSON, _reseal_cache),
    "latent cache: tables": Reader(
        _write_latents, "cache/**/*.npz", _read_latents, (*BYTES, mutations.of_arrays), _reseal_cache
    ),
    "latent cache: latents": Reader(
        _write_latents, "cache/**/*.safetensors", _read_latents, (*BYTES, mutations.of_tensors)
    ),
    "index": Reader(_write_index, "kept/index/*.index", _read_index, (*BYTES, _of_index)),
    "pictures": Reader(_write_pictures, "*.*g", _read_pictures, BYTES),
    "idle ranges": Reader(_write_ranges, "ranges.json", _read_ranges, JSON),
}
