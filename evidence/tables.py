"""Write tables and plot of the methods study: all rows into results/methods.md, short tables into docs/evidence.md."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from textwrap import fill

import numpy as np
from environments import GOALS, OTHER, SAME, TASKS
from methods import AXES, BASES, BEFORE, BEST, FROM_PRIOR, IN_EVERY_ENVIRONMENT, LONGER, METHODS, SHIFTS
from offline import correlations
from results import (
    BASE_MODELS,
    CHANGES,
    Figures,
    describe_method,
    estimate_success,
    list_reached,
    select_main_cells,
    select_policy,
    select_results,
)
from scipy.stats import binomtest, spearmanr, ttest_rel

from vjepa2_ac.intervals import estimate_mean, estimate_share

FEWEST = 20  # cells of a correlation
NOT_MEASURED = "not measured | "  # two cells of a table
MIN_SEEDS = 3  # smallest number of seeds for a test over seeds
MIN_CHOICES = 5  # smallest number of choices for the table of choices
SHORT = ("zero-shot", AXES, BEST, LONGER, "full", "scratch", "scratch, 3x steps")  # rows of the short table
Correlated = dict[str, tuple[int, dict[str, dict[str, float]]]]  # by change: number of cells, and an interval by name
TASK_TITLES = {
    "Lift": "Lift (robosuite 1.5.2 with MuJoCo 3.9.0)",
    "LIBERO-object": "LIBERO-Spatial, objects changed (LIBERO-PRO 0.1.1 with MuJoCo 3.17.0)",
}
SHOWN_TASKS = ("Lift",)  # in LIBERO-object the change does not lower the success rate of the base model
GOAL_TITLES = {SAME: "frames of the problem's solution", OTHER: "frames of another demonstration"}
MARKS = {name: f"{name}, made by `make evidence`" for name in ("success", "difference", "metrics", "environments")}
OFFLINE = {  # numbers in the short table of correlations
    "cost of wrong actions, negative": "growth of the one-step error with shuffled actions",
    "action-ranking error": "**action-ranking error**",
    "Action Score, cm missed": "Action Score, three steps",
    "error over persistence, 3 steps": "rollout error relative to persistence, 0.8 s ahead",
}
COLOURS = {
    "zero-shot": "#999999",
    BEST: "#1f77b4",
    "full": "#2ca02c",
    "scratch": "#f4a582",
    "scratch, 3x steps": "#d62728",
}
HEAD = (
    "method | demonstrations | rollout error 0.27 / 0.53 / 0.80 s | zero / shuffled actions | success rate"
    " | distance, cm | hand arrived | trained weights | adapter, MB | CPU, min"
)
CHOICES = """A choice is between the models of one domain shift, base model and seed that have stored offline metrics: 3
to 8 models. The first table includes the base model, the second does not. *Regret*: the success rate of the best model
minus that of the selected one."""
NOTES = """- *rollout error*: L1 error relative to persistence, on held-out episodes after the domain shift; mean over
  seeds (smallest to largest 0.8 s ahead). *zero / shuffled actions*: one-step error relative to persistence with zero
  actions and with the actions of another clip.
- *success rate*: over all goals, with Wilson's interval, then the number of goals reached with each seed. Each seed has
  its own demonstrations, training and goals; the interval does not include the variation between seeds. In third-party
  environments: problems solved. *hand arrived*: the hand ends within 5 cm of the expert's hand.
- Third-party environments: Lift is from robosuite 1.5.2 with MuJoCo 3.9.0, LIBERO-object from LIBERO-PRO 0.1.1 with
  MuJoCo 3.17.0. Without a remark the goals are frames of the problem's solution, with a goal for each model step.
