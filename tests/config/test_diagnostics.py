"""Config errors: all are reported at once, also those hidden by other errors, and none that is wrong."""

import re
from typing import Any

import pytest

from vjepa2_ac.config.diagnostics import _ALSO_CALLED, all_keys
from vjepa2_ac.config.loading import config_from, parse_config
from vjepa2_ac.errors import InputError

MINIMAL = {"run_dir": "runs/x", "data": {"path": "d"}, "model": {"base": "b.pt"}}


def complaints(*overrides: str, values: dict[str, Any] | None = None) -> list[str]:
    """Return the lines of what is wrong."""
    with pytest.raises(InputError) as caught:
        config_from(MINIMAL if values is None else values, overrides, where="here")
    return [line.strip() for line in str(caught.value).splitlines() if line.startswith("  ")]


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        (["training.batch_size=0", "training.rollout_steps=16"], ["training.batch_size: ", "rollout_steps 16 needs"]),
        (["training.warmup_steps=5", "training.steps=3", "training.rollout_steps=16"], ["exceed", "rollout_steps 16"]),
        (["training.decay_steps=5", "training.smooth_l1_beta=2.0"], ["decay_steps belongs", "smooth_l1_beta belongs"]),
        (
            ["data.frames=1", "data.validation_share=0.97", "training.precision=fp32"],
            ["data.frames: ", "nothing to train on", "precision fp32 needs"],
        ),
        (["training.betas=[2, 0.9]", "data.join_actions=sum"], ["training.betas.0: ", "join_actions belongs"]),
        (["data.stride=100000000000", "training.batch_size=100000000000"], ["data.stride", "training.batch_size: "]),
        (["data.fields.state=[]", "data.fields.cameras={}"], ["data.fields.state: ", "data.fields.cameras: "]),
        (["data.stride=fast", "training.warmup_steps=999999"], ["data.stride: ", "exceed steps 100000"]),
        (["adapter=null", "training.decay_steps=999999"], ["adapter: ", "exceed steps 100000"]),
        (["model.random.image_size=50", "model.random.patch_size=0"], ["patch_size: ", "give either base"]),
    ],
)  # fmt: skip
def test_one_mistake_does_not_hide_another(wrong: list[str], expected: list[str]) -> None:
    found = complaints(*wrong)
    assert len(found) == len(expected), found
    for part in expected:
        assert any(part in line for line in found), (part, found)


def test_what_is_lacking_does_not_hide_anything_either() -> None:
    values = {"data": {"camera": "third_eye"}, "model": {}, "training": {"rollout_steps": 16}}
    found = complaints(values=values)
    assert len(found) == 5, found
    for part in ("run_dir: missing", "data.path: missing", "model: give either base", "third_eye", "rollout_steps 16"):
        assert any(part in line for line in found), part


@pytest.mark.parametrize(
    "wrong",
    [
        ["training.steps=0", "training.warmup_steps=200000"],  # would 200,000 exceed what was meant by steps?
        ["data.frames=many", "training.rollout_steps=20"],
        ["data.frame=32", "training.rollout_steps=20"],  # frames was meant
        ["data.num_frames=32", "training.rollout_steps=20"],
        ["data.source=droid_row", "data.camera=ext1"],
        ["data.fields.cameras=1", "data.camera=third_eye"],
        ["data.fields.cameras={a: 1}"],
        ["data.stride=0", "data.states=vector", "data.actions=recorded"],
        ["model.random.encoder.width=no", "model.random.encoder.heads=352", "model.base=null", "adapter.kind=none"],
    ],
)  # fmt: skip
def test_nothing_is_said_that_may_be_untrue_once_the_mistake_is_gone(wrong: list[str]) -> None:
    for line in complaints(*wrong):
        assert line.startswith(wrong[0].split("=")[0]), line


@pytest.mark.parametrize(
    ("unknown", "meant"),
    [
        ("training.lr", "learning_rate"),
        ("training.epochs", "steps"),
        ("training.max_steps", "steps"),
        ("training.num_workers", "data.workers"),
        ("lr", "training.learning_rate"),
        ("adapter.r", "rank"),
        ("data.strid", "stride"),
        ("output_dir", "run_dir"),
        ("training.rank", "adapter.rank"),
        ("data.mix", "replay"),
    ],
)
def test_an_unknown_key_is_told_the_one_that_was_meant(unknown: str, meant: str) -> None:
    assert complaints(f"{unknown}=1") == [f"{unknown}: unknown key; did you mean {meant}?"]


def test_a_key_like_no_other_is_told_those_that_there_are() -> None:
    (line,) = complaints("tracking.zzz=1")
    assert re.search(r"known here: tensorboard, wandb", line)


def test_other_names_are_those_of_keys_and_of_none_themselves() -> None:
    names = [name for names in _ALSO_CALLED.values() for name in names]
    assert set(_ALSO_CALLED) <= set(all_keys())
    assert len(names) == len(set(names))
    for key, others in _ALSO_CALLED.items():
        section = key.rpartition(".")[0]
        assert not {f"{section}.{name}".lstrip(".") for name in others} & set(all_keys())


def test_a_config_that_is_right_is_read() -> None:
    assert parse_config(MINIMAL, where="here").run_dir == "runs/x"


@pytest.mark.parametrize(
    ("wrong", "line"),
    [
        ("data.stride=fast", "data.stride: Input should be a valid integer, or 'auto' (found 'fast')"),
        ("data.stride=0", "data.stride: Input should be greater than or equal to 1, or 'auto' (found 0)"),
        ("data.camera=1.5", "data.camera: Input should be a valid string, or a list (found 1.5)"),
        ("data.camera=[a, 1.5]", "data.camera.1: Input should be a valid string (found 1.5)"),
        ("adapter.targets=q", "adapter.targets: Input should be a list (found 'q')"),
        ("training.betas=[0.5]", "training.betas: List should have at least 2 items"),
        ("training.betas=[0.1, 0.2, 0.3]", "training.betas: List should have at most 2 items, not 3"),
        ("adapter.peft=3", "adapter.peft: Input should be a mapping of keys to values (found 3)"),
    ],
)
def test_what_is_wrong_is_said_once_without_the_inner_names_of_pydantic(wrong: str, line: str) -> None:
    (found,) = complaints(wrong)
    assert found.startswith(line)
    for inner in (
        "function-before",
        "constrained",
        "literal[",
        "tuple[",
        "array",
        "object",
        "dict",
        "after validation",
    ):
        assert inner not in found


def test_a_flood_of_mistakes_is_told_in_part() -> None:
    found = complaints(
        values=MINIMAL | {"x" * 1_000_000 + str(n): n for n in range(3)} | {f"k{n}": n for n in range(5000)}
    )
    assert len(found) == 31
    assert max(map(len, found)) < 500
    assert "and more" in found[-1]
