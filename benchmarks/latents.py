"""What does it gain to encode once, and what does it cost? Training with and without the latent cache.

    python benchmarks/latents.py --frames 8 16
    python benchmarks/latents.py --device cuda --encoder-layers 40 --predictor-layers 24 --batch 8 --workers 8

Everything is as in a run: a data set of a simulated arm (180x320 JPEGs in RLDS), encoded by what `vjepa2-ac encode`
does; then the training step of a run on pictures and that of one on latents take turns, loader and all, so that a busy
machine slows them alike. Widths are those of ViT-g and its predictor; by default both are an eighth as deep, for a CPU.
On a CPU the process's own time over its threads counts, else wall time.

Beside it the encoder alone on random frames: frames/s, which is what a loader must deliver to keep it busy, its MFU
(`training.cost.flops` over what the device does in a product of matrices), and what share of that speed the whole
`encode` has, with decoding and writing. Give a fast device enough --episodes to reach its pace.

Then what storing latents in fewer bits costs: the one-step and rollout error of the shipped model on simulated
episodes, predicted from latents as they are read back, against the true ones, over the error of persistence.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from timing import clock_s
from torch import Tensor

from vjepa2_ac.config import Config, DataConfig, EncoderSizes, ModelConfig, ModelSizes, PredictorSizes
from vjepa2_ac.config_file import parse_config
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.loader import validation_batches
from vjepa2_ac.data.sources.latents.precision import DTYPES, bytes_per_frame, decoded, stored
from vjepa2_ac.encoding.room import picture_bytes
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.latents import encode_batch
from vjepa2_ac.model.load import load_base
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.simulation.record import record_dataset
from vjepa2_ac.training.assembly import Run, assemble, batches_from
from vjepa2_ac.training.cost.flops import frame_flops
from vjepa2_ac.training.device import autocast
from vjepa2_ac.training.encode import encode_config
from vjepa2_ac.training.health import matmul_speed
from vjepa2_ac.training.step import training_step

RATE_HZ, STRIDE = 15, 4
PAST_WARM_UP = 1001  # a step at which the learning rate is what it mostly is
QUICK = {
    "encoder_layers": 1, "predictor_layers": 1, "width": 128, "latent_dim": 128, "image_size": 64, "frames": [4],
    "episodes": 6, "test_episodes": 2, "domains": ["random"], "repeats": 1, "precision": "fp32",
}  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Print speed, size and added error."""
    options = parse(arguments)
    print(f"torch {torch.__version__}, {options.device}, {torch.get_num_threads()} threads, {options.precision}")
    with tempfile.TemporaryDirectory() as folder:
        measure_speed(options, Path(folder))
        print_sizes(options)
        measure_error(options, Path(folder))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="tiny sizes: whether it works")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
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
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--workers", type=int, default=0, help="of the loader; 0 counts reading as part of the step")
    parser.add_argument("--precision", default="bf16", choices=("bf16", "fp32"))
    options = parser.parse_args(sys.argv[1:] if arguments is None else arguments)
    if options.quick:
        vars(options).update(QUICK)
    return options


# ---- speed -------------------------------------------------------------------------------------------------------