- Measured at commit 0d046757 or earlier and not repeated: *calibrated axes*, *features of block 3 of 4*, *rollout
  of*, *projections only*, *DoRA*, *Action Score*."""


def write_tables(results: Sequence[Figures], path: Path, docs: Path) -> None:
    """Write all rows to a file, the short tables between their marks in docs/evidence.md, and the plot."""
    correlated = correlated_numbers(results)
    adapted = [result for result in results if result["cell"]["episodes"]]
    choices = f"### Which metric selects a model?\n\n{CHOICES}\n\n{choice_table(results)}\n\n{choice_table(adapted)}"
    parts = (*_rows(results), goal_by_goal(results), choices, f"{NOTES}\n{_made_with(results)}")
    path.write_text("\n\n".join(part for part in parts if part) + "\n")
    texts = {
        "success": summary(results),
        "metrics": summary_of_correlations(correlated),
        "difference": difference_table(results),
        "environments": summary_of_tasks(results),
    }
    for part, table in texts.items():
        if table:
            insert_table(docs / "evidence.md", MARKS[part], table)
    draw(results, docs / "evidence.png")


def insert_table(page: Path, mark: str, table: str) -> None:
    """Replace the text between the marks of a table in a page."""
    begin, end = (f"<!-- {mark}: {word} -->" for word in ("begin", "end"))
    before, rest = page.read_text().split(begin)
    _, after = rest.split(end)
    page.write_text(f"{before}{begin}\n{table}\n{end}{after}")


def summary(results: Sequence[Figures]) -> str:
    """Return a table for each domain shift: the success rate of each method and base model, with Wilson's interval."""
    parts = []
    for shift in SHIFTS:
        columns = [(base, shift, SAME) for base in BASES]
        heads = [BASE_MODELS[base] for base in BASES]
        count = sum(len(list_reached(result)) for result in select_main_cells(results, BASES[0], BEST, shift))
        parts.append(f"**{_titled(CHANGES[shift])}** ({count} goals)\n\n{_rates(results, SHORT, columns, heads)}")
    return "\n\n".join(parts)


def summary_of_tasks(results: Sequence[Figures]) -> str:
    """Return a table for each task of a third-party environment: success rates by kind of goals, with intervals."""
    parts = []
    for task in SHOWN_TASKS:
        title, cells = TASK_TITLES[task], select_results(results, shift=task)
        columns = [(BASES[0], task, goals) for goals in GOALS if _with_goals(cells, goals)]
        heads = [GOAL_TITLES.get(goals, goals) for *_, goals in columns]
        count = sum(len(list_reached(result)) for result in select_main_cells(results, BASES[0], BEST, task))
        if count:
            table = _rates(results, (BEFORE, *IN_EVERY_ENVIRONMENT, FROM_PRIOR), columns, heads)
            parts.append(f"**{title}**, {count} problems\n\n{table}")
    return "\n\n".join(parts)


def _with_goals(results: Sequence[Figures], goals: str) -> list[Figures]:
    """Return the results that were measured with a kind of goals."""
    return [result for result in results if goals in result["reach"]]


def _rates(
    results: Sequence[Figures], methods: Sequence[str], columns: Sequence[tuple[str, str, str]], heads: Sequence[str]
) -> str:
    """Return a table with a row for each method, and a success rate and its interval for each column.

    A column is a base model, a domain shift and a kind of goals.
    """
    rows = ["| Method | " + " | ".join(f"{head} | 95 % interval" for head in heads) + " |"]
    rows.append("|---" * (2 * len(heads) + 1) + "|")
    for method in methods:
        shares = [
            _share(_with_goals(select_main_cells(results, base, method, shift), goals), goals)
            for base, shift, goals in columns
        ]
        if any(share != NOT_MEASURED for share in shares):
            rows.append(f"| {describe_method(method)} | {' | '.join(shares)} |")
    return "\n".join(rows)


def _share(cells: Sequence[Figures], goals: str) -> str:
    """Return a success rate and its interval, as two cells of a table."""
    if not cells:
        return NOT_MEASURED
    share = estimate_success(cells, goals)
    return f"{100 * share.value:.0f} % | {100 * share.low:.0f} to {100 * share.high:.0f} %"


def _rows(results: Sequence[Figures]) -> Iterator[str]:
    """Yield a table of all methods and numbers of demonstrations for each change and base."""
    for shift in (*SHIFTS, *TASKS):
        for base in (*BASES, "none"):
            rows = [
                _row(name, "", select_policy(results, base, name, shift))
                for name in ("zero action", "random", "oracle")
            ]
            counts = sorted({result["cell"]["episodes"] for result in select_results(results, shift=shift, base=base)})
            for method in METHODS:
                for count in counts:
                    cells = select_results(results, shift=shift, base=base, method=method, episodes=count)
                    rows += _rows_of_goals(describe_method(method), str(count or ""), cells)
            if any(rows):
                title = f"### {_titled(CHANGES.get(shift, shift))}, {BASE_MODELS[base]}"
                rule = "|" + "---|" * (HEAD.count("|") + 1)
                yield "\n".join([f"{title}\n\n| {HEAD} |", rule, *filter(None, rows)])


