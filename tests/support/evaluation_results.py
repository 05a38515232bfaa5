"""A synthetic evaluation with known numbers, for tests of reports and figures."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from vjepa2_ac.evaluation.result import (
    ACTIONS,
    L1,
    L2,
    MODES,
    About,
    ActionMode,
    ActionRanking,
    Clips,
    DecodedRollouts,
    DecodedStrip,
    Evaluation,
    Example,
    Landscape,
    Landscapes,
    LatentDistribution,
    Mode,
    ModelResult,
    PredictionErrors,
)
from vjepa2_ac.evaluation.rows import make_rows
from vjepa2_ac.evaluation.summary import summarize
from vjepa2_ac.intervals import estimate_mean
from vjepa2_ac.reports.write import render_page

ABOUT = About(
    subject="runs/kitchen",
    checkpoint="the newest, of step 800",
    checkpoint_path="runs/kitchen/checkpoints/step-00000800",
    source="rlds",
    data="demo/data",
    cameras=("exterior_image_1_left",),
    split="test",
    frames=4,
    stride=4,
    seconds_per_step=4 / 15,
    seed=0,
    version="0.1.0",
    time="2026-11-21 16:00 UTC",
)


def errors(rng: np.random.Generator, level: float, horizon: int, episode_of: np.ndarray) -> np.ndarray:
    """Return errors about a level that grow with the horizon and are alike within an episode."""
    episode_factor = 1 + 0.1 * rng.standard_normal(episode_of.max() + 1)[episode_of][:, None]
    grown = np.linspace(1.0, 1.15, horizon)[None]
    return 0.35 * level * episode_factor * grown * (1 + 0.04 * rng.standard_normal((len(episode_of), horizon)))


def _predicted(
    rng: np.random.Generator, actions: ActionMode, level: float, horizon: int, episode_of: np.ndarray
) -> dict[tuple[ActionMode, Mode, str], np.ndarray]:
    errors_by_mode = {mode: errors(rng, level, horizon, episode_of) for mode in MODES}
    l2_errors = {(actions, mode, L2.name): values**2 * 1.6 for mode, values in errors_by_mode.items()}
    return {(actions, mode, L1.name): values for mode, values in errors_by_mode.items()} | l2_errors


def ranking_of(ranks: np.ndarray, ids: tuple[str, ...]) -> ActionRanking:
    """Return a ranking of these moves, the same in the box and on the shell."""
    rank = estimate_mean(ranks, ids)
    change = estimate_mean(0.2 - 0.3 * ranks, ids)
    return ActionRanking(64, 0.075, ids, ranks, rank, rank, rank, change, change)


def _landscape(rng: np.random.Generator, episode_id: str, off: float) -> Landscape:
    true = rng.uniform(-4, 4, size=3)
    steps = np.arange(-6, 7) * 1.25
    axes = np.stack([true[axis] + steps for axis in range(3)])
    centre = true + off * rng.standard_normal(3)
    x, y, z = np.meshgrid(*axes, indexing="ij")
    energy = 0.4 + 0.002 * ((x - centre[0]) ** 2 + (y - centre[1]) ** 2 + 0.5 * (z - centre[2]) ** 2)
    index = np.unravel_index(energy.argmin(), energy.shape)
    minimum = np.array([axes[axis][index[axis]] for axis in range(3)])
    return Landscape(episode_id, 12, axes, energy, true, minimum)


def _landscapes(rng: np.random.Generator, ids: tuple[str, ...], off: float) -> Landscapes:
    maps = tuple(_landscape(rng, name, off) for name in ids[:5])
    return Landscapes(("dx", "dy", "dz"), "cm", maps, 8.1)


def _distribution(rng: np.random.Generator, ids: tuple[str, ...], spread: float, horizon: int) -> LatentDistribution:
    levels = [spread ** (h / horizon) + 0.1 * rng.standard_normal(len(ids)) for h in range(1, horizon + 1)]
    spreads = tuple(estimate_mean(level, ids) for level in levels)
    mmd, variance = (
        tuple(estimate_mean(1 - level, ids) for level in levels),
        tuple(2 * spread_estimate.value for spread_estimate in spreads),
    )
    return LatentDistribution(spreads, mmd, 1.5 - spread, variance, (2.0,) * horizon)


def _example(rng: np.random.Generator, why: str, episode_id: str, times: int, models: list[str], size: int) -> Example:
    grid = max(4, size // 16)
    y, x = np.mgrid[:size, :size] / size
    frames = np.stack([
        np.stack([255 * x, 255 * y, 255 * (np.hypot(x - 0.2 - 0.5 * t / times, y - 0.5) < 0.15)], axis=-1)
        for t in range(times)
    ]).astype(np.uint8)  # fmt: skip
    return Example(
        why,
        episode_id,
        12,
        frames,
        {name: rng.gamma(2.0, 0.15, size=(times - 1, grid, grid)) for name in ("persistence", *models)},
    )


def page_of(evaluation: Evaluation) -> str:
    """Return the report with the summary that the console shows."""
    return render_page(evaluation, summarize(evaluation, make_rows(evaluation)))


def decoded_strips(evaluation: Evaluation, size: int = 64) -> Evaluation:
    """Return an evaluation with two decoded clips of a falling bar; in the second one the base sees it stand still."""
    true = np.full((evaluation.about.frames, size, size, 3), 90, np.uint8)
    for time, frame in enumerate(true):
        frame[3 * time : size // 3 + 3 * time] = (200, 60, 40)
    names = ("decoded_truth", *filter(None, (evaluation.base, evaluation.trained)))
    rows = dict.fromkeys(("truth", *names), true)
    strip_rows = (rows, rows | {names[1]: true[:1].repeat(len(true), axis=0)})
    strips = tuple(DecodedStrip("median", evaluation.clips.episode_ids[0], 0, shown) for shown in strip_rows)
    psnr = (
        estimate_mean(np.linspace(20, 24, len(evaluation.clips)), evaluation.clips.episode_ids),
    ) * evaluation.horizon
    curves = {(name, "psnr_db.whole.truth"): psnr for name in names}
    return replace(
        evaluation, decoded=DecodedRollouts({"folder": "decoder"}, names, curves, strips, fvd=dict.fromkeys(names, 0.4))
    )


@lru_cache(maxsize=8)
def evaluation(
    *, episodes: int = 12, clips: int = 48, frames: int = 4, with_base: bool = True, others: tuple[str, ...] = (),
    size: int = 64, id_form: str = "AUTOLab/success/2023-07-0{0}/Fri_{0}",
) -> Evaluation:  # fmt: skip
    """Return an evaluation with all measurements."""
    rng = np.random.default_rng(0)
    horizon = frames - 1
    ids = tuple(id_form.format(clip % episodes) for clip in range(clips))
    episode_of = np.arange(clips) % episodes
    names = [*(["base"] if with_base else []), *others, "adapter"]
    persistence = _predicted(rng, "persistence", 1.0, horizon, episode_of)
    models = {}
    for index, name in enumerate(names):
        skill = (index + 1) / len(names)
        level = 1.1 - 0.4 * skill
        arrays = persistence
        for actions, wrong in zip(ACTIONS, (1.0, 1.1, 1.2), strict=True):
            arrays = arrays | _predicted(rng, actions, level * wrong, horizon, episode_of)
        models[name] = ModelResult(
            name,
            {"base": "base", "adapter": "trained"}.get(name, "other"),  # type: ignore[arg-type]
            PredictionErrors(ids, arrays),
            _landscapes(rng, ids, 4 - 3 * skill),
            ranking=ranking_of(0.3 * (1 - skill) + 0.1 * rng.random(len(ids)), ids),
            distribution=_distribution(np.random.default_rng(index), ids, 0.5 + 0.4 * skill, horizon),
        )
    size_of_action = rng.gamma(2.0, 2.0, size=(clips, horizon))
    moving = size_of_action > 1.5
    return Evaluation(
        about=replace(ABOUT, frames=frames),
        clips=Clips(ids, tuple(range(clips)), size_of_action, moving, "the flange moves 1.5 cm or more in a step"),
        models=models,
        examples=tuple(_example(rng, why, ids[0], frames, names, size) for why in ("best", "worst")),
        copies=_distribution(np.random.default_rng(9), ids, 1.0, horizon),
        fvd_of_halves=0.12,
    )
