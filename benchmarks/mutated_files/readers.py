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
from evaluation.results import evaluation
from latent_sets import write_cache
from lerobot_sets import recorded, write_v21, write_v30
from PIL import Image
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
from vjepa2_ac.config_file import config_as_yaml, load_config, parse_config
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.idle_search import _read_list
from vjepa2_ac.data.picture_file import read_picture
from vjepa2_ac.data.sources.droid_raw.source import RawDroidSource
from vjepa2_ac.data.sources.latents.key import CacheKey
from vjepa2_ac.data.sources.latents.source import LatentSource
from vjepa2_ac.data.sources.lerobot.source import LeRobotSource
from vjepa2_ac.data.sources.npz.source import NpzSource
from vjepa2_ac.data.sources.rlds.source import RldsSource
from vjepa2_ac.evaluation.comparison import compare
from vjepa2_ac.evaluation.metrics_file import write_metrics
from vjepa2_ac.model.lora import add_adapter, load_trained, save_trained
from vjepa2_ac.model.weights import load_official, to_official
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.training.checkpoint import ADAPTER, OPTIMIZER, RunState, newest_checkpoint, read_state, write_checkpoint
from vjepa2_ac.training.evaluation import training_curves
from vjepa2_ac.training.manifest import seal
from vjepa2_ac.training.optim import make_optimizer, trained_parameters
from vjepa2_ac.training.resume import _read as read_checkpoint
from vjepa2_ac.training.torch_file import write_torch

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


def disk_cache() -> DiskCacheConfig:
    return DiskCacheConfig(dir=os.environ["VJEPA2_AC_CACHE"])


# Configs


def write_config(folder: Path) -> None:
    values = {"run_dir": "r", "data": {"path": "d", "exclude": ["a", "b"]}, "model": {"base": "b.pt"}}
    patterns = {"adapter": {"rank_pattern": {"fc1": 3}}}
    (folder / "config.yaml").write_text(config_as_yaml(parse_config(values | patterns, where="")))


def read_config(folder: Path) -> None:
    config = load_config(folder / "config.yaml")
    (folder / "again.yaml").write_text(config_as_yaml(config))
    if load_config(folder / "again.yaml") != config:
        raise AssertionError("a config reads back as another")


# Models


@cache
def base() -> WorldModel:
    return WorldModel.random(SIZES, seed=0)


def write_adapter(folder: Path) -> None:
    model = WorldModel.random(SIZES, seed=0)
    add_adapter(model, AdapterConfig(rank=2, rank_pattern={"fc1": 3}, modules_to_save=("state_encoder",)), seed=0)
    save_trained(model, folder)


def read_adapter(folder: Path) -> None:
    load_trained(WorldModel.random(SIZES, seed=0), folder)


def write_model(folder: Path) -> None:
    base().save_pretrained(folder / "model")


def read_model(folder: Path) -> None:
    WorldModel.from_pretrained(folder / "model", torch.float32)


def write_official(folder: Path) -> None:
    torch.save(to_official(base()), folder / "official.pt")


def read_official(folder: Path) -> None:
    load_official(folder / "official.pt", SIZES)


# Runs


def write_run(folder: Path) -> None:
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


def reseal_run(folder: Path) -> None:
    checkpoint = next((folder / "checkpoints").glob("step-*"))
    (checkpoint / "manifest.json").unlink()
    seal(checkpoint)


def read_states(folder: Path) -> None:
    checkpoint = newest_checkpoint(folder / "checkpoints")
    if checkpoint is not None:
        read_state(checkpoint)


def read_run(folder: Path) -> None:
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


def write_journal(folder: Path) -> None:
    rows = [{"kind": "train", "step": step, "loss": 1.0 / step, "by_horizon": [1.0, None]} for step in range(1, 9)]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


def write_metrics_of_two(folder: Path) -> None:
    for name in ("a", "b"):
        (folder / name).mkdir()
        write_metrics(evaluation(episodes=3, clips=6), folder / name / "metrics.json")


# Data sets


