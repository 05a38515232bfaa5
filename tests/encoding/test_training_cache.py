"""Training on cached latents equals training from frames: bit for bit in fp32, within rounding otherwise."""

from pathlib import Path
from typing import Any

import pytest
import torch

from latent_sets import encode_for
from same_run import assert_same_run, metrics
from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.evaluate_run import evaluate_subject
from vjepa2_ac.evaluation.request import EvaluationOptions, ProbeOptions
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.reports.metrics_json import metrics_as_dict
from vjepa2_ac.training.loop import train


class KilledError(Exception):
    """Simulates the end of the process."""


def encoded(config: Config) -> Path:
    """Encode the data set of a config and return the folder of the cache."""
    dataset = open_dataset(config.data)
    return encode_for(config, load_base(config.model, seed=config.seed), dataset)


def of_cache(folder: Path, **changes: Any) -> dict[str, Any]:
    """Return the changes that make a config of a cache without its data set."""
    return {"data__source": "latents", "data__path": str(folder)} | changes


KINDS = {
    "as it is": {},
    "two cameras, one phase": {"data__camera": ("exterior_1_left", "wrist_left"), "data__start_every": 2},
    "bf16 arithmetic": {"training__precision": "bf16"},
}


@pytest.mark.parametrize("changes", KINDS.values(), ids=KINDS)
def test_training_on_an_exact_cache_is_training_on_the_fly_bit_for_bit(
    make_config, reporter, tmp_path, changes
) -> None:
    changes = changes | {"data__cache_dtype": "fp32", "data__cache_dir": str(tmp_path / "caches"), "training__steps": 3}
    on_the_fly = make_config(run_dir=str(tmp_path / "fly"), **changes)
    train(on_the_fly, reporter)
    folder = encoded(on_the_fly)
    train(make_config(run_dir=str(tmp_path / "cached"), **(changes | of_cache(folder))), reporter)
    assert_same_run(tmp_path / "fly", tmp_path / "cached")
    train(make_config(run_dir=str(tmp_path / "through"), **(changes | {"data__cache": "require"})), reporter)
    assert_same_run(tmp_path / "fly", tmp_path / "through")


@pytest.mark.parametrize(("kind", "most"), [("bf16", 2e-3), ("int8", 1e-2)])
def test_training_on_a_rounded_cache_differs_by_what_is_rounded_off(
    make_config, reporter, tmp_path, kind, most
) -> None:
    changes = {"data__cache_dtype": kind, "data__cache_dir": str(tmp_path / "caches"), "training__steps": 2}
    on_the_fly = make_config(run_dir=str(tmp_path / "fly"), **changes)
    train(on_the_fly, reporter)
    folder = encoded(on_the_fly)
    train(make_config(run_dir=str(tmp_path / "cached"), **(changes | of_cache(folder))), reporter)
    pairs = zip(metrics(tmp_path / "fly"), metrics(tmp_path / "cached"), strict=True)
    losses = [(one["loss"], other["loss"]) for one, other in pairs if one["kind"] == "train"]
    assert losses
    assert all(0 < abs(one / other - 1) < most for one, other in losses)


def test_a_run_on_frames_is_resumed_on_a_cache(make_config, reporter, tmp_path, whole_run) -> None:
    changes = {"data__cache_dtype": "fp32", "data__cache_dir": str(tmp_path / "caches")}
    encoded(make_config(**changes))
    dying = type(reporter)()

    def die_at_three(step: int, seen: object) -> None:
        del seen
        if step == 3:
            raise KilledError

    dying.stepped = die_at_three
    with pytest.raises(KilledError):
        train(make_config(run_dir=str(tmp_path / "broken"), **changes), dying)
    cached = make_config(run_dir=str(tmp_path / "broken"), **(changes | {"data__cache": "require"}))
    train(cached, reporter, allow_config_change=True)
    assert_same_run(whole_run, tmp_path / "broken")


def test_a_cache_of_another_encoder_stops_a_run_before_the_first_step(make_config, reporter, tmp_path) -> None:
    folder = encoded(make_config(data__cache_dir=str(tmp_path / "caches")))
    other = tmp_path / "other"
    base = WorldModel.from_pretrained(Path(make_config().model.base))
    sizes = ModelSizes.model_validate(base.sizes.model_dump())
    WorldModel.random(sizes, seed=99).save_pretrained(other)
    for changes, reported in (
        ({"model__base": str(other)}, "encoder: "),
        ({"training__precision": "bf16"}, r"training\.precision: "),
    ):
        with pytest.raises(InputError, match=f"made otherwise: {reported}"):
            train(make_config(**of_cache(folder, **changes)), reporter)
    assert reporter.steps == []


def test_encoding_more_frames_at_once_changes_nothing_but_the_order_of_sums(make_config) -> None:
    """So a cache need not name its chunk. AMD's processors sum alike, Intel's do not."""
    for dtype, rounding in ((torch.float32, 1e-5), (torch.bfloat16, 2e-2)):
        model = WorldModel.from_pretrained(Path(make_config().model.base), dtype)
        frames = torch.randn(1, 19, 3, 32, 32, generator=torch.Generator().manual_seed(0))
        whole = model.encode(frames, chunk=19)
        for chunk in (1, 2, 3, 8, 16):
            torch.testing.assert_close(model.encode(frames, chunk=chunk), whole, rtol=0, atol=rounding)


def test_a_run_is_evaluated_from_its_cache_as_from_its_data(make_config, reporter, tmp_path) -> None:
    changes = {"data__cache_dtype": "fp32", "data__cache_dir": str(tmp_path / "caches"), "training__steps": 2}
    config = make_config(run_dir=str(tmp_path / "run"), data__cache="auto", **changes)
    train(config, reporter)
    probes = ProbeOptions(ranking_clips=2, samples=4, landscape_clips=1, nodes=3, examples=1)
    asked = EvaluationOptions(clips=6, probes=probes)
    folder = next((tmp_path / "caches").iterdir())
    from_cache = evaluate_subject(str(tmp_path / "run"), asked)
    folder.rename(tmp_path / "elsewhere")
    from_data = evaluate_subject(str(tmp_path / "run"), asked)
    found = [metrics_as_dict(one) for one in (from_cache, from_data)]
    assert [examples.frames is not None for examples in from_cache.examples] == [True] * len(from_data.examples)
    for cached, original in zip(from_cache.examples, from_data.examples, strict=True):
        difference = cached.frames.astype(float) - original.frames
        assert abs(difference).mean() < 12  # small and JPEG, but the same frames
    for one in found:
        one.pop("about")
    assert found[0] == found[1]
