"""Every pair of planning options works in every planning command, or raises before the first decision."""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from decisions import STATE, image
from tiny_models import DIM, TOKENS, tiny_model
from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.config.section import collect_effects
from vjepa2_ac.errors import InputError
from vjepa2_ac.model import compilation
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.decision import PlanRequest, decide
from vjepa2_ac.planning.goals import make_timed_goals
from vjepa2_ac.policies.action_prior import ActionPrior, PriorCard, PriorSizes, save_prior
from vjepa2_ac.policies.monitor import Monitor
from vjepa2_ac.runs.subject import Subject


def planner(name: str, **options: Any) -> dict[str, Any]:
    """Return a planner with options, and with few elites."""
    return {"name": name, "options": {**({"elites": 2} if name in {"cem", "icem"} else {}), **options}}


SIDE = 16  # pixels of a view: the model scales every image
BASE: dict[str, Any] = {"horizon": 2, "samples": 4, "iterations": 1, "planner": planner("cem")}
# For each key, a value that is neither the default nor that of BASE, with the keys that it requires.
OTHERS: dict[str, Any] = {
    "planner": {"planner": planner("icem")},
    "horizon": 4,
    "action_repeat": 2,
    "samples": 6,
    "iterations": 2,
    "budget_s": 1e-6,
    "prior": "PRIOR",
    "monitor": "MONITOR",
    "warm_start": True,
    "views": 2,
    "compile": "blocks",
    "axes": "AXES",
    "limits.xyz": [0.02, 0.0, 0.03],
    "limits.l1": 0.03,
    "limits.workspace": [[0.38, -0.02, 0.28], [0.41, 0.02, 0.31]],
    "limits.rotation": 0.1,
    "limits.axes": [0.1],
    "limits.gripper": 0.0,
    "limits.gripper_mode": "held",
    "energy.distance": "cosine",
    "energy.steps": "sum",
    "energy.samples_at_once": 3,
}
# Other planners with their options, inputs that a caller passes with a frame, and a planner that needs an option.
MORE: dict[str, Any] = {
    **{
        f"{name}.{option}": {"planner": planner(name, **{option: value})}
        for name, option, value in (
            ("cem", "momentum_mean", 0.5),
            ("cem", "try_mean", True),
            ("cem", "start_std", 0.5),
            ("icem", "noise_exponent", 0.0),
            ("icem", "kept", 1.0),
            ("mppi", "temperature", 1.0),
            ("gradient", "starts", 2),
        )
    },
    "planner=prior": {"planner": "prior", "prior": "PRIOR"},
    "mask": {},
    "samples of a policy": {},
}
# Options that skip parts of a decision. Each of their pairs is tested alone; all other pairs are tested in groups.
ALONE = {"budget_s", "samples of a policy"}
REFUSED = {
    *(frozenset({"views", other}) for other in ("axes", "prior", "planner=prior", "monitor")),
    *(frozenset({"warm_start", other}) for other in ("prior", "planner=prior")),
}


@dataclass
class SharedFiles:
    """The model and the files that the tests of all pairs share."""

    model: WorldModel
    files: dict[str, str]

    def planning(self, *names: str) -> dict[str, Any]:
        """Return the values of some options, with the keys that they require."""
        planning: dict[str, Any] = {}
        for key, value in [*BASE.items(), *(pair for name in names for pair in get_entries(name).items())]:
            section, _, inner = key.rpartition(".")
            (planning.setdefault(section, {}) if section else planning)[inner] = self.files.get(str(value), value)
        return planning

    def config(self, *names: str) -> Config:
        """Return the config with some options.

        Raises:
            InputError: The options exclude each other.
        """
        planning = self.planning(*names)
        try:  # faster than parse_config, which gives the error message
            update = {"planning": PlanningConfig.model_validate_json(json.dumps(planning))}
            return CONFIG.model_copy(update=update)
        except ValidationError:
            return parse_config(VALUES | {"planning": planning}, where="test")


VALUES = {"run_dir": "r", "data": {"path": "d", "stride": 4}, "model": {"base": "b"}}
CONFIG = parse_config(VALUES, where="test")


def get_entries(name: str) -> dict[str, Any]:
    value = (OTHERS | MORE)[name]
    return value if isinstance(value, dict) else {name: value}