def contents(source: Any) -> None:
    """Read all of a data set, as training and evaluation do."""
    for number, info in enumerate(source.infos()):
        episode = source.read(number)
        steps = range(info.num_steps) if episode.frame_steps is None else episode.frame_steps.tolist()
        if len(steps):
            episode.read_frames(list(steps))
        if episode.read_latents is not None and len(steps):
            episode.read_latents(list(steps))


def write_rlds(folder: Path) -> None:
    write_synthetic_droid(folder / "set", steps=[3, 4], size=(24, 32), shards=1)


def read_rlds(folder: Path) -> None:
    contents(RldsSource(DataConfig(path=str(folder / "set"), disk_cache=disk_cache())))


def write_raw(folder: Path) -> None:
    states = synthetic_states(STEPS)
    poses = {"22": np.zeros((STEPS, 6))}
    target = folder / "LAB/success/2023-07-07/one"
    write_raw_droid(target, states, pictures={"22": FRAMES}, extrinsics=poses, joint_velocities=np.zeros((STEPS, 7)))


def read_raw(folder: Path) -> None:
    contents(RawDroidSource(DataConfig(source="droid_raw", path=str(folder), disk_cache=disk_cache())))


def write_lerobot(folder: Path) -> None:
    write_v30(folder / "set", [recorded(number, STEPS, size=(24, 32)) for number in range(2)], pictures="png")


def write_lerobot_old(folder: Path) -> None:
    write_v21(folder / "set", [recorded(number, STEPS, size=(24, 32)) for number in range(2)])


def read_lerobot(folder: Path) -> None:
    contents(LeRobotSource(DataConfig(source="lerobot", path=str(folder / "set"), disk_cache=disk_cache())))


def write_npz(folder: Path) -> None:
    arrays = {"states": synthetic_states(STEPS), "frames": np.stack(FRAMES), "fps_hz": 15.0, "language": "lift it"}
    np.savez(folder / "one.npz", success=True, extrinsics=np.zeros(6), joint_velocities=np.zeros((STEPS, 7)), **arrays)


def read_npz(folder: Path) -> None:
    contents(NpzSource(DataConfig(source="npz", path=str(folder), disk_cache=disk_cache())))


def latent_config(folder: Path) -> DataConfig:
    return DataConfig(
        source="npz", path=str(folder / "npz"), frames=2, stride=2, cache="require", cache_dir=str(folder / "cache"),
        idle={"rule": "motion", "shortest_kept_steps": 1, "cut_last_steps": 0}, disk_cache=disk_cache(),
    )  # fmt: skip


def write_latents(folder: Path) -> None:
    (folder / "npz").mkdir()
    write_npz(folder / "npz")
    write_cache(open_dataset(latent_config(folder)))


def cache_of(folder: Path) -> Path:
    return next(path.parent for path in folder.rglob("cache.json"))


def read_latents(folder: Path) -> None:
    config = latent_config(folder).model_dump() | {"source": "latents", "path": str(cache_of(folder)), "cache": "off"}
    contents(LatentSource(DataConfig(**config)))
    open_dataset(DataConfig(**config)).windows("train")


def reseal_cache(folder: Path) -> None:
    path = cache_of(folder) / "cache.json"
    try:
        manifest = json.loads(path.read_text())
        manifest["digest"] = CacheKey(manifest["key"]).digest
        names = [name for name in ("episodes.npz", "kept.npz") if (path.parent / name).is_file()]
        manifest["checksums"] |= {name: zlib.crc32((path.parent / name).read_bytes()) for name in names}
        path.write_text(json.dumps(manifest))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return


def write_index(folder: Path) -> None:
    write_npz(folder)
    os.environ["VJEPA2_AC_CACHE"] = str(folder / "kept")
    read_npz(folder)


def read_index(folder: Path) -> None:
    os.environ["VJEPA2_AC_CACHE"] = str(folder / "kept")
    read_npz(folder)


def of_index(data: bytes, random: np.random.Generator) -> bytes:
    """Return the file of an index with another table in it, and its checksum."""
    table = mutations.of_arrays(data[4:], random)
    return zlib.crc32(table).to_bytes(4, "little") + table


# Pictures