def _titled(words: str) -> str:
    return words[0].upper() + words[1:]


def _rows_of_goals(name: str, demonstrations: str, cells: Sequence[Figures]) -> list[str]:
    """Return a row for each kind of goals with which cells were measured."""
    return [
        _row(name if goals == SAME else f"{name}; goals: {goals}", demonstrations, _with_goals(cells, goals), goals)
        for goals in GOALS
    ]


def _row(name: str, demonstrations: str, cells: Sequence[Figures], goals: str = SAME) -> str:
    """Return a row, empty where there are no cells."""
    if not cells:
        return ""
    error = wrong = trained = size = minutes = ""
    if shifted := [result["shifted"] for result in cells if "shifted" in result]:
        errors = np.array([result["rollout_over_persistence"] for result in shifted])
        means = " / ".join(f"{value:.3f}" for value in errors.mean(axis=0))
        error = f"{means} ({errors[:, -1].min():.3f} to {errors[:, -1].max():.3f})"
        zero, shuffled = (
            np.mean([result[f"one_step_{mode}_actions"] for result in shifted]) for mode in ("zero", "shuffled")
        )
        wrong = f"{zero:.3f} / {shuffled:.3f}"
    if cells[0].get("trained_share"):
        trained, size = f"{cells[0]['trained_share']:.1%}", f"{cells[0]['adapter_mb']:.2f}"
        minutes = f"{np.mean([result['cpu_minutes'] for result in cells]):.1f}"
    arrived = [flag for result in cells for flag in result["reach"][goals].get("arrived", ())]
    hand = f"{np.mean(arrived):.0%}" if arrived else ""
    row = [
        name,
        demonstrations,
        error,
        wrong,
        _reach(cells, goals),
        _distance(cells, goals),
        hand,
        trained,
        size,
        minutes,
    ]
    return f"| {' | '.join(row)} |"


def _reach(cells: Sequence[Figures], goals: str) -> str:
    """Return the share of all goals with Wilson's interval, and how many each seed reached."""
    by_seed = [list_reached(result, goals) for result in cells]
    share = estimate_share(sum(map(sum, by_seed)), sum(map(len, by_seed)))
    seeds = ", ".join(str(sum(flags)) for flags in by_seed)
    return f"{share.value:.0%} ({share.low:.0%} to {share.high:.0%}) of {sum(map(len, by_seed))}: {seeds}"


def _distance(cells: Sequence[Figures], goals: str) -> str:
    ends = np.array([end for result in cells for end in result["reach"][goals]["ends_cm"]])
    mean = estimate_mean(ends, [str(index) for index in range(len(ends))])
    return f"{mean.value:.1f} ({mean.low:.1f} to {mean.high:.1f})" if mean.has_interval else f"{mean.value:.1f}"


def goal_by_goal(results: Sequence[Figures]) -> str:
    """Return the number of goals that only LoRA reached, that only another method reached, and three p-values.

    All methods have the same goals for one domain shift and seed. Sources of the tests: McNemar (1947), the exact form;
    Holm (1979), over all rows; and a paired t-test over seeds, which does not treat goals as independent.
    """
    labels, p_values = list[str](), list[float]()
    for shift in (*SHIFTS, *TASKS):
        for base in BASES if shift in SHIFTS else BASES[:1]:
            for other in [name for name in METHODS if name not in {BEST, BEFORE}]:
                by_seed = list(_pairs(results, shift, base, other))
                pairs = [pair for seed in by_seed for pair in seed]
                won = sum(ours and not theirs for ours, theirs in pairs)
                lost = sum(theirs and not ours for ours, theirs in pairs)
                if won + lost:
                    where = f"{CHANGES.get(shift, shift)}{f', {BASE_MODELS[base]}' * (shift in SHIFTS)}"
                    seeds = _test_over_seeds(by_seed)
                    labels.append(f"| {where} | {describe_method(other)} | {len(pairs)} | {won} | {lost} | {seeds}")
                    p_values.append(float(binomtest(won, won + lost).pvalue))
    rows = [
        f"{label} | {_p(value)} | {_p(corrected)} |"
        for label, value, corrected in zip(labels, p_values, correct_by_holm(p_values), strict=True)
    ]
    title = f"### {describe_method(BEST)}, compared goal by goal"
    heads = "domain shift | compared with | goals | reached by LoRA only | reached by the other only"
    tests = "p over seeds | p over goals | p over goals, corrected"
    head = f"{title}\n\n| {heads} | {tests} |\n|" + "---|" * 8
    return "\n".join([head, *rows]) if rows else ""


