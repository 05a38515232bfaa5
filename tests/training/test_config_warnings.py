"""Warnings about camera, model step, schedule and validation, before the first step."""

import pytest

from run_fixtures import set_up
from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.training.config_warnings import is_wrist_camera, list_config_warnings

RELEASED, TINY = "checkpoints/vjepa2-ac-vitg.pt", "builtin:sim-tiny"


def make(base: str = TINY, **changes: object) -> Config:
    values: dict[str, dict[str, object]] = {
        "data": {"path": "data", "camera": "exterior_1_left", "stride": 4},
        "model": {"base": base, "dtype": "float32"},
        "adapter": {"kind": "none" if base == "random" else "lora"},
        "training": {"steps": 400, "precision": "fp32"},
        "validation": {"every": 100},
        "checkpoint": {},
    }
    for key, value in changes.items():
        section, _, name = key.partition("__")
        values[section][name] = value
    return parse_config({"run_dir": "run", **values}, where="test")


@pytest.mark.parametrize("base", [RELEASED, f"elsewhere/{RELEASED}", TINY, "models/mine", "random"])
def test_config_as_in_the_released_recipe_causes_no_warning(base: str) -> None:
    assert list_config_warnings(make(base), 15.0) == []


@pytest.mark.parametrize(
    ("name", "is_wrist"),
    [
        ("wrist_left", True), ("observation_images_wrist", True), ("eih", True), ("hand_camera", True),
        ("exterior_1_left", False), ("front", False), ("frames", False), ("top", False),
    ],
)  # fmt: skip
def test_wrist_cameras_are_recognised_by_name(name: str, *, is_wrist: bool) -> None:
    assert is_wrist_camera(name) == is_wrist


@pytest.mark.parametrize(("base", "is_known"), [(RELEASED, True), (TINY, True), ("models/mine", False)])
def test_wrist_camera_is_reported_for_base_models_with_known_cameras(base: str, *, is_known: bool) -> None:
    warnings = list_config_warnings(make(base, data__camera=["exterior_1_left", "wrist_left"]), 15.0)
    assert [warning.startswith("data.camera: wrist_left seems") for warning in warnings] == [True] * is_known


@pytest.mark.parametrize(
    ("base", "stride", "rate_hz", "fix"),
    [
        (TINY, 8, 15.0, "data.stride=4"), (TINY, 2, 15.0, "data.stride=4"), (TINY, 8, 30.0, None), (TINY, 1, 5.0, None),
        (RELEASED, 8, 15.0, None), (RELEASED, 15, 15.0, None), (RELEASED, 30, 15.0, "data.stride=15"),
        (RELEASED, 1, 15.0, "data.stride=4"), (RELEASED, 1, 0.5, "no closer step"), ("models/mine", 30, 15.0, None),
        (TINY, 8, None, None), (RELEASED, "auto", 15.0, None),
    ],
)  # fmt: skip
def test_model_step_outside_the_training_of_the_base_model_is_reported(
    base: str, stride: int | str, rate_hz: float | None, fix: str | None
) -> None:
    warnings = list_config_warnings(make(base, data__stride=stride), rate_hz)
    assert len(warnings) == (fix is not None)
    if fix is not None:
        assert warnings[0].startswith("data.stride: ")
        assert fix in warnings[0]


@pytest.mark.parametrize("base", [TINY, "models/mine", "random"])
def test_schedule_that_ends_within_the_warm_up_is_reported(base: str) -> None:
    (warning,) = list_config_warnings(make(base, training__warmup_steps=400), 15.0)
    assert warning.startswith("training.warmup_steps: 400 is not below training.steps 400")
    assert "training.warmup_steps=40," in warning
    assert list_config_warnings(make(base, training__warmup_steps=399), 15.0) == []


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"checkpoint__keep_best": "off"}, "checkpoint.keep_best: off"),
        ({"checkpoint__keep_best": "error", "validation__ranking_clips": 0}, "validation.ranking_clips: 0"),
        ({"validation__every": 400}, "validation.every: 400"),
    ],
)
def test_fine_tuning_without_validation_is_reported_once(changes: dict[str, object], key: str) -> None:
    (warning,) = list_config_warnings(make(**changes), 15.0)
    assert warning.startswith(key)
    assert list_config_warnings(make("random", **changes), 15.0) == []


def test_training_prints_the_warnings_before_the_first_step(make_config, reporter) -> None:
    set_up(make_config(validation__every=6, training__warmup_steps=6), reporter)
    warnings = [note for note in reporter.notes if note.startswith("Warning: ")]
    assert any(note.startswith("Warning: training.warmup_steps: 6") for note in warnings)
    assert any(note.startswith("Warning: validation.every: 6") for note in warnings)