def write_pictures(folder: Path) -> None:
    for name in ("a.png", "b.jpg"):
        Image.fromarray(FRAMES[0]).save(folder / name)
    Image.fromarray(FRAMES[0]).save(folder / "c.jpg", progressive=True)


def read_pictures(folder: Path) -> None:
    for path in sorted(folder.glob("*.*g")):
        read_picture(path)


def write_ranges(folder: Path) -> None:
    (folder / "ranges.json").write_text(json.dumps({f"episode {number}": [[0, 9], [12, 30]] for number in range(9)}))


def read_ranges(folder: Path) -> None:
    from vjepa2_ac.data.idle_search import _checked

    for name, ranges in _read_list(str(folder / "ranges.json")).items():
        _checked(ranges, name, 40, "ranges.json")


BYTES, TEXT, JSON = (mutations.of_bytes,), (mutations.of_text,), (mutations.of_json,)

READERS: dict[str, Reader] = {
    "config.yaml": Reader(write_config, "config.yaml", read_config, TEXT),
    "adapter_config.json": Reader(write_adapter, "adapter_config.json", read_adapter, JSON),
    "adapter's card": Reader(write_adapter, "vjepa2_ac.json", read_adapter, JSON),
    "adapter's weights": Reader(write_adapter, "*.safetensors", read_adapter, (*BYTES, mutations.of_tensors)),
    "model config.json": Reader(write_model, "model/config.json", read_model, JSON),
    "model's weights": Reader(write_model, "model/**/*.safetensors", read_model, (*BYTES, mutations.of_tensors)),
    "official .pt": Reader(write_official, "official.pt", read_official, BYTES),
    "state.json": Reader(write_run, "**/state.json", read_states, JSON, reseal_run),
    "manifest.json": Reader(write_run, "**/manifest.json", read_states, JSON),
    "optimizer.pt": Reader(write_run, "**/optimizer.pt", read_run, BYTES, reseal_run),
    "metrics.jsonl": Reader(write_journal, "metrics.jsonl", training_curves, (mutations.of_json_lines,)),
    "metrics.json": Reader(
        write_metrics_of_two, "*/metrics.json", lambda folder: compare([folder / "a", folder / "b"]), JSON
    ),
    "TFRecord": Reader(write_rlds, "set/*.tfrecord-*", read_rlds, (*BYTES, mutations.of_records)),
    "dataset_info.json": Reader(write_rlds, "set/dataset_info.json", read_rlds, JSON),
    "HDF5": Reader(write_raw, "**/trajectory.h5", read_raw, BYTES),
    "metadata of raw DROID": Reader(write_raw, "**/metadata_*.json", read_raw, JSON),
    "MP4": Reader(write_raw, "**/*.mp4", read_raw, BYTES),
    "MP4 of LeRobot": Reader(write_lerobot_old, "**/*.mp4", read_lerobot, BYTES),
    "Parquet": Reader(write_lerobot, "set/data/**/*.parquet", read_lerobot, BYTES),
    "Parquet of episodes": Reader(write_lerobot, "set/meta/**/*.parquet", read_lerobot, BYTES),
    "info.json": Reader(write_lerobot, "set/meta/info.json", read_lerobot, JSON),
    "episodes.jsonl": Reader(write_lerobot_old, "set/meta/episodes.jsonl", read_lerobot, (mutations.of_json_lines,)),
    "npz": Reader(write_npz, "one.npz", read_npz, (*BYTES, mutations.of_arrays)),
    "latent cache: cache.json": Reader(write_latents, "**/cache.json", read_latents, JSON, reseal_cache),
    "latent cache: tables": Reader(
        write_latents, "cache/**/*.npz", read_latents, (*BYTES, mutations.of_arrays), reseal_cache
    ),
    "latent cache: latents": Reader(
        write_latents, "cache/**/*.safetensors", read_latents, (*BYTES, mutations.of_tensors)
    ),
    "index": Reader(write_index, "kept/index/*.index", read_index, (*BYTES, of_index)),
    "pictures": Reader(write_pictures, "*.*g", read_pictures, BYTES),
    "idle ranges": Reader(write_ranges, "ranges.json", read_ranges, JSON),
}