@pytest.fixture(scope="module")
def shared_files(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SharedFiles]:
    folder, model = tmp_path_factory.mktemp("files"), tiny_model(depth=1)
    fingerprints = model.merged_from = model.fingerprints()  # hashed once
    monitor = Monitor(
        "vjepa2-ac monitor 1", 1e6, 0.1, 8, (1.0,), (0.0,) * TOKENS, fingerprints.encoder, fingerprints.predictor
    )
    (folder / "monitor.json").write_text(json.dumps(asdict(monitor)))
    model_record = {"subject": "tiny", "encoder": fingerprints.encoder, "predictor": fingerprints.predictor}
    axes = {"format": 1, "yaw_degrees": {"value": 43.0}, "problem": None, "model": model_record}
    (folder / "axes.json").write_text(json.dumps(axes))
    sizes = PriorSizes(grid=3, dim=DIM, state=7, action=7, ahead=3)
    save_prior(
        folder / "prior",
        PriorCard("vjepa2-ac prior 1", sizes, fingerprints.encoder, "released", "", 0),
        ActionPrior(sizes),
    )
    files = {"MONITOR": "monitor.json", "AXES": "axes.json", "PRIOR": "prior"}
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(compilation, "describe_missing_compiler", lambda _: None)
        with torch.compiler.set_stance("force_eager"):
            yield SharedFiles(model, {name: str(folder / file) for name, file in files.items()})


def plan_with_options(shared_files: SharedFiles, *names: str) -> None:
    """Make two decisions with some options, and run `plan` and `score`."""
    config = shared_files.config(*names)
    planning, controller = config.planning, Controller.of_subject(Subject("tiny", config, shared_files.model))
    images = [image(seed, SIDE, SIDE * planning.views) for seed in range(4)]
    goals, chunks = make_timed_goals(images[2:], (1,)), None
    mask = np.arange(SIDE * SIDE * planning.views).reshape(SIDE, -1) % 3 > 0 if "mask" in names else None
    if "samples of a policy" in names:
        chunks = np.random.default_rng(0).normal(0, 0.01, (3, planning.horizon, 7))
    controller.follow(goals, mask=mask)
    assert np.isfinite([controller.act(frame, STATE, samples=chunks) for frame in images[:2]]).all()
    assert np.isfinite(controller.score(images[0], STATE, np.full((2, 3, 7), 0.01)).energies).all()
    if chunks is None:
        assert np.isfinite(decide(controller, PlanRequest(images[0], STATE, goals, mask), nodes=0).actions).all()


def test_every_option_is_varied(shared_files: SharedFiles) -> None:
    keys = {key.removeprefix("planning.") for key in collect_effects(Config) if key.startswith("planning.")}
    assert set(OTHERS) == keys, "add a value for the new key to OTHERS"
    default_config = shared_files.config()
    for name in OTHERS:
        assert shared_files.config(name) != default_config


def test_every_pair_of_options_works_or_raises_before_the_first_decision(shared_files: SharedFiles) -> None:
    refused, compatible = set(), {name: set[str]() for name in OTHERS | MORE}
    for first, second in combinations(OTHERS | MORE, 2):
        shared = get_entries(first).keys() & get_entries(second).keys()
        if any(get_entries(first)[key] != get_entries(second)[key] for key in shared):
            continue  # two values of one option
        try:
            shared_files.config(first, second)
        except InputError:
            refused.add(frozenset({first, second}))
            continue
        compatible[first].add(second)
        compatible[second].add(first)
    assert refused == REFUSED
    pairs = [frozenset(pair) for pair in combinations(compatible, 2) if pair[1] in compatible[pair[0]]]
    alone = [sorted(pair) for pair in pairs if pair & ALONE]
    for names in [*alone, *group_pairs([pair for pair in pairs if not pair & ALONE], compatible)]:
        try:
            plan_with_options(shared_files, *names)
        except Exception as error:
            raise AssertionError(f"{', '.join(names)}: {shared_files.planning(*names)}") from error


def group_pairs(pairs: list[frozenset[str]], compatible: dict[str, set[str]], at_most: int = 8) -> Iterator[list[str]]:
    """Yield groups of compatible options that contain all pairs."""
    while pairs:
        group = sorted(pairs[0])
        names = {name for pair in pairs for name in pair}
        for name in sorted(names, key=lambda name: (-sum({name, member} in pairs for member in group), name)):
            if len(group) < at_most and all(name in compatible[member] for member in group):
                group.append(name)
        pairs = [pair for pair in pairs if not pair <= {*group}]
        yield group