def difference_table(results: Sequence[Figures]) -> str:
    """Return the success rate of LoRA minus that of full fine-tuning, with an interval over goals."""
    rows = ["| Domain shift, base model | difference in points | 95 % interval |", "|---|---|---|"]
    titles = CHANGES | TASK_TITLES
    for shift in (*SHIFTS, *TASKS):
        for base in BASES if shift in SHIFTS else BASES[:1]:
            pairs = [pair for seed in _pairs(results, shift, base, "full") for pair in seed]
            if pairs:
                differences = [100.0 * (ours - theirs) for ours, theirs in pairs]
                label = f"{titles[shift]}{f', {BASE_MODELS[base]}' * (shift in SHIFTS)}"
                rows.append(f"| {label} | {_mean_cells(differences, '+.1f')} |")
    return "\n".join(rows)


def correct_by_holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values that are corrected for the number of tests. Source: Holm (1979)."""
    order = np.argsort(p_values)
    factors = np.arange(len(order), 0, -1)
    corrected = np.minimum(1.0, np.maximum.accumulate(np.array(p_values)[order] * factors))
    return [float(value) for value in corrected[np.argsort(order)]]


def _test_over_seeds(by_seed: Sequence[Sequence[tuple[bool, bool]]]) -> str:
    """Return the p-value of a paired t-test over the seeds' numbers of reached goals; empty with fewer than 3 seeds."""
    ours, theirs = (np.array([sum(pair[side] for pair in pairs) for pairs in by_seed]) for side in (0, 1))
    differences = ours - theirs
    if len(differences) < MIN_SEEDS or np.ptp(differences) == 0:
        return ""
    return _p(float(ttest_rel(ours, theirs).pvalue))


def _p(value: float) -> str:
    return f"{value:.3f}" if value >= 0.0005 else "< 0.001"


def _pairs(results: Sequence[Figures], shift: str, base: str, other: str) -> Iterator[list[tuple[bool, bool]]]:
    """Yield for each seed which goals LoRA and another method reached, with the demonstrations of the main tables."""
    ours = {result["cell"]["seed"]: result for result in select_main_cells(results, base, BEST, shift)}
    for theirs in select_main_cells(results, base, other, shift):
        if result := ours.get(theirs["cell"]["seed"]):
            yield list(zip(list_reached(result), list_reached(theirs), strict=True))


def correlated_numbers(results: Sequence[Figures]) -> Correlated:
    """Return correlations of offline metrics with missed goals: for all domain shifts, and for randomised scenes."""
    cells = [result for result in results if "offline" in result and "visited" in result["reach"]["l1"]]
    groups = {"all": cells, "randomized": [result for result in cells if result["cell"]["shift"] == "randomized"]}
    correlated = {}
    for shift, group in groups.items():
        if len(group) >= FEWEST:
            missed = [-float(np.mean(list_reached(result))) for result in group]
            kinds = [tuple(result["cell"][key] for key in ("shift", "base", "method", "episodes")) for result in group]
            correlated[shift] = len(group), correlations([_offline_row(result) for result in group], missed, kinds)
    return correlated


def choice_table(results: Sequence[Figures]) -> str:
    """Return how well each metric selects one of the models that were trained from one base model for one shift.

    A choice is between the models of one domain shift, base model and seed, with the base model among them. Regret is
    the success rate of the best of these models minus that of the selected model.
    """
    choices: dict[tuple[str, str, int], list[Figures]] = {}
    for result in results:
        cell = result["cell"]
        if "offline" in result and cell["base"] != "none" and cell["episodes"] in {0, 20}:
            choices.setdefault((cell["shift"], cell["base"], cell["seed"]), []).append(result)
    models_of_choices = [models for models in choices.values() if len(models) > 2]
    if len(models_of_choices) < MIN_CHOICES:
        return ""
    rates = [[float(np.mean(list_reached(model))) for model in models] for models in models_of_choices]
    metrics = {
        title: [[_offline_row(model)[name] for model in models] for models in models_of_choices]
        for name, title in OFFLINE.items()
    }
    return rate_choices(metrics, rates)


