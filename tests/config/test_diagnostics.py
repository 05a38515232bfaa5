"""Config errors: all wrong values are reported at once, each with its key."""

import re
from typing import Any

import pytest

from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.errors import InputError

MINIMAL = {"run_dir": "runs/x", "data": {"path": "d"}, "model": {"base": "b.pt"}}


def error_lines(*overrides: str, values: dict[str, Any] | None = None) -> list[str]:
    """Return the lines of the error, one per wrong value."""
    with pytest.raises(InputError) as caught:
        parse_config(MINIMAL if values is None else values, overrides, where="here")
    return [line.strip() for line in str(caught.value).splitlines() if line.startswith("  ")]


def test_all_config_errors_are_reported_together_with_their_keys() -> None:
    values = {"data": {"path": "d", "strid": 4, "frames": 1}, "model": {"base": "b"}, "training": {"rank": 8}}
    assert error_lines("training.learning_rate=fast", "data.stride=0", values=values) == [
        "run_dir: missing; it has no default",
        "data.frames: Input should be greater than or equal to 2 (found 1)",
        "data.stride: Input should be greater than or equal to 1, or Input should be 'auto' (found 0)",
        "data.strid: unknown key; did you mean stride?",
        "training.learning_rate: Input should be a valid number (found 'fast')",
        "training.rank: unknown key; did you mean adapter.rank?",
    ]


def test_rules_between_values_are_checked_when_each_value_is_valid() -> None:
    lines = error_lines("training.decay_steps=5", "data.validation_share=0.97")
    assert any("nothing to train on" in line for line in lines)
    assert any("decay_steps is only for" in line for line in lines)
    assert "rollout_steps 16 needs data.frames" in error_lines("training.rollout_steps=16")[0]


@pytest.mark.parametrize(
    ("unknown", "suggestion"),
    [
        ("data.strid", "stride"),
        ("training.rank", "adapter.rank"),
        ("dat", "data"),
    ],
)
def test_unknown_key_error_suggests_the_closest_key(unknown: str, suggestion: str) -> None:
    assert error_lines(f"{unknown}=1") == [f"{unknown}: unknown key; did you mean {suggestion}?"]


def test_mistyped_camera_gets_a_suggestion() -> None:
    (line,) = error_lines("data.camera=wrist_lef")
    assert re.search(r"has no camera wrist_lef\. Did you mean wrist_left\? Available: .*exterior_1_left", line)


def test_unknown_key_error_lists_existing_keys_without_a_close_match() -> None:
    (line,) = error_lines("tracking.zzz=1")
    assert re.search(r"available: tensorboard, wandb", line)


@pytest.mark.parametrize(
    ("wrong", "line"),
    [
        ("data.stride=fast", "data.stride: Input should be a valid integer, or Input should be 'auto' (found 'fast')"),
        (
            "data.stride=0",
            "data.stride: Input should be greater than or equal to 1, or Input should be 'auto' (found 0)",
        ),
        ("data.camera=1.5", "data.camera: Input should be a valid string, or Input should be a list (found 1.5)"),
        ("adapter.targets=q", "adapter.targets: Input should be a list (found 'q')"),
        ("data.fields.cameras=3", "data.fields.cameras: Input should be a mapping of keys to values (found 3)"),
    ],
)
def test_wrong_value_is_reported_once_without_pydantic_type_names(wrong: str, line: str) -> None:
    (reported,) = error_lines(wrong)
    assert reported.startswith(line)
