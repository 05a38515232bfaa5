"""What does it gain to encode once, and what does it cost? Training with and without the latent cache.

    python benchmarks/latents.py --frames 8 16
    python benchmarks/latents.py --device cuda --encoder-layers 40 --predictor-layers 24 --batch 8 --workers 8

Everything is as in a run: a data set of a simulated arm (180x320 JPEGs in RLDS), encoded by what `vjepa2-ac encode`
does; then the training step of a run on pictures and that of one on latents take turns, loader and all, so that a busy
machine slows them alike. Widths are those of ViT-g and its predictor; by default both are an eighth as deep, for a CPU.
On a CPU the process's own time over its threads counts, else wall time; the median.

Beside it the encoder alone on random frames: frames/s, which is what a loader must deliver to keep it busy, its MFU
(`training.cost.flops` over what the device does in a product of matrices), and what share of that speed the whole
`encode` has, with decoding and writing. Give a fast device enough --episodes to reach its pace.

Then what a clip takes from a cache in a folder and from one in a bucket: reads or requests, and bytes, over those of
the clip's latents. Nothing is kept on the disk between two clips, as where a data set is much larger than the disk.

Then what storing latents in fewer bits costs: the one-step and rollout error of the shipped model on simulated
episodes, predicted from latents as they are read back, against the true ones, over the error of persistence. And
whether plans keep their order: for each clip 32 action sequences, its own among them, are ranked by the error of their
rollout at its end. Printed are the rank correlation with the order from exact latents, how often the best is the same
one, and how often it is the clip's own.

--json is written after every row. A row that fails says so, and the exit status is 1 then, when all else was measured.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from fsspec.implementations.memory import MemoryFileSystem
from memory import let_go
from random_models import no_fingerprints
from rows import Row, Rows, cell
from timing import about, add_basics, add_repeats, clock_s, introduction, prepare, ratio, settle, timed
from torch import Tensor

from vjepa2_ac import storage
from vjepa2_ac.config import Config, DataConfig, EncoderSizes, ModelConfig, ModelSizes, PredictorSizes
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.loader import training_loader, validation_batches
from vjepa2_ac.data.sources.latents.cache_files import (
    DTYPES,
    EncodedEpisode,
    bytes_per_frame,
    pack_latents,
    unpack_latents,
)
from vjepa2_ac.data.sources.latents.cache_key import Encoding
from vjepa2_ac.distributed import autocast, matmul_speed
from vjepa2_ac.encoding.batch import encode_batch
from vjepa2_ac.encoding.encode_dataset import encode_config
from vjepa2_ac.encoding.latent_cache import LatentCache
from vjepa2_ac.encoding.latent_cache import picture_bytes as small_frame_bytes
from vjepa2_ac.episode import LatentBatch, Progress
from vjepa2_ac.model.checkpoints.loading import load_base
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.reporter import Reporter
from vjepa2_ac.simulation.record import RecordingSpec, record_dataset
from vjepa2_ac.training.cost.flops import frame_flops
from vjepa2_ac.training.setup import Run, batches_from, set_up
from vjepa2_ac.training.step import training_step

RATE_HZ, STRIDE = 15, 4
READ_CLIPS = 16
PAST_WARM_UP = 1001  # a step at which the learning rate is what it mostly is
QUICK = {
    "encoder_layers": 1, "predictor_layers": 1, "width": 128, "latent_dim": 128, "image_size": 64, "frames": [4],
    "episodes": 2, "test_episodes": 2, "domains": ["random"], "repeats": 1, "precision": "fp32",
}  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Print speed, size and added error."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    options = parse(given)
    prepare(options)
    print(f"{introduction(options)}, {options.precision}")
    rows = Rows(options.json, **about(options, given))
    with tempfile.TemporaryDirectory() as folder, no_fingerprints():
        rows.attempt(partial(measure_speed, options, Path(folder), rows), measured="speed")
        let_go(options.device)
        print_sizes(options, rows)
    with tempfile.TemporaryDirectory() as folder:
        rows.attempt(partial(measure_reads, options, Path(folder), rows), measured="reads of a clip")
    with tempfile.TemporaryDirectory() as folder:
        rows.attempt(partial(measure_error, options, Path(folder), rows), measured="added error")
    rows.finish()


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--encoder-layers", type=int, default=5, help="of 40")
    parser.add_argument("--predictor-layers", type=int, default=3, help="of 24")
    parser.add_argument("--width", type=int, default=1024, help="of the predictor, 64 a head")
    parser.add_argument("--latent-dim", type=int, default=1408, help="width of the encoder, 64 a head")
    parser.add_argument("--image-size", type=int, default=256)
    parser.add_argument("--frames", type=int, nargs="+", default=[8, 16])
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--episodes", type=int, default=8, help="to train on")
    parser.add_argument("--test-episodes", type=int, default=40, help="to measure the added error on, of each domain")
    parser.add_argument("--domains", nargs="+", default=["random", "B"], help="of the simulated arm, for the same")
    parser.add_argument("--workers", type=int, default=0, help="of the loader; 0 counts reading as part of the step")
    parser.add_argument("--precision", default="bf16", choices=("bf16", "fp32"))
    add_basics(parser)
    add_repeats(parser)
    return settle(parser.parse_args(arguments), QUICK)


# ---- speed -------------------------------------------------------------------------------------------------------


def measure_speed(options: argparse.Namespace, folder: Path, rows: Rows) -> None:
    """Time training steps on pictures and on latents of the same clips."""
    dtype = torch.bfloat16 if options.precision == "bf16" else torch.float32
    sizes = sizes_of(options)
    WorldModel.random(sizes, seed=0, dtype=dtype, device=options.device).save_pretrained(folder / "model")
    steps = (max(options.frames) - 1) * STRIDE + 9
    spec = RecordingSpec("A", steps, seed=1)
    record_dataset(folder / "data", spec, episodes=options.episodes, workers=max(1, options.workers))
    print(
        f"encoder {options.encoder_layers} of 40 layers, predictor {options.predictor_layers} of 24,"
        f" {options.image_size} px, batch {options.batch}; wall or processor's ms a clip, median of {options.repeats}"
    )
    print(
        f"{'frames':>6}{'encoder frames/s':>18}{'MFU':>7}{'encode frames/s':>17}{'of encoder':>12}{'pictures, ms':>14}"
        f"{'min':>8}{'latents, ms':>13}{'min':>8}{'ratio':>8}"
    )
    alone = encoder_speed(set_up(config_of(options, folder, options.frames[0], "off")), options)
    mfu = alone * frame_flops(sizes) / matmul_speed(torch.device(options.device), dtype)
    rows.add({"measured": "encoder alone", "frames_per_s": alone, "mfu": mfu})
    for frames in options.frames:
        let_go(options.device)
        row = rows.attempt(partial(speed_row, options, folder, frames, rows), measured="speed", frames=frames)
        if row is None:
            continue
        rows.add(row)
        speed = row["encode_frames_per_s"]
        print(f"{frames:6}{alone:18.2f}{mfu:7.1%}{speed:17.2f}{speed / alone:12.0%}", end="")
        cells = (("pictures_ms", 14), ("pictures_min_ms", 8), ("latents_ms", 13), ("latents_min_ms", 8))
        print("".join(cell(row[name], width, ".0f") for name, width in cells), end="")
        print(f"{cell(row['ratio'], 7, '.2f')}x  {row['problem'] or ''}".rstrip(), flush=True)


def speed_row(options: argparse.Namespace, folder: Path, frames: int, rows: Rows) -> Row:
    """Return how fast a clip is encoded for the cache, and trained on from pictures and from latents."""
    pictures, latents = (config_of(options, folder, frames, cache) for cache in ("off", "require"))
    row: Row = {"measured": "speed", "frames": frames, "encode_frames_per_s": encode(latents, options.device)}
    rows.so_far(row)
    runs = {"pictures": set_up(pictures), "latents": set_up(latents)}
    batches = {name: batches_from(run) for name, run in runs.items()}
    steps = {name: partial(training_step, run, batches[name], PAST_WARM_UP) for name, run in runs.items()}
    turns = timed(steps, options, partial(let_go, options.device))
    for each in batches.values():
        each.close()
    for name, one in turns.items():
        for key, seconds in (("ms", one.median_s), ("min_ms", one.least_s)):
            row[f"{name}_{key}"] = seconds and 1e3 * seconds / options.batch
    problems = [f"{one.problem} ({name})" for name, one in turns.items() if one.problem]
    return {**row, "ratio": ratio(turns["pictures"], turns["latents"]), "problem": "; ".join(problems) or None}


def sizes_of(options: argparse.Namespace) -> ModelSizes:
    """Return the sizes of the model that speed is measured with."""
    return ModelSizes(
        image_size=options.image_size,
        encoder=EncoderSizes(width=options.latent_dim, heads=options.latent_dim // 64, depth=options.encoder_layers),
        predictor=PredictorSizes(width=options.width, heads=options.width // 64, depth=options.predictor_layers),
    )


def config_of(options: argparse.Namespace, folder: Path, frames: int, cache: str) -> Config:
    """Return a run of a LoRA of rank 16, on pictures or on latents."""
    values: dict[str, Any] = {
        "run_dir": str(folder / "run"),
        "data": {
            "path": str(folder / "data"), "frames": frames, "stride": STRIDE, "start_every": STRIDE,
            "validation_share": 0.3, "test_share": 0.0, "workers": options.workers, "cache": cache,
            "cache_dir": str(folder / "cache"), "disk_cache": {"dir": str(folder / "kept")},
        },
        "model": {
            "base": str(folder / "model"), "dtype": "bfloat16" if options.precision == "bf16" else "float32",
        },
        "training": {
            "batch_size": options.batch, "accumulation": 1, "precision": options.precision, "device": options.device,
        },
    }  # fmt: skip
    return parse_config(values, where="benchmark")


def encode(config: Config, device: str) -> float:
    """Write the cache of a run, and return the frames per second, decoding and writing included."""
    told: list[tuple[float, int]] = []

    class Timed(Reporter):
        def task(self, title: str, unit: str = "") -> Progress:
            if not unit:
                return super().task(title)
            return lambda done, _: told.append((clock_s(device), done))

    encode_config(config, Timed())
    (began, _), (ended, frames) = told[0], told[-1]
    return frames / (ended - began)


@torch.no_grad()
def encoder_speed(run: Run, options: argparse.Namespace) -> float:
    """Return the frames per second of the encoder alone: what a loader must deliver."""
    training, chunk = run.config.training, run.config.model.encode_chunk
    device = run.world_model.device
    frames = torch.randn(1, 2 * chunk, 3, options.image_size, options.image_size, device=device)
    seconds = []
    with autocast(training, device):
        for _ in range(options.repeats + 1):
            start = clock_s(options.device)
            run.world_model.encode(frames, chunk)
            seconds.append(clock_s(options.device) - start)
    return frames.shape[1] / statistics.median(seconds[1:])


# ---- size --------------------------------------------------------------------------------------------------------


def print_sizes(options: argparse.Namespace, rows: Rows) -> None:
    """Print and add the gigabytes of an hour of robot data in each type."""
    tokens = (options.image_size // 16) ** 2
    print(f"{'stored as':>10}{'MB a frame':>12}{'GB an hour':>12}{f'with start_every={STRIDE}':>22}")
    for kind in DTYPES:
        frame = bytes_per_frame(tokens, options.latent_dim, kind) + small_frame_bytes(options.image_size)
        hour = frame * RATE_HZ * 3600 / 1e9
        print(f"{kind:>10}{frame / 1e6:12.3f}{hour:12.2f}{hour / STRIDE:22.2f}")
        rows.add({"measured": "size", "stored_as": kind, "frame_mb": frame / 1e6, "hour_gb": hour})


# ---- reads of a clip ---------------------------------------------------------------------------------------------


def measure_reads(options: argparse.Namespace, folder: Path, rows: Rows) -> None:
    """Print and add what the clips of an epoch take from a cache of random latents, here and behind a URL."""
    frames = max(options.frames)
    spec = RecordingSpec("A", 2 * frames * STRIDE, seed=1)
    record_dataset(folder / "data", spec, episodes=2, workers=max(1, options.workers))
    print(f"{'stored as':>10}{'start_every':>13}{'place':>8}{'reads a clip':>14}{'MB a clip':>11}{'of its own':>12}")
    for kind in ("bf16", "int8"):
        for every in (1, STRIDE):
            for place in ("folder", "bucket"):
                url = str(folder / "latents") if place == "folder" else "memory://latents"
                knobs = {"cache_dtype": kind, "start_every": every, "cache_dir": url}
                row = {"measured": "reads of a clip", "place": place, "stored_as": kind, "start_every": every}
                row |= reads_of_a_clip(options, folder, frames, knobs)
                rows.add(row)
                numbers = f"{row['reads']:14.1f}{row['mb']:11.2f}{row['ratio']:11.3f}x"
                print(f"{kind:>10}{every:13}{place:>8}{numbers}", flush=True)


def reads_of_a_clip(options: argparse.Namespace, folder: Path, frames: int, knobs: dict[str, Any]) -> Row:
    """Write a cache of random latents, and count what reading clips of it takes."""
    disk = {"dir": str(folder / "kept"), "limit_gb": 0.0}
    values = {"path": str(folder / "data"), "frames": frames, "stride": STRIDE, "workers": 0, "disk_cache": disk}
    dataset = open_dataset(DataConfig.model_validate({**values, "validation_share": 0.0, "test_share": 0.0, **knobs}))
    tokens = (options.image_size // 16) ** 2
    encoding = Encoding("random", options.image_size, 16, tokens, options.latent_dim, "bfloat16", "bf16")
    cache = LatentCache.of(dataset, encoding)
    cache.begin()
    files = cache.files
    for one in cache.wanted:
        latents = pack_latents(torch.randn(len(one.steps), tokens, options.latent_dim), dataset.config.cache_dtype)
        episode, black = dataset.source.read(one.episode), np.zeros((len(one.steps), 16, 16, 3), np.uint8)
        files.write(one.episode, EncodedEpisode(episode, one.camera, one.steps.tolist(), latents, black))
    counted: list[int] = []

    def counting(read: Any) -> Any:
        def reading(*given: Any, **more: Any) -> Any:
            found = read(*given, **more)
            counted.extend([len(found)] if isinstance(found, bytes) else map(len, found))
            return found

        return reading

    here, there = counting(storage.read_ranges), counting(MemoryFileSystem.cat_file)
    loader = training_loader(cache.opened(), seed=0, batch_size=1)
    with patch.object(storage, "read_ranges", here), patch.object(MemoryFileSystem, "cat_file", there):
        clips = [batch.latents for batch in islice(loader, READ_CLIPS) if batch.latents is not None]
    own = sum(part.nbytes for clip in clips for part in (clip.values, clip.scales) if part is not None)
    total, count = sum(counted), len(clips)
    return {"clips": count, "reads": len(counted) / count, "mb": total / count / 1e6, "ratio": total / own}


# ---- added error -------------------------------------------------------------------------------------------------


def measure_error(options: argparse.Namespace, folder: Path, rows: Rows) -> None:
    """Print and add the error over persistence of the shipped model from latents as they are read back."""
    model = load_base(ModelConfig(base="builtin:sim-tiny", dtype="float32"), seed=0).eval()
    print(
        f"{'domain':>8}{'stored as':>11}{'one step':>10}{'added':>10}{'rollout':>10}{'added':>10}{'stored error':>14}"
        f"{'order':>9}{'same best':>11}{'own best':>10}"
    )
    for number, domain in enumerate(options.domains):
        named = {"measured": "added error", "domain": domain}
        rows.attempt(partial(measure_domain, options, folder, model, number, rows), **named)


def measure_domain(options: argparse.Namespace, folder: Path, model: WorldModel, number: int, rows: Rows) -> None:
    """Print and add a row for each type that latents are stored in, on episodes of one domain."""
    domain = options.domains[number]
    place = folder / f"test {domain}"
    workers = max(1, options.workers)
    spec = RecordingSpec(domain, steps=33, seed=7 + number)
    record_dataset(place, spec, episodes=options.test_episodes, workers=workers)
    batches = list(latents_of(model, place, folder / "kept"))
    true: tuple[float, float] | None = None
    exact = ranks_of(model, batches, "fp32")
    for kind in ("fp32", "bf16", "int8"):
        one_step, rollout = errors(model, batches, kind)
        true = true or (one_step, rollout)
        off = statistics.mean(float((read(b.latents, kind) - b.latents).abs().mean()) for b in batches)
        added = one_step / true[0] - 1, rollout / true[1] - 1
        ranks = ranks_of(model, batches, kind)
        pairs = zip(ranks, exact, strict=True)
        order = statistics.mean(float(torch.corrcoef(torch.stack(pair))[0, 1]) for pair in pairs)
        same = float((ranks.argmin(1) == exact.argmin(1)).float().mean())
        own = float((ranks[:, 0] == 0).float().mean())
        print(
            f"{domain:>8}{kind:>11}{one_step:10.5f}{added[0]:+10.3%}{rollout:10.5f}{added[1]:+10.3%}{off:14.5f}"
            f"{order:9.4f}{same:11.0%}{own:10.0%}",
            flush=True,
        )
        rows.add({
            "measured": "added error", "domain": domain, "stored_as": kind, "one_step": one_step, "rollout": rollout,
            "added_one_step": added[0], "added_rollout": added[1], "stored_error": off,
            "order": order, "same_best": same, "own_best": own,
        })  # fmt: skip


def latents_of(model: WorldModel, path: Path, kept: Path) -> Iterator[LatentBatch]:
    """Yield the latents of clips of all test episodes, as the demo cuts them."""
    data = DataConfig.model_validate(
        {"path": str(path), "frames": 4, "stride": STRIDE, "validation_share": 0.0, "test_share": 0.9, "workers": 0,
         "disk_cache": {"dir": str(kept)}},
    )  # fmt: skip
    dataset = open_dataset(data)
    for batch in validation_batches(dataset, "test", clips=8 * len(dataset.episodes), batch_size=32):
        yield encode_batch(model, batch, device=torch.device("cpu"), chunk=32)


@torch.no_grad()
def errors(model: WorldModel, batches: list[LatentBatch], kind: Any) -> tuple[float, float]:
    """Return the L1 error of one step and of a rollout's last over persistence's; targets are the true latents."""
    sums = torch.zeros(4, dtype=torch.float64)
    for batch in batches:
        true, given = batch.latents, read(batch.latents, kind)
        states, actions = batch.states[:, :-1], batch.actions
        forced, rolled = model.predict(given[:, :-1], actions, states), model.rollout(given[:, :1], actions, states)
        pairs = [
            (forced, true[:, 1:]), (true[:, :-1], true[:, 1:]), (rolled[:, -1], true[:, -1]), (true[:, 0], true[:, -1])
        ]  # fmt: skip
        sums += torch.stack([len(true) * (a - b).abs().mean().double() for a, b in pairs])
    return float(sums[0] / sums[1]), float(sums[2] / sums[3])


@torch.no_grad()
def ranks_of(model: WorldModel, batches: list[LatentBatch], kind: Any) -> Tensor:
    """Return how action sequences (columns; the first is its own) rank for the way from a clip's start to its end."""
    found = []
    for batch in batches:
        given, count = read(batch.latents, kind), len(batch.latents)
        for one in range(count if count == len(batches[0].latents) else 0):
            actions, states = batch.actions.roll(-one, 0), batch.states[one, :-1].expand(count, -1, -1)
            rolled = model.rollout(given[one, :1].expand(count, -1, -1, -1), actions, states)
            error = (rolled[:, -1] - given[one, -1]).abs().mean((1, 2))
            found.append(error.argsort().argsort().float())
    return torch.stack(found)


def read(latents: Tensor, kind: Any) -> Tensor:
    """Return latents as they are read back from a cache."""
    return unpack_latents(pack_latents(latents, kind))


if __name__ == "__main__":
    main()
