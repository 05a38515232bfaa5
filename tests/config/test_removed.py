"""Configs with keys of version 0.1: the config of an older run loads; in any other config such a key is an error."""

import logging

import pytest

from vjepa2_ac.config.loading import all_keys, config_as_dict, parse_config
from vjepa2_ac.config.removed import REMOVED, RemovedKey
from vjepa2_ac.errors import InputError

VALUES = {"run_dir": "run", "data": {"source": "npz", "path": "data"}, "model": {"base": "builtin:sim-tiny"}}


@pytest.fixture(autouse=True)
def removed_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(REMOVED, "training.momentum", RemovedKey("0.9", (0.9,)))
    monkeypatch.setitem(REMOVED, "data.blur", RemovedKey("off", ({"radius": 0},)))


def test_removed_key_in_a_user_config_raises_with_the_current_value() -> None:
    with pytest.raises(InputError, match=r"training.momentum: removed in 0.2; it is always 0.9 now. Delete the key"):
        parse_config({**VALUES, "training": {"momentum": 0.9}}, where="mine.yaml")


@pytest.mark.parametrize("value", [0.9, 0.5])
def test_config_of_an_older_run_loads_with_a_warning_for_a_changed_value(
    value: float, caplog: pytest.LogCaptureFixture
) -> None:
    older = {**VALUES, "training": {"momentum": value}}
    with caplog.at_level(logging.WARNING):
        config = parse_config(older, where="run/config.yaml", local_plugins=False)
    assert config == parse_config(VALUES, where="today")
    assert [record.getMessage() for record in caplog.records] == [
        "run/config.yaml: training.momentum was 0.5; this version always uses 0.9"
    ] * (value != 0.9)


def test_removed_section_of_data_is_dropped_from_replay() -> None:
    replay = {"data": {"source": "npz", "path": "other", "blur": {"radius": 0}}}
    older = {**VALUES, "data": {"source": "npz", "path": "data", "blur": {"radius": 0}}, "replay": replay}
    values = config_as_dict(parse_config(older, where="run/config.yaml", local_plugins=False))
    assert "blur" not in values["data"]
    assert "blur" not in values["replay"]["data"]


def test_model_section_of_version_0_1_loads_as_the_current_section() -> None:
    scratch, sizes = {**VALUES, "adapter": {"kind": "none"}}, {"predictor": {"width": 64, "depth": 2, "heads": 4}}
    older = {"base": None, "random": sizes, "encoder_weights": "target_encoder", "random_start": "persistence"}
    config = parse_config({**scratch, "model": older}, where="run/config.yaml", local_plugins=False)
    assert config == parse_config({**scratch, "model": {"base": "random", "sizes": sizes}}, where="today")


def test_removed_keys_do_not_exist_in_the_current_config() -> None:
    assert not set(REMOVED) & set(all_keys())


def test_options_of_an_older_run_move_to_their_components() -> None:
    planning = {
        "planner": "icem",
        "planner_options": {},
        "cem": {"elites": 10, "answer": "mean"},
        "icem": {"elites": 20, "kept": 0.3},
        "mppi": {"temperature": 0.1},
        "energy": {"distance": "l2", "options": {}},
        "replan": "always",
    }
    older = {
        **VALUES,
        "training": {"loss": "smooth_l1", "loss_options": {}, "smooth_l1_beta": 0.5},
        "planning": planning,
    }
    today = {
        "training": {"loss": {"name": "smooth_l1", "options": {"beta": 0.5}}},
        "planning": {"planner": {"name": "icem", "options": {"elites": 20}}, "energy": {"distance": "l2"}},
    }
    configs = [
        parse_config(values, where="run/config.yaml", local_plugins=False) for values in (older, {**VALUES, **today})
    ]
    assert configs[0] == configs[1]
    changed = parse_config(older, ["planning.planner.options.elites=30"], where="run/config.yaml", local_plugins=False)
    assert changed.planning.planner.options == {"elites": 30}
    with pytest.raises(InputError, match=r"planning.icem: moved in 0.2, to planning.planner: {name: icem, options"):
        parse_config(older, where="mine.yaml")


