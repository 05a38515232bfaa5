"""Which metric rewards blur? True futures of the simulated arm against one wrong future, their mean, and no arm moving.

    python benchmarks/image_metrics.py
    python benchmarks/image_metrics.py --starts 40 --futures 8

First table: from each start the arm goes in a random direction; that is the truth. A *wrong future* is sharp and goes
in another direction; the *mean of futures* is the average image of all others: what a model gives that cannot tell them
apart. Second table: the squared MMD between features of predictions and of truth, of predictions that are as varied as
the truth but wrong, and of predictions that are smoothed; once by the estimate that is unbiased over episodes, once by
that of JEDi (every pair counts, a clip with itself and with its own truth, too).
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from vjepa2_ac.config import RldsData
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.evaluation.distribution import discrepancy
from vjepa2_ac.media.image_similarity import mean_where, moving_region, ms_ssim, psnr, ssim, ssim_map
from vjepa2_ac.simulation.counterfactual import resimulate
from vjepa2_ac.simulation.record import RecordingSpec, record_dataset

_STEP_M, _STEPS, _STRIDE = 0.05, 3, 4
_DIM, _EPISODES, _CLIPS, _SMOOTHED = 1408, 40, 6, 0.8


def main(arguments: Sequence[str] | None = None) -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument("--futures", type=int, default=8, help="directions from each start")
    parser.add_argument("--draws", type=int, default=20, help="of features")
    options = parser.parse_args(arguments)
    console = Console(width=110)
    console.print(_of_images(options.starts, options.futures))
    console.print(_of_features(options.draws))


def _of_images(starts: int, futures: int) -> Table:
    found: dict[str, list[list[float]]] = {"a wrong future": [], "mean of futures": [], "nothing moves": []}
    for number in range(starts):
        images = torch.from_numpy(_futures(number, futures)).permute(0, 1, 4, 2, 3).float() / 255
        truth, others = images[0, -1], images[1:, -1]
        where = moving_region(images[0])[-1]
        guesses = {"a wrong future": others[0], "mean of futures": others.mean(dim=0), "nothing moves": images[0, 0]}
        for name, guess in guesses.items():
            found[name].append([
                float(one)
                for one in (
                    psnr(guess, truth), ssim(guess, truth), ms_ssim(guess, truth, scales=3),
                    psnr(guess, truth, where), mean_where(ssim_map(guess, truth), where),
                )
            ])  # fmt: skip
    title = f"{starts} starts, {_STEPS} steps of {100 * _STEP_M:g} cm, means over starts; higher should be better"
    table = Table("", "PSNR, dB", "SSIM", "MS-SSIM", "PSNR where it moves", "SSIM where it moves", title=title)
    for name, rows in found.items():
        mean = np.mean(rows, axis=0)
        table.add_row(name, f"{mean[0]:.1f}", *(f"{one:.3f}" for one in mean[1:3]), f"{mean[3]:.1f}", f"{mean[4]:.3f}")
    return table


def _futures(number: int, futures: int) -> np.ndarray:
    """Return frames [futures, time, height, width, 3] of the arm going in random directions from one start."""
    rng = np.random.default_rng(number)
    with tempfile.TemporaryDirectory() as folder:
        path = record_dataset(Path(folder) / "data", RecordingSpec("B", 2, seed=number), episodes=1)
        dataset = open_dataset(RldsData(path=str(path), frames=2, stride=1))
        arm = resimulate(path, dataset.source.read(0, dataset.config.cameras[0]), 0)
        shown = []
        for _ in range(futures):
            way = rng.normal(size=3)
            actions = np.zeros((_STEPS, 7))
            actions[:, :3] = _STEP_M * way / np.linalg.norm(way)
            shown.append(arm.under(actions, _STRIDE).frames)
    return np.stack(shown)


def _of_features(draws: int) -> Table:
    title = f"squared MMD x 100 of {_EPISODES * _CLIPS} clips of {_EPISODES} episodes, mean over {draws} draws"
    table = Table(
        "predictions", "unbiased over episodes", "as JEDi estimates", title=f"{title}; lower should be better"
    )
    found: dict[str, list[tuple[float, float]]] = {"as varied as the truth": [], "smoothed by 20 %": []}
    ids = [str(episode) for episode in range(_EPISODES) for _ in range(_CLIPS)]
    for draw in range(draws):
        rng = np.random.default_rng(draw)
        true = _features(rng)
        for name, guess in (("as varied as the truth", _features(rng)), ("smoothed by 20 %", _SMOOTHED * true)):
            found[name].append((discrepancy(guess, true, ids)[0].value, _v_statistic(guess, true)))
    for name, rows in found.items():
        table.add_row(name, *(f"{one:+.4f}" for one in np.mean(rows, axis=0)))
    return table


def _features(rng: np.random.Generator) -> Float[np.ndarray, "clips dim"]:
    """Return features with a spectrum that falls as 1 / k, clips of an episode being alike."""
    scale = np.sqrt(_DIM / np.arange(1, _DIM + 1) / (1 / np.arange(1, _DIM + 1)).sum())
    episodes = rng.normal(size=(_EPISODES, 1, _DIM)) * np.sqrt(0.5)
    clips = episodes + rng.normal(size=(_EPISODES, _CLIPS, _DIM)) * np.sqrt(0.5)
    return np.asarray((clips * scale).reshape(-1, _DIM))


def _v_statistic(one: np.ndarray, other: np.ndarray) -> float:
    def kernel(left: np.ndarray, right: np.ndarray) -> float:
        return float(((left @ right.T / _DIM) ** 2).mean())

    return 100 * (kernel(one, one) + kernel(other, other) - 2 * kernel(one, other))


if __name__ == "__main__":
    main()