def rate_choices(metrics: Mapping[str, Sequence[Sequence[float]]], rates: Sequence[Sequence[float]]) -> str:
    """Return rank correlation and regret of each metric, over choices between several models.

    The gain is the success rate of the selected model minus the average of the models, paired by choice.

    Args:
        metrics: Values by metric, choice and model; lower is better.
        rates: Success rates by choice and model.
    """
    rows = []
    for title, values_of_choices in metrics.items():
        pairs = list(zip(values_of_choices, rates, strict=True))
        correlation = [-spearmanr(values, rate).statistic for values, rate in pairs if len(set(rate)) > 1]
        selected = [rate[int(np.argmin(values))] for values, rate in pairs]
        regret = np.mean([100 * (max(rate) - each) for each, rate in zip(selected, rates, strict=True)])
        gain = [100 * (each - float(np.mean(rate))) for each, rate in zip(selected, rates, strict=True)]
        rows.append(f"| {title} | {_mean_cells(correlation, '.2f')} | {regret:.1f} | {_mean_cells(gain, '+.1f')} |")
    average = np.mean([100 * (max(rate) - float(np.mean(rate))) for rate in rates])
    rows.append(f"| none: average of all models |  |  | {average:.1f} |  |  |")
    heads = (
        f"Metric, {len(rates)} choices | rank correlation | 95 % interval | regret in points"
        " | gain over the average in points | 95 % interval"
    )
    return "\n".join([f"| {heads} |", "|---" * 6 + "|", *rows])


def _mean_cells(values: Sequence[float], form: str) -> str:
    """Return a mean and its interval over choices, as two cells of a table."""
    mean = estimate_mean(np.array(values), [str(index) for index in range(len(values))])
    return f"{mean.value:{form}} | {mean.low:{form}} to {mean.high:{form}}"


def _offline_row(result: Figures) -> dict[str, float]:
    shifted = result["shifted"]
    errors = enumerate(shifted["rollout_over_persistence"], start=1)
    return {
        **{f"error over persistence, {step} steps": value for step, value in errors},
        "cost of wrong actions, negative": 1 - shifted["one_step_shuffled_actions"] / shifted["one_step"],
        **result["offline"],
    }


def summary_of_correlations(correlated: Correlated) -> str:
    """Return the short table of correlations: over all domain shifts, and with fully randomised scenes."""
    if not correlated:
        return ""
    heads = [f"{CHANGES.get(name, 'all domain shifts')}, n = {count}" for name, (count, _) in correlated.items()]
    rows = [
        f"| {words} | {' | '.join(_interval(numbers[name]) for _, numbers in correlated.values())} |"
        for name, words in OFFLINE.items()
    ]
    head = " | ".join(f"{title} | 95 % interval" for title in heads)
    return "\n".join([f"| Metric | {head} |", "|---" * (2 * len(heads) + 1) + "|", *rows])


def _interval(estimate: dict[str, float]) -> str:
    return f"{estimate['value']:.2f} | {estimate['low']:.2f} to {estimate['high']:.2f}"


def _made_with(results: Sequence[Figures]) -> str:
    """Return which commits and versions computed the cells, and how many each."""
    names = Counter(
        "torch {torch}, commit {commit}".format(**result["made_with"]) if "made_with" in result else "not recorded"
        for result in results
    )
    return "- Made with " + "; ".join(f"{name} ({count} cells)" for name, count in names.most_common()) + "."


def draw(results: Sequence[Figures], path: Path) -> None:
    """Plot the share of goals reached, a group of bars for each change and base."""
    from vjepa2_ac.media.figure import new_figure

    figure = new_figure(8.0, 5.0, layout="constrained")
    axes = figure.subplots()
    groups, bars = [(shift, base) for shift in SHIFTS for base in BASES], {}
    for position, (name, colour) in enumerate(COLOURS.items()):
        for group, (shift, base) in enumerate(groups):
            if cells := select_main_cells(results, base, name, shift):
                share, at = estimate_success(cells), group + 0.16 * (position - 2)
                error = [[share.value - share.low], [share.high - share.value]]
                bars[describe_method(name)] = axes.bar(at, share.value, 0.15, yerr=error, capsize=2, color=colour)
    names = [f"{fill(CHANGES[shift], 14)}\n({fill(base, 14)})" for shift, base in groups]
    axes.set_xticks(range(len(groups)), names)
    axes.set_ylim(0, 1.05)
    axes.set_ylabel("success rate (within 5 cm of the goal at the end)")
    axes.set_title("Reach after a domain shift, 20 demonstrations; error bars: 95 % intervals")
    axes.legend(bars.values(), bars, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.23))
    figure.savefig(path, dpi=140)
