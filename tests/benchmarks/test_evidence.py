"""The evidence compares what it says it compares, and its table says what was measured."""

import itertools
import json
import sys
from collections.abc import Iterator
from dataclasses import asdict, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from paths import ROOT
from vjepa2_ac.config import ValidationConfig
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.policies.train_prior import PriorOptions, train_prior
from vjepa2_ac.simulation.domains import DOMAIN_A
from vjepa2_ac.simulation.record import RecordingSpec
from vjepa2_ac.simulation.worlds import TRIES

pytest.importorskip("mujoco")


MODULES = ("other_worlds", "cells", "prepare", "offline", "measure", "results", "plot", "table")


@pytest.fixture
def evidence(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The modules of benchmarks/evidence."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks/evidence"))
    yield SimpleNamespace(**{name: import_module(name) for name in MODULES})
    for name in MODULES:
        sys.modules.pop(name, None)


def test_cells_have_names_of_their_own_and_hold_all_that_is_to_be_compared(evidence: Any) -> None:
    cells = list(evidence.cells.all_cells(at_most=5))
    assert len({cell.name for cell in cells}) == len(set(cells)) == len(cells)
    assert not any("/" in cell.name for cell in cells), "names of files"
    for base in ("one camera", "many cameras"):
        main = {
            cell.method for cell in cells if cell.shift == "look" and cell.base == base and cell.episodes in (0, 20)
        }
        methods = evidence.cells.METHODS.items()
        of_arm = {name for name, method in methods if method.kind not in {"scratch", "cloned"}}
        elsewhere = {evidence.cells.BEFORE, evidence.cells.LONGER, evidence.cells.FROM_PRIOR} | (
            set(evidence.cells.ROLLOUTS) if base == "one camera" else set()
        )
        assert main == of_arm - elsewhere
    of_best = [cell for cell in cells if cell.method == evidence.cells.BEST]
    assert {cell.episodes for cell in of_best if cell.shift == "look"} == {10, 20, 40}
    assert {cell.episodes for cell in of_best if cell.shift == "Lift"} == {5, 20, 80}
    everywhere = set(evidence.cells.IN_EVERY_WORLD)
    before = {evidence.cells.BEFORE}
    assert {cell.method for cell in cells if cell.shift == "LIBERO-swap"} == everywhere | before
    assert {cell.method for cell in cells if cell.shift == "Lift by a UR5e"} == everywhere, "its base is Lift's"
    in_lift = everywhere | before | {evidence.cells.FROM_PRIOR} | set(evidence.cells.IN_SOME_WORLDS)
    assert {cell.method for cell in cells if cell.shift == "Lift"} == in_lift
    assert everywhere <= set(evidence.cells.METHODS) >= set(evidence.cells.IN_SOME_WORLDS)
    for shift, seeds in (("look", {0, 1, 2}), ("randomized", set(range(5))), ("Lift", set(range(5))), ("Door", {0})):
        assert {cell.seed for cell in cells if (cell.shift, cell.method) == (shift, "full")} == seeds


def test_methods_differ_only_in_what_is_trained_and_how_fast(evidence: Any) -> None:
    def rest(name: str) -> Any:
        return evidence.cells.METHODS[name].training.model_copy(update={"learning_rate": 1.0})

    adapters = {name: method.adapter for name, method in evidence.cells.METHODS.items()}
    assert adapters["in/out only"].targets == ("blocks.0.attn.q",)
    assert adapters["DoRA r16"] == adapters["LoRA r16"].model_copy(update={"dora": True})
    assert rest("LoRA r4") == rest("LoRA r32 + in/out") == rest("full") == rest("scratch")
    assert rest("scratch, 3x steps").steps == 3 * rest("scratch").steps
    of_one, of_three = (rest(name) for name in evidence.cells.ROLLOUTS)
    assert (of_one.rollout_steps, rest("full").rollout_steps, of_three.rollout_steps) == (1, 2, 3)
    slower, usual = (evidence.cells.method_of("full", shift).learning_rate for shift in ("randomized", "motion"))
    assert slower < usual == evidence.cells.METHODS["full"].learning_rate


def test_the_looks_differ_and_the_motion_does_not_and_the_other_way_round(evidence: Any) -> None:
    look, motion = evidence.cells.SHIFTS["look"], evidence.cells.SHIFTS["motion"]
    assert look.base_yaw_deg == DOMAIN_A.base_yaw_deg
    assert look.camera != DOMAIN_A.camera
    assert look.look != DOMAIN_A.look
    assert motion.base_yaw_deg != DOMAIN_A.base_yaw_deg
    assert (motion.camera, motion.look) == (
        DOMAIN_A.camera,
        DOMAIN_A.look,
    )