@pytest.mark.parametrize(
    ("limits", "l1", "warnings"),
    [
        ({"ball": "none", "radius": 0.08}, None, []),
        ({"ball": "l1", "radius": 0.075}, 0.075, []),
        (
            {"ball": "l2", "radius": 0.06},
            0.06,
            ["run/config.yaml: planning.limits.ball was l2; this version uses the stricter planning.limits.l1: 0.06"],
        ),
    ],
)
def test_norm_ball_of_an_older_run_becomes_a_limit_that_is_not_looser(
    limits: dict[str, object], l1: float | None, warnings: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    older = {**VALUES, "planning": {"limits": limits}}
    config = parse_config(older, where="run/config.yaml", local_plugins=False)
    assert config.planning.limits.l1 == l1
    assert [record.getMessage() for record in caplog.records] == warnings
    with pytest.raises(InputError, match=r"planning.limits.ball: moved in 0.2, to planning.limits.l1: METRES"):
        parse_config(older, where="mine.yaml")


def test_start_std_of_an_older_run_moves_to_the_planner_or_is_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    cem, gradient = (
        parse_config(
            {**VALUES, "planning": {"planner": name, "start_std": 0.5}}, where="run/config.yaml", local_plugins=False
        )
        for name in ("cem", "gradient")
    )
    assert cem.planning.planner.options == {"start_std": 0.5}
    assert gradient.planning.planner.options == {}
    assert [record.getMessage() for record in caplog.records] == [
        "run/config.yaml: planning.start_std was 0.5; the planner gradient has no such option, and uses 1"
    ]


@pytest.mark.parametrize(
    "values",
    [
        {"planning": {"planner": {"name": ["cem"]}}},
        {"planning": {"planner": "cem", "cem": 3, "start_std": 0.5, "limits": 3}},
        {"training": {"schedule": "linear", "steps": "100"}},
        {"data": {**VALUES["data"], "fields": {"gripper": ["closedness"]}}},
    ],
)
def test_values_of_wrong_type_in_the_config_of_an_older_run_raise(values: dict[str, object]) -> None:
    with pytest.raises(InputError, match=r"run/config\.yaml"):
        parse_config({**VALUES, **values}, where="run/config.yaml", local_plugins=False)


@pytest.mark.parametrize(
    ("training", "decay_steps"),
    [({}, 99_000), ({"steps": 200}, 180), ({"steps": 200, "warmup_steps": 50}, 150)],
)
def test_linear_schedule_without_steps_decays_from_the_warm_up_to_the_last_step(
    training: dict[str, int], decay_steps: int
) -> None:
    config = parse_config({**VALUES, "training": {"schedule": "linear", **training}}, where="mine.yaml")
    assert (config.training.schedule, config.training.decay_steps) == ("warmup_stable_decay", decay_steps)


def test_component_options_are_set_with_overrides() -> None:
    config = parse_config(VALUES, ["planning.planner=icem", "planning.planner.options.elites=20"], where="mine.yaml")
    assert config_as_dict(config)["planning"]["planner"] == {"name": "icem", "options": {"elites": 20}}
    default = parse_config(VALUES, ["planning.planner.options.elites=10"], where="mine.yaml")
    assert config_as_dict(default)["planning"]["planner"] == "cem", "an option with its default value must not be saved"
    with pytest.raises(InputError, match=r"planning.planner.options.elite: unknown key; did you mean elites"):
        parse_config(VALUES, ["planning.planner.options.elite=20"], where="mine.yaml")
    with pytest.raises(InputError, match=r"planning.planner: Input should be a name, or {name: NAME, options"):
        parse_config(VALUES, ["planning.planner={elites: 20}"], where="mine.yaml")


def test_removed_key_in_an_override_of_a_run_raises() -> None:
    for override, words in {
        "training.momentum=0.9": "removed in 0.2; it is always 0.9 now",
        "planning.cem.elites=5": "moved in 0.2, to planning.planner",
        "planning.limits.radius=0.05": "moved in 0.2, to planning.limits.l1",
    }.items():
        with pytest.raises(InputError, match=words):
            parse_config(VALUES, [override], where="run/config.yaml", local_plugins=False)
