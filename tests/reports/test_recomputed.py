"""Every number of the summary can be recomputed from metrics.json with NumPy, without this package."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vjepa2_ac.evaluation.evaluate import EvaluatedModel, evaluate
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.reports.metrics_json import METRICS_FILE, read_metrics, write_metrics
from worlds import Oracle, about, clips_batch, repeatable_clips

T = {5: 2.7764451, 6: 2.5705818}  # by number of episodes n: the quantile 0.975 of Student's t with n - 1 degrees
PROBES = ProbeOptions(ranking_clips=10, samples=12, landscape_clips=10, nodes=3, examples=0)


class TooShort(Oracle):
    """Predicts less motion than there is: a lower error than that of the base model, and a lower spread."""

    def predict(self, latents, actions, states, extrinsics=None):  # type: ignore[no-untyped-def]
        return super().predict(latents, actions * 0.6 + 0.002, states, extrinsics)


class TooLong(Oracle):
    """Predicts more motion than there is."""

    def predict(self, latents, actions, states, extrinsics=None):  # type: ignore[no-untyped-def]
        return super().predict(latents, actions * 1.7 + 0.004, states, extrinsics)


def measured(folder: Path, *, with_base: bool) -> dict[str, Any]:
    """Return the content of the metrics.json of an evaluation, written into a folder."""
    evaluated_models = [EvaluatedModel("base", "base", TooLong())] * with_base + [
        EvaluatedModel("adapter", "trained", TooShort())
    ]
    path = write_metrics(
        evaluate(evaluated_models, repeatable_clips(clips_batch()), about(), probes=PROBES), folder / METRICS_FILE
    )
    content: dict[str, Any] = json.loads(path.read_text())
    return content


def estimate(
    formula: Callable[[np.ndarray], np.ndarray], columns: Sequence[Sequence[float]], episode_ids: Sequence[str]
) -> tuple[float, float, float]:
    """Return a function of sums over clips with its interval, as docs/evaluation_reference.md describes it."""
    names, episode_of = np.unique(episode_ids, return_inverse=True)
    n = len(names)
    sums = np.stack([np.bincount(episode_of, weights=column) for column in columns])
    drawn = np.random.default_rng(0).integers(n, size=(2000, n))
    p = math.erfc(math.sqrt(n / (n - 1)) * T[n] / math.sqrt(2)) / 2
    low, high = np.quantile(formula(sums[:, drawn].sum(axis=2)), [p, 1 - p])
    return float(formula(sums.sum(axis=1))), float(low), float(high)


def mean(values: Sequence[float], episode_ids: Sequence[str]) -> tuple[float, float, float]:
    return estimate(lambda sums: sums[0] / sums[1], [values, np.ones(len(values))], episode_ids)


def percent(share: float) -> str:
    return f"{100 * share:.0f}" if share >= 0.0995 else f"{100 * share:.1f}"


def with_interval(value: float, low: float, high: float) -> tuple[str, str]:
    form = ".0f" if value >= 0.0995 else ".1f"
    return percent(value), f"[{100 * low:{form}}, {100 * high:{form}}]"


def recomputed(metrics: dict[str, Any]) -> dict[str, tuple[str, str, str]]:
    """Return statement, interval and reference of each verdict, from the measured arrays of a metrics.json."""
    ids = [episode for episode, _ in metrics["clips"]["named"]]
    name, base, by_clip = metrics["trained"], metrics["base"], metrics["by_clip"]
    about, models = metrics["about"], metrics["models"]
    ahead = f"{(about['frames'] - 1) * about['seconds_per_step']:.1f} s ahead"
    last = by_clip["last_horizon"]
    texts_by_verdict = {}

    def gain(metric: str, other: Sequence[float]) -> tuple[str, str]:
        return with_interval(*estimate(lambda sums: 1 - sums[0] / sums[1], [last[metric][name], other], ids))

    persistence = [clip[-1] for clip in by_clip["persistence"]]
    share, interval = gain("l1", last["l1"][base] if base else persistence)
    spread = models[name]["distribution"]["variance"][-1] / models[name]["distribution"]["true_variance"][-1]
    before, reference, reference_error = 1.0, "true latents", "that of persistence"
    if base:
        of_base, reference, reference_error = models[base]["distribution"], "base model", "the base model's"
        before = of_base["variance"][-1] / of_base["true_variance"][-1]
    texts_by_verdict["prediction"] = (
        f"{ahead}, error {share} % lower than {reference_error}",
        interval,
        f"(part of the gain may be blur: spread {spread:.2f}, {reference} {before:.2f})",
    )

    errors = by_clip["one_step"][name]
    cost = with_interval(*estimate(lambda sums: sums[0] / sums[1] - 1, [errors["shuffled"], errors["true"]], ids))
    texts_by_verdict["sensitivity"] = f"one-step error {cost[0]} % higher with shuffled actions", cost[1], ""

    ranking = models[name]["ranking"]
    error, interval = with_interval(*mean(ranking["ranks"], ranking["episode_ids"]))
    of_base = f"base model {percent(float(np.mean(models[base]['ranking']['ranks'])))} %, " if base else ""
    texts_by_verdict["ranking"] = f"action-ranking error {error} %", interval, f"({of_base}chance 50 %)"

    def landscape(model: str) -> tuple[tuple[float, float, float], float, float]:
        maps = models[model]["landscapes"]["maps"]
        chances, sharpness = [], []
        for energy_map in maps:
            points = np.stack(np.meshgrid(*energy_map["axes"], indexing="ij"), axis=-1).reshape(-1, 3)
            chances.append(np.linalg.norm(points - energy_map["true"], axis=1).mean())
            sharpness.append(np.ptp(energy_map["energy"]) / np.mean(energy_map["energy"]))
        distances = [math.dist(energy_map["minimum"], energy_map["true"]) for energy_map in maps]
        episodes = [energy_map["episode_id"] for energy_map in maps]
        return mean(distances, episodes), float(np.mean(chances)), float(np.mean(sharpness))

    (distance, low, high), chance, sharpness = landscape(name)
    texts = [f"random point {chance:.1f} cm", f"sharpness {sharpness:.2g}"]
    if base:
        of_base = landscape(base)
        texts = [f"base model {of_base[0][0]:.1f} cm", texts[0], f"{texts[1]}, base model {of_base[2]:.2g}"]
    statement = f"energy minimum {distance:.1f} cm from the true action"
    texts_by_verdict["landscape"] = statement, f"[{low:.1f}, {high:.1f}]", f"({'; '.join(texts)})"
    return texts_by_verdict


@pytest.mark.parametrize("with_base", [True, False])
def test_numpy_recomputes_every_number_of_the_summary_from_metrics_json(with_base: bool, tmp_path: Path) -> None:
    metrics, summary = measured(tmp_path, with_base=with_base), read_metrics(tmp_path).summary
    printed = " ".join(str(summary).split())
    for name, (statement, interval, reference) in recomputed(metrics).items():
        verdict = getattr(summary, name)
        assert (verdict.statement, verdict.interval, verdict.reference) == (statement, interval, reference)
        for text in (statement, interval, reference):
            assert not set(re.findall(r"[\d.]+", text)) - set(re.findall(r"[\d.]+", printed))


def test_the_conclusions_follow_from_paired_differences_in_metrics_json(tmp_path: Path) -> None:
    models, metrics = measured(tmp_path, with_base=True)["models"], read_metrics(tmp_path)
    ranks, base_ranks = (models[name]["ranking"]["ranks"] for name in ("adapter", "base"))
    ids = models["adapter"]["ranking"]["episode_ids"]
    maps, base_maps = (models[name]["landscapes"]["maps"] for name in ("adapter", "base"))
    distances = [
        math.dist(energy_map["minimum"], energy_map["true"]) - math.dist(base_map["minimum"], base_map["true"])
        for energy_map, base_map in zip(maps, base_maps, strict=True)
    ]
    for key, values, episode_ids in (
        ("ranking.difference_to_base", np.subtract(ranks, base_ranks), ids),
        ("landscapes.distance.difference_to_base", distances, [energy_map["episode_id"] for energy_map in maps]),
    ):
        row = metrics.of(key)
        assert row is not None
        assert (row.value, row.low, row.high) == pytest.approx(mean(values, episode_ids), abs=1e-6)