def measure_speed(options: argparse.Namespace, folder: Path) -> None:
    """Time training steps on pictures and on latents of the same clips."""
    sizes = ModelSizes(
        image_size=options.image_size,
        encoder=EncoderSizes(width=options.latent_dim, heads=options.latent_dim // 64, depth=options.encoder_layers),
        predictor=PredictorSizes(width=options.width, heads=options.width // 64, depth=options.predictor_layers),
    )
    dtype = torch.bfloat16 if options.precision == "bf16" else torch.float32
    WorldModel.random(sizes, seed=0, dtype=dtype).save_pretrained(folder / "model")
    steps = (max(options.frames) - 1) * STRIDE + 9
    record_dataset(folder / "data", domain="A", episodes=options.episodes, steps=steps, seed=1)
    print(
        f"encoder {options.encoder_layers} of 40 layers, predictor {options.predictor_layers} of 24,"
        f" {options.image_size} px, batch {options.batch}; wall or processor's ms a clip, median of {options.repeats}"
    )
    print(
        f"{'frames':>6}{'encoder frames/s':>18}{'MFU':>7}{'encode frames/s':>17}{'of encoder':>12}{'pictures, ms':>14}"
        f"{'latents, ms':>13}{'ratio':>8}"
    )
    alone = 0.0
    for frames in options.frames:
        pictures = config_of(options, folder, frames, "off")
        latents = config_of(options, folder, frames, "require")
        speed = encode(latents, options.device)
        runs = {"pictures": assemble(pictures, lambda _: None), "latents": assemble(latents, lambda _: None)}
        alone = alone or encoder_speed(runs["pictures"], options)  # whatever the frames of a clip
        mfu = alone * frame_flops(sizes) / matmul_speed(torch.device(options.device), dtype)
        seconds = take_turns(runs, options)
        each = {name: 1e3 * statistics.median(some) / options.batch for name, some in seconds.items()}
        ratio = statistics.median(a / b for a, b in zip(seconds["pictures"], seconds["latents"], strict=True))
        print(f"{frames:6}{alone:18.2f}{mfu:7.1%}{speed:17.2f}{speed / alone:12.0%}", end="")
        print(f"{each['pictures']:14.0f}{each['latents']:13.0f}{ratio:7.2f}x", flush=True)


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
    encode_config(config, lambda _: None, progress=lambda done, _: told.append((clock_s(device), done)))
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


def take_turns(runs: dict[str, Run], options: argparse.Namespace) -> dict[str, list[float]]:
    """Return the seconds of each repeat of a training step; the first round does not count."""
    batches = {name: batches_from(run) for name, run in runs.items()}
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for repeat in range(options.repeats + 1):
        for name, run in runs.items():
            start = clock_s(options.device)
            training_step(run, batches[name], PAST_WARM_UP + repeat)
            if repeat:
                seconds[name].append(clock_s(options.device) - start)
    for each in batches.values():
        each.close()
    return seconds


# ---- size --------------------------------------------------------------------------------------------------------


def print_sizes(options: argparse.Namespace) -> None:
    """Print the gigabytes of an hour of robot data in each type."""
    tokens = (options.image_size // 16) ** 2
    print(f"{'stored as':>10}{'MB a frame':>12}{'GB an hour':>12}{f'with start_every={STRIDE}':>22}")
    for kind in DTYPES:
        frame = bytes_per_frame(tokens, options.latent_dim, kind) + picture_bytes(options.image_size)
        hour = frame * RATE_HZ * 3600 / 1e9
        print(f"{kind:>10}{frame / 1e6:12.3f}{hour:12.2f}{hour / STRIDE:22.2f}")


# ---- added error -------------------------------------------------------------------------------------------------


def measure_error(options: argparse.Namespace, folder: Path) -> None:
    """Print the error over persistence of the shipped model from latents as they are read back."""
    model = load_base(ModelConfig(base="builtin:sim-tiny", dtype="float32"), seed=0).eval()
    print(
        f"{'domain':>8}{'stored as':>11}{'one step':>10}{'added':>10}{'rollout':>10}{'added':>10}{'stored error':>14}"
    )
    for number, domain in enumerate(options.domains):
        place = folder / f"test {domain}"
        record_dataset(place, domain=domain, episodes=options.test_episodes, steps=33, seed=7 + number)
        batches = list(latents_of(model, place, folder / "kept"))
        true: tuple[float, float] | None = None
        for kind in ("fp32", "bf16", "int8"):
            one_step, rollout = errors(model, batches, kind)
            true = true or (one_step, rollout)
            off = statistics.mean(float((read(b.latents, kind) - b.latents).abs().mean()) for b in batches)
            print(
                f"{domain:>8}{kind:>11}{one_step:10.5f}{one_step / true[0] - 1:+10.3%}{rollout:10.5f}"
                f"{rollout / true[1] - 1:+10.3%}{off:14.5f}"
            )


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


def read(latents: Tensor, kind: Any) -> Tensor:
    """Return latents as they are read back from a cache."""
    return decoded(stored(latents, kind))


if __name__ == "__main__":
    main()
