"""The evidence: its page shows the stored results, and each kind of cell can be measured."""

import json
import runpy
import shlex
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
import torch
from scipy.stats import binomtest

import fake_world
from paths import ROOT
from vjepa2_ac.config import ValidationConfig
from vjepa2_ac.policies.action_prior import PriorOptions, load_prior, train_prior
from vjepa2_ac.simulation.policies import ZeroActions
from vjepa2_ac.simulation.record import RecordingSpec
from vjepa2_ac.simulation.rollout import Image, Trial

MODULES = tuple(sorted(path.stem for path in (ROOT / "evidence").glob("[!_]*.py")))


@pytest.fixture(scope="module")
def evidence() -> Iterator[Any]:
    """The modules of `evidence`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "evidence"))
        yield SimpleNamespace(**{name: import_module(name) for name in MODULES})
    for name in MODULES:
        sys.modules.pop(name, None)


@pytest.fixture(scope="module")
def stored(evidence: Any) -> list[dict[str, Any]]:
    """The results of the methods study in the repository."""
    return json.loads((evidence.results.RESULTS / "methods.json").read_text())


def test_condition_names_are_unique_and_each_stored_result_has_a_condition(evidence: Any, stored: Any) -> None:
    cells = list(evidence.methods.all_cells())
    assert len({cell.name for cell in cells}) == len(set(cells)) == len(cells)
    assert not any("/" in cell.name for cell in cells), "names of files"
    names = {evidence.methods.Cell(**result["cell"]).name for result in stored}
    assert len(names) == len(stored)
    assert {cell.name for cell in cells} <= names, "every cell is measured"
    checkpoints = list(evidence.selection.all_cells())
    selection = json.loads((evidence.results.RESULTS / "selection.json").read_text())
    assert set(checkpoints) <= {evidence.selection.Cell(**result["cell"]) for result in selection}
    searches = list(evidence.iterations.all_cells())
    assert len({cell.name for cell in searches}) == len(searches)


def test_every_study_has_cells_that_its_stored_results_name(evidence: Any) -> None:
    program = runpy.run_path(str(ROOT / "evidence/__main__.py"), run_name="evidence")
    for name, (module, tables) in program["STUDIES"].items():
        study = getattr(evidence, module)
        assert callable(study.prepare)
        assert callable(study.measure)
        assert callable(getattr(evidence, tables).write_tables)
        names = [cell.name for cell in getattr(evidence, "methods" if name == "methods" else module).all_cells()]
        assert len(set(names)) == len(names)
        for cell in study.all_cells():
            assert study.Cell(**json.loads(json.dumps(asdict(cell)))).name == cell.name


def test_failed_cells_are_counted_and_results_replace_the_stored_ones(evidence: Any, tmp_path: Path) -> None:
    (tmp_path / "study_of_a_test.py").write_text(
        "def measure(cell, folder, goals):\n"
        "    if cell.lab == 2:\n"
        "        raise ValueError('broken')\n"
        "    return {'value': goals / 3, 'unused': 1}\n"
    )
    cells, folder = [evidence.labs.Cell(lab, "base model") for lab in (1, 2)], tmp_path / "labs"
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(tmp_path)
        assert evidence.work.Work(tmp_path, workers=1).measure("labs", "study_of_a_test", cells[1:], 7) == 1
        result = evidence.work.measure_cell(cells[0], "study_of_a_test", tmp_path, 7)
    assert not folder.exists(), "the failed cell has no result"
    evidence.results.write_result(folder / f"{cells[0].name}.json", result)
    stored = tmp_path / "stored.json"
    evidence.results.write_all(stored, [{"cell": asdict(cells[0]), "value": 0.0}, {"cell": asdict(cells[1])}])
    first, second = evidence.results.read_all(
        folder, stored, lambda result: {"value": result["value"]}, evidence.labs.Cell
    )
    assert first.pop("core_minutes") >= 0
    assert set(first.pop("made_with")) == {"torch", "commit"}
    assert first == {"cell": {"lab": 1, "method": "base model"}, "goals": 7, "value": 2.3333333}
    assert second == {"cell": {"lab": 2, "method": "base model"}}


def test_tables_of_the_page_equal_the_stored_results(evidence: Any, stored: Any) -> None:
    page = (ROOT / "docs/evidence.md").read_text()
    assert evidence.tables.summary(stored) in page
    assert evidence.tables.summary_of_tasks(stored) in page
    assert evidence.tables.summary_of_correlations(evidence.tables.correlated_numbers(stored)) in page
    assert evidence.tables.difference_table(stored) in page
    text = (evidence.results.RESULTS / "methods.md").read_text()
    assert "\n\n".join(evidence.tables._rows(stored)) in text
    assert evidence.tables.goal_by_goal(stored) in text
    assert evidence.tables.choice_table(stored) in text
    assert evidence.tables.choice_table([result for result in stored if result["cell"]["episodes"]]) in text
    selection = json.loads((evidence.results.RESULTS / "selection.json").read_text())
    rules = "\n".join(evidence.selection_tables._rules(evidence.selection_tables.by_run(selection)))
    assert rules in (evidence.results.RESULTS / "selection.md").read_text()
    within_runs = evidence.selection_tables.within_runs(evidence.selection_tables.by_run(selection))
    assert within_runs in (ROOT / "docs/evaluation.md").read_text()
    assert sum(path.stat().st_size for path in evidence.results.RESULTS.glob("*.json")) < 450_000


def test_tables_of_the_labs_equal_the_stored_results(evidence: Any) -> None:
    page, tables = (ROOT / "docs/evidence.md").read_text(), evidence.labs_tables
    labs: dict[int, dict[str, Any]] = {}
    for result in json.loads((evidence.results.RESULTS / "labs.json").read_text()):
        labs.setdefault(result["cell"]["lab"], {})[result["cell"]["method"]] = result
    assert len(labs) == evidence.labs.LABS
    assert tables.all_labs_table(labs) in page
    assert tables.gains_table(labs) in page
    assert tables.gains_table(labs) in (ROOT / "README.md").read_text()
    assert tables.advice_table({number: methods for number, methods in labs.items() if number > 6}) in page
    for with_base in (True, False):
        assert tables.metrics_table(labs, with_base=with_base) in page
    reached = {
        (number, method): np.array(result["closed_loop"]["newest"]) < evidence.results.REACHED_CM
        for number, methods in labs.items()
        for method, result in methods.items()
    }
    changes = [100 * (reached[lab, "LoRA, rank 4"].mean() - reached[lab, "full fine-tuning"].mean()) for lab in labs]
    lower, mean, p_value = sum(change < 0 for change in changes), -np.mean(changes), binomtest(11, 12).pvalue
    assert (lower, sum(change > 0 for change in changes)) == (11, 1)
    assert f"in {lower} of 12 labs, on average {mean:.0f} points less (sign test p = {p_value:.3f})" in page
    pairs = [(reached[lab, "test-time adaptation"], reached[lab, "base model"]) for lab in labs]
    won_lost = [(int((ours & ~base).sum()), int((base & ~ours).sum())) for ours, base in pairs]
    smallest = min(binomtest(won, won + lost).pvalue for won, lost in won_lost if won + lost)
    assert f"McNemar test, smallest p = {smallest:.2f}" in page
    verdicts = {
        (number in {3, 9}, name, verdict["conclusion"])
        for number, methods in labs.items()
        for result in methods.values()
        for name, verdict in result.get("evaluation", {}).get("newest", {"verdicts": {}})["verdicts"].items()
        if name in {"better prediction", "sensitive to actions", "better action ranking"}
    }
    assert {conclusion for is_harmful, name, conclusion in verdicts if name == "better prediction"} == {"yes"}
    other = {(is_harmful, conclusion) for is_harmful, name, conclusion in verdicts if name != "better prediction"}
    assert other == {(True, "no"), (False, "yes")}, "as the text says"


def test_numbers_in_the_text_of_the_evaluation_page_equal_the_stored_results(evidence: Any, stored: Any) -> None:
    page = " ".join((ROOT / "docs/evaluation.md").read_text().split())
    table = evidence.tables.choice_table([result for result in stored if result["cell"]["episodes"]])
    rows = {line.split("|")[1].strip(): line.split("|") for line in table.splitlines()}
    assert "Metric, 8 choices" in rows
    correlation, interval = (cell.strip() for cell in rows["**action-ranking error**"][2:4])
    assert f"rank correlation with the success rate is {correlation} (95 % interval {interval})" in page

    def condition(result: dict[str, Any]) -> tuple[Any, ...]:
        return tuple(result["cell"][key] for key in ("shift", "base", "seed"))

    measured = [result for result in stored if "offline" in result]
    base_models = {condition(result): result for result in measured if result["cell"]["method"] == "zero-shot"}
    pairs = [
        (base_models[condition(result)], result)
        for result in measured
        if condition(result) in base_models and result["cell"]["episodes"]
    ]
    assert all(
        trained["offline"]["action-ranking error"] < base["offline"]["action-ranking error"] for base, trained in pairs
    )
    gains = [
        np.mean(evidence.results.list_reached(trained)) - np.mean(evidence.results.list_reached(base))
        for base, trained in pairs
    ]
    rose, equal, fell = (sum(np.sign(gains) == sign) for sign in (1, 0, -1))
    assert f"the action-ranking error fell for all {len(pairs)} fine-tuned models" in page
    assert f"The success rate rose for {rose} of them, did not change for {equal}, and fell for {fell}." in page


@pytest.fixture(scope="module")
def small(evidence: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Return the modules with the smallest settings: two steps, one goal."""
    methods, prepare, measure = evidence.methods, evidence.prepare, evidence.measure
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(methods, "STEPS", 2)
        patch.setattr(methods, "TRAINING", methods.TRAINING.model_copy(update={"warmup_steps": 1, "batch_size": 2}))
        patch.setattr(measure, "ValidationConfig", lambda clips, **keys: ValidationConfig(clips=clips // 10, **keys))
        quick_planning = methods.PLANNING.model_copy(update={"samples": 12, "iterations": 1})
        patch.setattr(measure, "PLANNING", quick_planning)
        patch.setattr(measure, "CLIPS", 6)
        patch.setattr(evidence.offline, "MOVES", 2)
        patch.setattr(measure, "train_prior", partial(train_prior, options=PriorOptions(steps=2)))
        patch.setattr(measure, "base_model", lambda *_: prepare.BUILTIN)
        patch.setattr(prepare, "RecordingSpec", partial(RecordingSpec, steps=14))
        evidence.folder = tmp_path_factory.mktemp("evidence")
        make = prepare.data_shifted
        held_out = {"validation_share": 0.2, "test_share": 0.3}
        for module in (prepare, measure):
            patch.setattr(module, "data_shifted", lambda *arguments: make(*arguments).model_copy(update=held_out))
        data = prepare.data_shifted(evidence.folder, "look")
        prepare._record(data, "look", 11, 3)
        prepare.cache_latents(data, prepare.BUILTIN)
        yield evidence


@pytest.mark.parametrize("method", ["LoRA r4 + in/out", "zero-shot", "behaviour cloning"])
def test_experimental_condition_is_trained_and_measured(small: Any, method: str) -> None:
    base = "none" if method == "behaviour cloning" else "many cameras"
    cell = small.methods.Cell("look", base, method, 0 if method == "zero-shot" else 4, 0)
    result = json.loads(json.dumps(small.measure.measure(cell, small.folder, 1)))
    assert len(result["reach"]["l1"]["distance_cm"][0]) == 9
    assert ("offline" in result) == ("shifted" in result) == (method != "behaviour cloning")
    assert (result["trained_share"] == 0) == (method == "zero-shot")
    compact = small.results.compact(result)
    row = small.tables._row(method, "20", [compact])
    assert row.count("|") == small.tables.HEAD.count("|") + 2
    if method == "zero-shot":
        distances_cm = {name: policy["ends_cm"][0] for name, policy in compact["baselines"].items()}
        assert distances_cm["oracle"] < 1 < distances_cm["zero action"]


def test_third_party_condition_is_measured_with_three_kinds_of_goals(
    evidence: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    environments = evidence.environments
    command = shlex.join([sys.executable, fake_world.__file__])
    monkeypatch.setattr(environments.Task, "command", lambda *_: command)
    monkeypatch.setattr(environments, "EPISODES_LIFT", 5)
    monkeypatch.setitem(environments.FIRST, "after", 3)
    environments.record(tmp_path, "Lift", "after")  # seeds 3 to 7; 3 and 6 are the expert's

    class Spy(ZeroActions):
        def __init__(self) -> None:
            super().__init__()
            self.trials = list[Trial]()

        def reset(self, trial: Trial, goal_image: Image) -> None:  # noqa: ARG002
            self.trials.append(trial)

    spy = Spy()
    loops = environments.closed_loops(tmp_path, "Lift", spy, seed=6, goals=2)
    assert set(loops) == {"l1", "another demonstration", "one image"}
    assert all(len(loop["solved"]) == 2 for loop in loops.values())
    assert loops["one image"]["versions"] == {"mujoco": "3.0"}
    same, other, one_image = spy.trials[0], spy.trials[2], spy.trials[4]
    assert [trial.seed for trial in spy.trials] == [6, 7] * 3
    assert [goal.gripper for goal in one_image.goals] == ["rounded"]
    np.testing.assert_array_equal(one_image.goals[0].image, same.goals[-1].image)
    demonstration = np.load(tmp_path / "data-Lift-after" / "Come_000006.npz")["frames"]
    assert len(other.goals) == len(demonstration[2::2])
    for goal, frame in zip(other.goals, demonstration[2::2], strict=True):
        np.testing.assert_array_equal(goal.image, frame)
    candidates = [np.load(tmp_path / "data-Lift-after" / f"Come_{seed:06d}.npz")["frames"] for seed in (3, 6)]
    assert any(np.array_equal(spy.trials[3].goals[-1].image, frames[::2][-1]) for frames in candidates)


def test_table_of_tasks_has_a_column_for_each_measured_kind_of_goals(evidence: Any) -> None:
    cell = {"shift": "Lift", "base": "one camera", "method": evidence.methods.BEST, "episodes": 20, "seed": 0}
    loops = {"l1": [1, 1, 1, 0], "another demonstration": [1, 0, 0, 0]}
    reach = {goals: {"ends_cm": [1.0] * 4, "solved": solved} for goals, solved in loops.items()}
    zero_shot = cell | {"method": "zero-shot", "episodes": 0}
    results = [{"cell": cell, "reach": reach}, {"cell": zero_shot, "reach": {"l1": reach["l1"]}}]
    rows = evidence.tables.summary_of_tasks(results).splitlines()
    assert "(robosuite 1.5.2 with MuJoCo 3.9.0)**, 4 problems" in rows[0]
    assert rows[2].count("95 % interval") == 2
    assert rows[4] == "| base model | 75 % | 30 to 95 % | not measured |  |"
    assert rows[5].startswith("| LoRA, rank 32 + projections | 75 % | 30 to 95 % | 25 % | 5 to 70 % |")


def test_runs_of_the_selection_study_differ_and_the_plots_are_drawn(evidence: Any, stored: Any, tmp_path: Path) -> None:
    runs = {cell.run for cell in evidence.selection.all_cells()}
    assert len(runs) == 7 * evidence.selection.SEEDS
    for run in runs:
        assert (evidence.selection.make_config(run, tmp_path).replay is not None) == (run.cure == "replay")
    evidence.tables.draw(stored, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")


def test_labs_differ_and_a_third_has_a_special_condition(evidence: Any) -> None:
    labs = [evidence.labs.get_lab(number) for number in range(1, evidence.labs.LABS + 1)]
    assert len({lab.domain.camera for lab in labs}) == 12
    assert len({cell.name for cell in evidence.labs.all_cells()}) == 12 * len(evidence.labs.METHODS)
    assert [lab.condition == "new camera" for lab in labs].count(False) == 4
    assert labs[4] == evidence.labs.get_lab(5)


def test_pretrained_prior_of_a_lab_starts_from_the_prior_of_the_base_data(
    evidence: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    labs, rates = evidence.labs, evidence.rates
    lab = replace(labs.get_lab(1), demonstrations=4)
    for name, value in (
        ("get_lab", lambda _: lab),
        ("EPISODES", 11),
        ("BASE_PRIOR", PriorOptions(steps=1, batch_size=2)),
        ("FINE_TUNING", PriorOptions(steps=0, batch_size=2)),
        ("RecordingSpec", partial(RecordingSpec, steps=14)),
    ):
        monkeypatch.setattr(labs, name, value)
    monkeypatch.setattr(evidence.prepare, "BASE_EPISODES", 4)
    monkeypatch.setattr(evidence.prepare, "RecordingSpec", partial(RecordingSpec, steps=14))
    labs.prepare_base_prior(tmp_path)
    labs.prepare_lab(lab, tmp_path)
    cell = labs.Cell(1, labs.PRETRAINED_PRIOR)
    result = labs.measure(cell, tmp_path, 1)
    assert len(result["closed_loop"]["newest"]) == 1
    card, prior = load_prior(tmp_path / "lab-runs" / cell.name, where="test")
    base_card, base_prior = load_prior(tmp_path / "base-prior", where="test")
    assert (card.data, base_card.data) == (str(tmp_path / "data-1"), str(tmp_path / "data-base"))
    assert torch.equal(prior.outer.weight, base_prior.outer.weight)
    cell = rates.Cell(1, labs.PRETRAINED_PRIOR, 1e-3, 0)
    compared = {"cell": asdict(cell)} | rates.measure(cell, tmp_path, 0)
    assert compared["error"] == result["held_out"]["true_goals"]["value"]
    assert f"| {labs.PRETRAINED_PRIOR} | 0.001 | 0 | 1 | {compared['error']:.3f} | not defined |" in rates.table(
        [compared]
    )


def test_candidates_of_the_rates_study_differ_and_use_other_labs(evidence: Any) -> None:
    cells = list(evidence.rates.all_cells())
    assert len({cell.name for cell in cells}) == len(set(cells)) == len(cells)
    studied = {cell.lab for cell in evidence.labs.all_cells()}
    assert not studied & {cell.lab for cell in cells}
    results = [
        {
            "cell": {"lab": lab, "method": "LoRA, rank 4", "rate": 3e-3, "steps": 400},
            "error": error,
            "ranking_error": 0.1,
        }
        for lab, error in ((101, 0.7), (102, 0.8))
    ]
    assert "| LoRA, rank 4 | 0.003 | 400 | 2 | 0.750 | 10.0 % |" in evidence.rates.table(results)


def test_advice_table_counts_helpful_and_harmful_adaptation(evidence: Any) -> None:
    tables, methods = evidence.labs_tables, evidence.labs.METHODS

    def trained(distances_cm: float, *, selected: int, ranking: float) -> dict[str, Any]:
        conclusions = {"better action ranking": "yes" if selected else "no", "better prediction": "yes"}
        verdicts = {name: {"conclusion": conclusion} for name, conclusion in conclusions.items()}
        steps = {0: 0.2, 400: ranking}
        validations = [
            {"step": step, "rollout_error": 1.0, "ranking": [error, error - 0.1, error + 0.1]}
            for step, error in steps.items()
        ]
        result = {"selected": f"step-{selected:08d}", "validations": validations, "cell": {}}
        return result | {
            "evaluation": {"newest": {"verdicts": verdicts}},
            "closed_loop": {"newest": [distances_cm] * 20},
        }

    base = {"closed_loop": {"newest": [1.0] * 10 + [9.0] * 10}}  # 50 %
    helpful, harmful = trained(1.0, selected=400, ranking=0.1), trained(9.0, selected=0, ranking=0.3)
    lab = dict.fromkeys(methods, helpful) | {methods[0]: base, "full fine-tuning": harmful}
    rows = {line.split("|")[1].strip(): line for line in tables.advice_table({7: lab}).splitlines()}
    newest = "the newest checkpoint, if `evaluate` reports"
    assert "| 2 of 2 | 0 of 1 | 16.7 points | 67 % |" in rows["always the newest checkpoint"]
    assert "| 0 of 2 | 1 of 1 | 33.3 points | 50 % |" in rows["always the base model"]
    assert "| 2 of 2 | 1 of 1 | 0.0 points | 83 % |" in rows["the selected checkpoint (`keep_best`)"]
    assert "| 2 of 2 | 1 of 1 | 0.0 points | 83 % |" in rows[f"{newest} better action ranking"]
    assert "| 2 of 2 | 0 of 1 | 16.7 points | 67 % |" in rows[f"{newest} better prediction"]
    gains = {line.split("|")[1].strip(): line for line in tables.gains_table({7: lab, 3: lab}).splitlines()}
    assert gains["full fine-tuning"] == "| full fine-tuning | 0 | 0 to 79 % | -50.0 | -50 | -50 |"
    assert gains["LoRA, rank 4"] == "| LoRA, rank 4 | 1 | 21 to 100 % | +50.0 | +50 | +50 |"
    wrong = lab | {"LoRA, rank 4": helpful | {"selected": "step-00000000"}}
    with pytest.raises(ValueError, match="the rule selects step 400"):
        tables.advice_table({7: wrong})


def test_adapting_planner_trains_on_its_transitions_only_from_the_second_decision(evidence: Any) -> None:
    labs = evidence.labs
    model = labs.load_base(labs.ModelConfig(base=labs.BUILTIN, dtype="float32"), seed=0).eval()
    policy = labs.AdaptingPlanner(model, rate=1e-2)
    policy.planning.controller.config = labs.PLANNING
    before = [weight.detach().clone() for weight in policy.parameters]
    spec = labs.BenchmarkOptions("reach", "A", 1, 0, steps=2)
    labs.run_task(spec, policy)
    assert len(policy.transitions) == 1
    changed = [
        not bool((current == original).all()) for current, original in zip(policy.parameters, before, strict=True)
    ]
    assert any(changed)
    frozen = model.base_predictor.blocks[0].state_dict()
    assert all(
        bool((frozen[key] == value).all()) for key, value in policy.model.base_predictor.blocks[0].state_dict().items()
    )


def test_decisions_of_one_long_search_equal_those_of_shorter_searches(evidence: Any) -> None:
    study = evidence.iterations
    model = evidence.labs.load_base(evidence.labs.ModelConfig(base=evidence.labs.BUILTIN, dtype="float32"), seed=0)
    planning = study.load_config("builtin:demo").planning.model_copy(update={"samples": 12})
    controllers = [
        study.Controller(model.eval(), planning.model_copy(update={"iterations": iterations}), seed=3)
        for iterations in (10, 1, 3)
    ]
    task = study.TASKS["reach-demo"]
    result = study.measure_decisions(task, controllers[0], 2)
    arm = study.arm_for("reach", task.domain)
    starts = list(study.demonstrate_problems(task, arm, controllers[0], 2))
    for controller, count in zip(controllers[1:], ("1", "3"), strict=True):
        for number, (trial, episode) in enumerate(starts):
            decision = study.decide_at(controller, trial, episode, number % episode.steps_needed)
            expected = [*(100 * decision.action[:3]), decision.plan.energy]
            assert result["searches"][count][number][:4] == pytest.approx(expected, abs=1e-4)
    first, second = (episode for _, episode in starts)
    assert result["oracle"][0] == pytest.approx(100 * first.actions[0, :3])
    assert result["oracle"][1] == pytest.approx(100 * second.actions[1, :3])
    assert study.compact(result | {"cell": {}})["searches"]["3"][0][0] == round(result["searches"]["3"][0][0], 2)


def test_sub_goals_are_those_after_the_start_of_the_decision(evidence: Any) -> None:
    study = evidence.iterations
    image = np.zeros((2, 2, 3), np.uint8)
    calls: list[Any] = []
    controller = SimpleNamespace(follow=calls.append, reset=calls.append, act=lambda *_: None, decision="made")
    episode = SimpleNamespace(frames=np.zeros((4, 2, 2, 3)), states=np.zeros((4, 7)), goal_image=image)
    trial = study.Trial(0, 3, 4, goals=("after step 1", "after step 2", "after step 3"))
    assert study.decide_at(controller, trial, episode, 1) == "made"
    study.decide_at(controller, study.Trial(0, 3, 4), episode, 1)
    assert calls == [("after step 2", "after step 3"), image]


def test_decisions_table_compares_each_search_with_the_reference(evidence: Any) -> None:
    def result(samples: int, dx_cm: float, energy: float) -> dict[str, Any]:
        cell = {"kind": "decisions", "task": "push", "samples": samples, "iterations": 10}
        searches = {str(count): [[dx_cm, 0.0, 0.0, energy, 0.5]] * 4 for count in evidence.iterations.ITERATIONS}
        return {"cell": cell, "oracle": [[5.0, 0.0, 3.0]] * 4, "zero_action_energy": [0.6] * 4, "searches": searches}

    results = [result(800, 5.0, 0.4), result(64, 3.0, 0.45)]
    table = evidence.iterations_tables.decisions_table(results, ["push"])
    assert "| 64 | 3 | 192 | 2.00 | 2.00 to 2.00 | 75.0 % | 75.0 to 75.0 % | 3.61 | 3.61 to 3.61 | 0.50 |" in table
    assert "| 800 | 10 | 8,000 | reference |  | 100 % |  | 3.00 | 3.00 to 3.00 | 0.50 |" in table
    assert len(table.splitlines()) == 2 + 2 * len(evidence.iterations.ITERATIONS)


def test_closed_loop_table_compares_the_same_problems_of_all_tasks(evidence: Any) -> None:
    def result(task: str, samples: int, iterations: int, solved: list[int]) -> dict[str, Any]:
        cell = {"kind": "closed loop", "task": task, "samples": samples, "iterations": iterations}
        return {"cell": cell, "solved": solved, "distance_cm": [1.0] * len(solved)}

    tasks = list(evidence.iterations.TASKS)
    results = [result(task, 64, 1, [0, 0, 0, 1]) for task in tasks] + [
        result(task, 64, 3, [1, 1, 0, 1]) for task in tasks
    ]
    incomplete = [result(tasks[0], 800, 3, [1, 1, 1, 1])]
    table = evidence.iterations_tables.closed_loop_table(results + incomplete)
    rates = "| 25 % | 25 % | 25 % | 25 % | 25 % | 10 to 49 % |"
    assert f"| 64 | 1 | 64 {rates} -50.0 points | -75.0 to -25.0 points | 0.008 |" in table
    assert "| 64 | 3 | 192 |" in table.splitlines()[-1]
    assert table.splitlines()[-1].endswith("| reference |  |  |")
    assert "800" not in table
    assert evidence.iterations_tables.closed_loop_table(incomplete) == ""


def test_tables_enter_the_page_when_decisions_and_first_searches_are_measured(evidence: Any, tmp_path: Path) -> None:
    study, tables = evidence.iterations, evidence.iterations_tables
    marks = [f"<!-- {mark}: begin -->\n<!-- {mark}: end -->" for mark in tables.MARKS]
    page = tmp_path / "planning.md"
    page.write_text("\n".join(marks))
    results = []
    for cell in study.all_cells():
        result: dict[str, Any] = {"cell": vars(cell)}
        if cell.kind == "decisions":
            rows = {str(count): [[1.0, 0.0, 0.0, 0.4, 0.5]] * 2 for count in study.ITERATIONS}
            result |= {"oracle": [[5.0, 0.0, 3.0]] * 2, "zero_action_energy": [0.6] * 2, "searches": rows}
        results.append(result if cell.kind == "decisions" else result | {"solved": [1, 0]})
    needed = len(study.TASKS) * (len(study.SAMPLES) + tables.NEEDED)
    tables.write_tables(results[: needed - 1], tmp_path / "iterations.md", tmp_path)
    assert page.read_text().count("| 64 | 3 | 192 |") == 1, "decisions only"
    tables.write_tables(results[:needed], tmp_path / "iterations.md", tmp_path)
    assert page.read_text().count("| 64 | 3 | 192 |") == 2
    assert (tmp_path / "iterations.md").read_text().count("| 64 | 3 | 192 |") == 2 + len(study.TASKS)


def test_holm_correction_equals_the_worked_example(evidence: Any) -> None:
    assert evidence.tables.correct_by_holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert evidence.tables.correct_by_holm([0.7, 0.6]) == [1.0, 1.0]


def test_choice_table_has_no_regret_for_a_metric_that_orders_the_models(evidence: Any) -> None:
    def result(seed: int, metric: float, reached: int) -> dict[str, Any]:
        cell = {"shift": "look", "base": "one camera", "method": "full", "episodes": 20, "seed": seed}
        offline = {name: metric for name in evidence.tables.OFFLINE if not name.startswith(("cost", "error"))}
        shifted = {
            "rollout_over_persistence": [1.0, 1.0, 2.0 - metric],
            "one_step": 1.0,
            "one_step_shuffled_actions": 2.0 - metric,
        }
        ends = [1.0] * reached + [9.0] * (10 - reached)
        return {"cell": cell, "offline": offline, "shifted": shifted, "reach": {"l1": {"ends_cm": ends}}}

    results = [result(seed, 0.1 * index, 9 - 3 * index) for seed in range(5) for index in range(3)]
    rows = {line.split("|")[1].strip(): line for line in evidence.tables.choice_table(results).splitlines()}
    assert "| 1.00 | 1.00 to 1.00 | 0.0 | +30.0 | +30.0 to +30.0 |" in rows["**action-ranking error**"]
    assert (
        "| -1.00 | -1.00 to -1.00 | 60.0 | -30.0 | -30.0 to -30.0 |"
        in rows["rollout error relative to persistence, 0.8 s ahead"]
    )
    assert "| 30.0 |  |  |" in rows["none: average of all models"]
    assert evidence.tables.choice_table(results[:6]) == ""


def test_table_within_runs_has_no_regret_for_a_metric_that_orders_the_checkpoints(evidence: Any) -> None:
    def checkpoint(motions: str, seed: int, step: int) -> dict[str, Any]:
        distance = {0: 9.0, 100: 3.0, 200: 1.0}[step]
        names = evidence.selection_tables.TITLES
        offline = {name: distance if name == "ranking" else -distance for name in names}
        cell = {"motions": motions, "method": "LoRA", "seed": seed, "cure": "", "step": step}
        return {"cell": cell, "offline": offline, "left_cm": distance}

    runs = [
        [checkpoint(kind, seed, step) for step in (0, 100, 200)]
        for kind in evidence.selection_tables.KINDS
        for seed in range(5)
    ]
    ignored = [result | {"cell": result["cell"] | {"cure": "replay"}, "left_cm": 0.0} for result in runs[0]]
    table = evidence.selection_tables.within_runs([*runs, ignored])
    rows = {line.split("|")[1].strip(): line for line in table.splitlines()}
    assert "| 1.00 | 1.00 to 1.00 | 0.0 | 1.00 | 1.00 to 1.00 | 0.0 |" in rows["**action-ranking error**"]
    assert "| -1.00 | -1.00 to -1.00 | 8.0 | -1.00 |" in rows["one-step error relative to persistence"]
    assert "| 8.0 |" in rows["none: always the base model"]
    assert "| 0.0 |" in rows["none: always the last checkpoint"]
    without_base = evidence.selection_tables.within_runs(runs, first=1)
    assert "| none: always the first checkpoint |  |  | 2.0 |  |  | 2.0 |" in without_base


@pytest.mark.parametrize("objective", ["pixels", "latents"])
def test_pretraining_changes_the_encoder_and_keeps_the_predictor(
    evidence: Any, objective: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pretrain = evidence.pretrain_encoder
    monkeypatch.setattr(pretrain, "BATCH", 4)
    monkeypatch.setattr(pretrain, "HELD_OUT", 4)
    monkeypatch.setattr(pretrain, "STEPS", 2)
    labs = evidence.labs
    model = labs.load_base(labs.ModelConfig(base=labs.BUILTIN, dtype="float32"), seed=0)
    before = model.fingerprints()
    frames = torch.randint(0, 256, (12, 3, 96, 96), dtype=torch.uint8)
    pretrain.pretrain(model, frames, objective, 0)
    after = model.fingerprints()
    assert (after.encoder != before.encoder, after.predictor == before.predictor) == (True, True)
    assert not any(weight.requires_grad for weight in model.loaded_encoder.parameters())


def test_mask_covers_the_required_fraction_in_blocks(evidence: Any) -> None:
    rng = np.random.default_rng(0)
    masks = np.stack([evidence.pretrain_encoder.draw_mask(rng, 6) for _ in range(50)])
    assert masks.shape == (50, 36)
    assert masks.mean(axis=1).min() >= evidence.pretrain_encoder.MASKED
    assert masks.mean(axis=1).max() < 1


def test_rank_table_shows_which_part_of_the_improvement_of_full_fine_tuning_a_rank_gives(evidence: Any) -> None:
    widths, tables = evidence.widths, evidence.widths_tables
    cells = {}
    for method in widths.METHODS:
        trained = {"full fine-tuning": 0.6, "LoRA, rank 4": 0.7}.get(method, 0.8)
        values = {"base": 1.0, "adapter": trained}
        rows = {f"{name} {key}": value for name, value in values.items() for key in (tables.ERROR, tables.RANKING)}
        cells[128, method] = [{"rows": rows, "ends_cm": [1.0, 9.0]} for _ in widths.LABS]
    rows = {line.split("|")[1].strip(): line for line in tables.rank_table(cells, [128]).splitlines()}
    assert "| 50 % (15 to 85) | 70.0 % (75 % of full) |" in rows["LoRA, rank 4"]
    assert "| 100.0 % | 100.0 % |" in rows["base model"]


def test_base_models_of_all_widths_share_the_encoder_and_the_depth(evidence: Any) -> None:
    widths = evidence.widths
    models = [widths._make_fresh_model(width) for width in widths.WIDTHS]
    assert [model.sizes.predictor.width for model in models] == list(widths.WIDTHS)
    assert {model.sizes.predictor.depth for model in models} == {widths.DEPTH}
    assert len({model.encoder_fingerprint() for model in models}) == 1


def test_one_base_model_of_the_bases_study_is_the_built_in_one(evidence: Any, tmp_path: Path) -> None:
    builtin = [base for base in evidence.bases.BASES if evidence.bases.BaseModel(*base).location(tmp_path)[:1] != "/"]
    assert builtin == [("random", 0)]