def test_each_goal_of_a_randomized_world_lies_in_another_one_and_a_plain_world_has_all(evidence: Any) -> None:
    drawn = list(evidence.measure._rollouts("randomized", 9_000, 3))
    assert len({spec.world.camera for spec in drawn}) == len({spec.seed for spec in drawn}) == len(drawn) == 3
    assert all(spec.episodes == 1 and spec.world.moving == 3 for spec in drawn)
    assert drawn == list(evidence.measure._rollouts("randomized", 9_000, 3))
    assert [(spec.episodes, spec.seed) for spec in evidence.measure._rollouts("look", 9_000, 3)] == [(3, 9_000)]


def test_no_two_seeds_of_a_world_share_a_problem_or_a_demonstration(evidence: Any) -> None:
    worlds, cells = evidence.other_worlds, evidence.cells
    used = [range(first, first + 1_000) for first in worlds.FIRST.values()]
    for seed, choosing in itertools.product(range(5), (True, False)):
        cell = cells.Cell("Lift", "none", "scratch", 20, seed)
        first = evidence.measure.goals_seed(cell, choosing=choosing)
        used.append(range(first, first + TRIES * evidence.measure.GOALS))
    assert not any(one.start in other or other.start in one for one, other in itertools.combinations(used, 2))


def test_a_base_before_the_change_is_measured_there_and_all_others_after_it(
    evidence: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked = []
    monkeypatch.setattr(evidence.other_worlds, "closed_loop", lambda *_, when, **__: asked.append(when) or {})
    for method in (evidence.cells.BEFORE, "zero-shot"):
        cell = evidence.cells.Cell("Lift", "one camera", method, 0, 0)
        evidence.measure.closed_loop(cell, None, tmp_path, seed=0, goals=1)
        asked.append(Path(evidence.measure.config_of(cell, tmp_path).data.path).name)
    assert asked == ["before", "data-Lift-before", "after", "data-Lift-after"]


def test_in_a_world_of_others_a_hand_arrives_that_ends_where_the_expert_s_does(evidence: Any) -> None:
    def ended(*ends: tuple[float, float, float]) -> Any:
        episodes = [
            SimpleNamespace(states=np.array([[9.0] * 7, [*end, 0, 0, 0, 1]]), success_ever=True) for end in ends
        ]
        distance, seconds = np.array([[4.0, 0.0]] * len(ends)), np.ones(2)
        return SimpleNamespace(
            episodes=episodes,
            distance_cm=distance,
            successes=np.array([True] * len(ends)),
            seconds=seconds,
            why_counts={},
        )

    expert = ended((0.3, 0.0, 0.2), (0.4, 0.1, 0.2))
    found = evidence.other_worlds.figures_of(ended((0.3, 0.0, 0.24), (0.4, 0.1, 0.26)), 0, expert)
    assert found["hand_cm"] == pytest.approx([4.0, 6.0])
    cell = evidence.cells.Cell("Lift", "one camera", evidence.cells.BEST, 20, 0)
    one = {"cell": asdict(cell), "reach": {"l1": found}}
    assert evidence.results.arrived(one) == [True, False]
    assert "100% [34, 100]; hand 50%" in evidence.table.of_worlds([one])
    assert "20 demonstrations" in evidence.table.summary_of_worlds([one])


def test_every_table_has_who_needs_no_model_and_time_that_other_work_does_not_lengthen(evidence: Any) -> None:
    def figures(shift: str, base: str, method: str, **more: Any) -> dict[str, Any]:
        reach = {"distance_cm": [[20.0, 3.0], [20.0, 9.0]]}
        cell = {"shift": shift, "base": base, "method": method, "episodes": 20, "seed": 0}
        errors = {"rollout_over_persistence": [0.5], "one_step_zero_actions": 1.0, "one_step_shuffled_actions": 1.0}
        trained = {"trained_share": 0.1, "adapter_mb": 0.3, "minutes": 77.0, "cpu_minutes": 5.0}
        return {"cell": cell, "shifted": errors, "reach": {"l1": reach}, **trained, **more}

    reach = {"distance_cm": [[20.0, 20.0], [20.0, 20.0]]}
    alone = {"baselines": dict.fromkeys(("zero action", "random", "oracle"), reach)}
    results = [figures("motion", "one camera", "zero-shot", **alone), figures("motion", "one camera", "full")]
    lines = evidence.table._shifted(results, "motion").splitlines()
    assert [line.split(" | ")[0] for line in lines[4:]] == [
        "| zero action", "| random", "| oracle", "| zero-shot (one camera)", "| full (one camera)",
    ]  # fmt: skip
    assert " 5.0 " in lines[-1]
    assert "77" not in lines[-1]


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Everything at its smallest: two steps, one goal; the figures mean nothing."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "benchmarks/evidence"))
        modules = SimpleNamespace(**{name: import_module(name) for name in MODULES})
        cells, prepare, measure = modules.cells, modules.prepare, modules.measure
        patch.setattr(cells, "STEPS", 2)
        patch.setattr(cells, "TRAINING", cells.TRAINING.model_copy(update={"warmup_steps": 1, "batch_size": 2}))
        short = partial(ValidationConfig, ranking_samples=2)
        patch.setattr(measure, "ValidationConfig", lambda clips, **given: short(clips=clips // 10, **given))
        few = cells.PLANNING.model_copy(update={"samples": 12, "iterations": 1})
        patch.setattr(measure, "PLANNING", few)
        patch.setattr(measure, "CLIPS", 6)
        for name, value in (("MOVES", 2), ("PLANS", 1), ("FEWER", {"samples": 12, "iterations": 1})):
            patch.setattr(modules.offline, name, value)
        patch.setattr(measure, "PAIRS", 6)
        patch.setattr(measure, "base_model", lambda *_: prepare.BUILTIN)
        patch.setattr(prepare, "RecordingSpec", partial(RecordingSpec, steps=14))
        modules.folder = tmp_path_factory.mktemp("evidence")
        for name, make in (("data_a", prepare.data_a), ("data_shifted", prepare.data_shifted)):
            patch.setattr(prepare, name, partial(_held_out, make))
        patch.setattr(measure, "data_shifted", prepare.data_shifted)
        for data, domain in (
            (prepare.data_a(modules.folder), "A"),
            (prepare.data_shifted(modules.folder, "look"), "look"),
        ):
            prepare._record(data, domain, 11, 3)
            prepare.keep_latents(data, prepare.BUILTIN)
        yield modules
    for name in MODULES:
        sys.modules.pop(name, None)


def _held_out(make: Any, *arguments: Any) -> Any:
    """Return a data config of which few episodes give something to every split."""
    return make(*arguments).model_copy(update={"validation_share": 0.2, "test_share": 0.3})


@pytest.mark.usefixtures("drawn")
def test_a_cell_is_trained_and_measured_and_its_base_comes_back(small: Any, tmp_path: Path) -> None:
    cell = small.cells.Cell("look", "many cameras", "LoRA r4 + in/out", 4, 0)
    figures = small.measure.measure(cell, small.folder, goals=1)
    assert figures["forgetting"]["off_is_base_bit_for_bit"] is True
    assert figures["forgetting"]["on"] != figures["forgetting"]["off"]
    assert 0 < figures["trained_share"] < 0.2
    assert figures["adapter_mb"] > 0
    assert len(figures["reach"]["l1"]["distance_cm"][0]) == 9
    assert -1 <= figures["reach"]["l1"]["visited"] <= 1
    assert len(figures["offline"]) == 10

    zero = replace(cell, method="zero-shot", episodes=0)
    before = small.measure.measure(zero, small.folder, goals=1)
    assert set(small.measure.made_with()) == {"torch", "commit"}
    before["baselines"] = small.measure.baselines(zero, small.folder, goals=1)
    assert before["trained_share"] == 0
    assert before["shifted"] != figures["shifted"]
    assert (
        before["baselines"]["oracle"]["distance_cm"][0][-1]
        < 1
        < before["baselines"]["zero action"]["distance_cm"][0][-1]
    )

    turned = small.measure.measure(replace(cell, method=small.cells.AXES), small.folder, goals=1)
    assert turned["trained_share"] == 0
    assert turned["axes"]["pairs"] == 6
    assert (turned["shifted"] == before["shifted"]) == (turned["axes"]["problem"] is not None)

    results = tmp_path / "results"
    results.mkdir()
    for one in (figures, before, turned):
        one["cell"]["episodes"] = one["cell"]["episodes"] and 20
        (results / f"{one['cell']['name']}.json").write_text(json.dumps(one))
    page = tmp_path / "evidence.md"
    marks = small.table.MARKS.items()
    marked = [f"<!-- {mark}: begin -->\nold {part}\n<!-- {mark}: end -->\n" for part, mark in marks]
    page_before = "before\n" + "between\n".join(marked) + "after\n"
    page.write_text(page_before)
    small.table.write_tables(tmp_path, tmp_path / "out", page)
    text = (tmp_path / "out" / "evidence.md").read_text()
    assert "LoRA r4 + in/out" in text
    assert "the base's, bit for bit" in text
    assert f"| {small.cells.AXES} | " in text
    assert f"- look, many cameras: yaw {turned['axes']['yaw_degrees']['value']:+.0f}" in text
    assert "Made with not recorded (3 cells)" in text
    assert "oracle" in text
    assert (tmp_path / "out" / "evidence.png").stat().st_size > 5_000
    made = tmp_path / "out" / "evidence.json"
    small.table.write_tables(tmp_path / "empty", tmp_path / "again", done=made)  # elsewhere, from what was made here
    assert (tmp_path / "again" / "evidence.md").read_text() == text
    new = page.read_text()
    assert new.startswith("before\n")
    assert new.endswith("\nafter\n")
    assert "old" not in new.partition("between")[0]
    assert "zero-shot" in new.partition("between")[0]
    assert new.partition("between")[2] == page_before.partition("between")[2], "of which nothing is done yet"


def test_a_policy_that_imitates_is_trained_and_acts_without_a_search(small: Any, monkeypatch: Any) -> None:
    few = PriorOptions(steps=2)
    monkeypatch.setattr(small.measure, "train_prior", partial(train_prior, options=few))
    cell = small.cells.Cell("look", "none", "behaviour cloning", 4, 0)
    figures = small.measure.measure(cell, small.folder, goals=1)
    assert set(figures["held_out"]) == {"clips", "true_goals", "goals_of_others"}
    assert len(figures["reach"]["l1"]["distance_cm"][0]) == 9
    assert small.results.reached(figures) in ([True], [False])
    assert figures["reach"]["l1"]["whys"] == {"planned": 8}


def test_a_search_can_start_from_a_policy_that_imitates(small: Any, monkeypatch: Any) -> None:
    few = PriorOptions(steps=2)
    monkeypatch.setattr(small.measure, "train_prior", partial(train_prior, options=few))
    cell = small.cells.Cell("look", "many cameras", small.cells.FROM_PRIOR, 4, 0)
    alone = small.measure.measure(replace(cell, method=small.cells.BEST), small.folder, goals=1)
    figures = small.measure.measure(cell, small.folder, goals=1)
    assert figures["shifted"] == alone["shifted"], "the same model"
    assert figures["reach"]["l1"]["distance_cm"] != alone["reach"]["l1"]["distance_cm"]


def test_exactly_so_many_demonstrations_are_trained_on_and_seeds_draw_others(small: Any) -> None:
    drawn = []
    for seed in (0, 1):
        config = small.measure.config_of(small.cells.Cell("look", "many cameras", "full", 4, seed), small.folder)
        dataset = open_dataset(config.data)
        windows = dataset.windows("train")
        drawn.append({windows[place][0] for place in range(len(windows))})
        assert len(drawn[-1]) == 4
    assert drawn[0] != drawn[1]


def test_methods_are_compared_on_the_goals_that_both_had(evidence: Any) -> None:
    def cell(method: str, seed: int, ends: list[float]) -> dict[str, Any]:
        of = {"shift": "look", "base": "many cameras", "method": method, "episodes": 20, "seed": seed}
        return {"cell": of, "reach": {"l1": {"distance_cm": [[20.0, end] for end in ends]}}}

    best, near, far = evidence.cells.BEST, 1.0, 9.0
    results = [
        cell(best, 0, [near] * 9 + [far]), cell("full", 0, [far] * 8 + [near, near]), cell(best, 1, [near])
    ]  # fmt: skip
    row = evidence.table.goal_by_goal(results).splitlines()[-1]
    assert row == "| camera and look; many cameras | full | 10 | 8 | 1 | 0.039 |"


def test_a_page_without_a_place_for_the_table_is_left_alone(small: Any, tmp_path: Path) -> None:
    page = tmp_path / "evidence.md"
    page.write_text("nothing")
    with pytest.raises(ValueError, match="made by"):
        small.table.write_summary([], {}, page)
    assert page.read_text() == "nothing"


def test_a_figure_that_orders_models_as_their_success_does_is_found(evidence: Any) -> None:
    rows = [{"good": -float(one), "useless": float(one % 3), "backwards": float(one)} for one in range(24)]
    missed = [-float(one) for one in range(24)]
    found = evidence.offline.correlations(rows, missed, range(24), draws=50)
    assert [found[name]["value"] for name in ("good", "backwards")] == pytest.approx([1.0, -1.0])
    assert found["useless"]["low"] < 0 < found["useless"]["high"]


def test_cells_that_differ_in_their_seed_alone_do_not_narrow_an_interval(evidence: Any) -> None:
    rng = np.random.default_rng(0)
    figures, missed = rng.normal(size=8), rng.normal(size=8)
    once = evidence.offline.correlations([{"figure": one} for one in figures], missed, range(8), draws=200)
    rows = [{"figure": one} for one in figures for _ in range(5)]
    again = evidence.offline.correlations(rows, np.repeat(missed, 5), np.repeat(np.arange(8), 5).tolist(), draws=200)
    apart = evidence.offline.correlations(rows, np.repeat(missed, 5), range(40), draws=200)
    assert again["figure"] == pytest.approx(once["figure"])
    assert apart["figure"]["high"] - apart["figure"]["low"] < 0.7 * (again["figure"]["high"] - again["figure"]["low"])
