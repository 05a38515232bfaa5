"""Write tables and plot of the methods study: all rows into results/methods.md, short tables into docs/evidence.md."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from environments import TASKS
from methods import AXES, BASES, BEFORE, BEST, FROM_PRIOR, IN_EVERY_WORLD, LONGER, METHODS, SHIFTS
from offline import correlations
from results import CHANGES, Figures, main_cells, of_policy, pick, reached, share_reached
from scipy.stats import binomtest

from vjepa2_ac.intervals import mean_of, share_of

FEWEST = 20  # cells of a correlation
SHORT = ("zero-shot", AXES, BEST, LONGER, "full", "scratch", "scratch, 3x steps")  # rows of the short table
Correlated = dict[str, tuple[int, dict[str, dict[str, float]]]]  # by change: number of cells, and an interval by name
MARKS = {  # of the short tables in the page
    "": "made by `make evidence`",
    "trust": "which figure, made by `make evidence`",
    "worlds": "worlds, made by `make evidence`",
}
OFFLINE = {  # numbers in the short table of correlations
    "energy and distance over visited plans, negative": "energy and distance over visited plans",
    "cost of wrong actions, negative": "cost of shuffled actions",
    "action-ranking error": "**action-ranking error**",
    "Action Score, cm missed": "Action Score of three steps",
    "error over persistence, 3 steps": "error over persistence, 0.8 s ahead",
}
COLOURS = {
    "zero-shot": "#999999",
    BEST: "#1f77b4",
    "full": "#2ca02c",
    "scratch": "#f4a582",
    "scratch, 3x steps": "#d62728",
}
HEAD = (
    "method | demonstrations | error 0.27 / 0.53 / 0.80 s | zero / shuffled actions | reached at the end | distance, cm"
    " | hand arrived | trained | MB | CPU min"
)
NOTES = """- *error*: open-loop L1 error over persistence, on held-out episodes of the changed scene; mean over
  seeds (smallest to largest 0.8 s ahead). *zero / shuffled actions*: one-step error without actions and with another
  clip's.
- *reached*: share of all goals with Wilson's interval, then the number that each seed reached. A seed is a model with
  its own demonstrations and goals, so the interval leaves out a part of the variation. In third-party environments:
  problems solved; *hand arrived*: the hand ends within 5 cm of the expert's.
- Measured at commit 0d046757 or earlier, and not run again: *calibrated axes*, *features of block 3 of 4*, *rollout
  of*, *in/out only*, *DoRA*, *energy and distance over visited plans*, *Action Score*, *plan of one step*."""


def write_tables(results: Sequence[Figures], path: Path, page: Path) -> None:
    """Write all rows to a file, and the short tables between their marks in a page."""
    correlated = correlated_numbers(results)
    parts = (*_rows(results), goal_by_goal(results), f"{NOTES}\n{_made_with(results)}")
    path.write_text("\n\n".join(part for part in parts if part) + "\n")
    texts = {"": summary(results), "trust": summary_of_correlations(correlated), "worlds": summary_of_tasks(results)}
    for part, table in texts.items():
        if table:
            begin, end = (f"<!-- {MARKS[part]}: {word} -->" for word in ("begin", "end"))
            before, rest = page.read_text().split(begin)
            _, after = rest.split(end)
            page.write_text(f"{before}{begin}\n{table}\n{end}{after}")


def summary(results: Sequence[Figures]) -> str:
    """Return the share of goals that each method reaches after each change, with Wilson's interval."""
    columns = [(shift, base) for shift in SHIFTS for base in BASES]
    heads = [f"{CHANGES[shift]}; {base}" for shift, base in columns]
    rows = [f"| 20 demonstrations | trained | {' | '.join(heads)} |", "|---|---|" + "---|" * len(columns)]
    for method in SHORT:
        cells = [main_cells(results, base, method, shift) for shift, base in columns]
        share = next((one["trained_share"] for some in cells for one in some), 0.0)
        if any(cells):
            rows.append(f"| {method} | {f'{share:.1%}' if share else ''} | {' | '.join(map(_share, cells))} |")
    return "\n".join(rows)


def summary_of_tasks(results: Sequence[Figures]) -> str:
    """Return the share of problems in third-party environments that each method solves, and the number of seeds."""
    tasks = [task for task in TASKS if pick(results, shift=task, method=BEST)]
    if not tasks:
        return ""
    counts = [len(pick(results, shift=task, method=BEST, episodes=20)) for task in tasks]
    heads = [f"{task} ({count} seeds)" if count > 1 else task for task, count in zip(tasks, counts, strict=True)]
    rows = [f"| 20 demonstrations | {' | '.join(heads)} |", "|---|" + "---|" * len(tasks)]
    rows += [
        f"| {method} | {' | '.join(_share(main_cells(results, BASES[0], method, task)) for task in tasks)} |"
        for method in (BEFORE, *IN_EVERY_WORLD, FROM_PRIOR)
    ]
    return "\n".join(rows)


def _share(cells: Sequence[Figures]) -> str:
    if not cells:
        return ""
    share = share_reached(cells)
    return f"{share.value:.0%} [{100 * share.low:.0f}, {100 * share.high:.0f}]"


def _rows(results: Sequence[Figures]) -> Iterator[str]:
    """Yield a table of all methods and numbers of demonstrations for each change and base."""
    for shift in (*SHIFTS, *TASKS):
        for base in (*BASES, "none"):
            rows = [
                _row(name, "", of_policy(results, base, name, shift)) for name in ("zero action", "random", "oracle")
            ]
            counts = sorted({one["cell"]["episodes"] for one in pick(results, shift=shift, base=base)})
            for method in METHODS:
                for count in counts:
                    cells = pick(results, shift=shift, base=base, method=method, episodes=count)
                    rows.append(_row(method, str(count or ""), cells))
            if any(rows):
                title = f"### {CHANGES.get(shift, shift).capitalize()}; base: {base}"
                rule = "|" + "---|" * (HEAD.count("|") + 1)
                yield "\n".join([f"{title}\n\n| {HEAD} |", rule, *filter(None, rows)])


def _row(name: str, demonstrations: str, cells: Sequence[Figures]) -> str:
    """Return a row, empty where there are no cells."""
    if not cells:
        return ""
    error = wrong = trained = size = minutes = ""
    if shifted := [one["shifted"] for one in cells if "shifted" in one]:
        errors = np.array([one["rollout_over_persistence"] for one in shifted])
        means = " / ".join(f"{value:.3f}" for value in errors.mean(axis=0))
        error = f"{means} ({errors[:, -1].min():.3f} to {errors[:, -1].max():.3f})"
        zero, shuffled = (np.mean([one[f"one_step_{way}_actions"] for one in shifted]) for way in ("zero", "shuffled"))
        wrong = f"{zero:.3f} / {shuffled:.3f}"
    if cells[0].get("trained_share"):
        trained, size = f"{cells[0]['trained_share']:.1%}", f"{cells[0]['adapter_mb']:.2f}"
        minutes = f"{np.mean([one['cpu_minutes'] for one in cells]):.1f}"
    arrived = [flag for one in cells for flag in one["reach"]["l1"].get("arrived", ())]
    hand = f"{np.mean(arrived):.0%}" if arrived else ""
    row = [name, demonstrations, error, wrong, _reach(cells), _distance(cells), hand, trained, size, minutes]
    return f"| {' | '.join(row)} |"


def _reach(cells: Sequence[Figures]) -> str:
    """Return the share of all goals with Wilson's interval, and how many each seed reached."""
    by_seed = [reached(one) for one in cells]
    share = share_of(sum(map(sum, by_seed)), sum(map(len, by_seed)))
    seeds = ", ".join(str(sum(flags)) for flags in by_seed)
    return f"{share.value:.0%} ({share.low:.0%} to {share.high:.0%}) of {sum(map(len, by_seed))}: {seeds}"


def _distance(cells: Sequence[Figures]) -> str:
    ends = np.array([end for one in cells for end in one["reach"]["l1"]["ends_cm"]])
    mean = mean_of(ends, [str(place) for place in range(len(ends))])
    return f"{mean.value:.1f} ({mean.low:.1f} to {mean.high:.1f})" if mean.has_interval else f"{mean.value:.1f}"


def goal_by_goal(results: Sequence[Figures]) -> str:
    """Return the goals that LoRA alone reached, those that another method alone did, and the probability by chance.

    All methods of a change and a seed have the same goals. Source of the test: McNemar (1947), the exact form.
    """
    rows = []
    for shift in (*SHIFTS, *TASKS):
        for base in BASES if shift in SHIFTS else BASES[:1]:
            for other in [name for name in METHODS if name not in {BEST, BEFORE}]:
                pairs = list(_pairs(results, shift, base, other))
                won = sum(ours and not theirs for ours, theirs in pairs)
                lost = sum(theirs and not ours for ours, theirs in pairs)
                if won + lost:
                    chance = binomtest(won, won + lost).pvalue
                    where = f"{CHANGES.get(shift, shift)}{f'; {base}' * (shift in SHIFTS)}"
                    p = f"{chance:.3f}" if chance >= 0.0005 else "< 0.001"
                    rows.append(f"| {where} | {other} | {len(pairs)} | {won} | {lost} | {p} |")
    head = f"### {BEST} against others, goal by goal\n\n| change | against | goals | won | lost | p |\n|" + "---|" * 6
    return "\n".join([head, *rows]) if rows else ""


def _pairs(results: Sequence[Figures], shift: str, base: str, other: str) -> Iterator[tuple[bool, bool]]:
    """Yield which goals LoRA and another method reached, with the demonstrations of the main tables."""
    ours = {one["cell"]["seed"]: one for one in main_cells(results, base, BEST, shift)}
    for theirs in main_cells(results, base, other, shift):
        if one := ours.get(theirs["cell"]["seed"]):
            yield from zip(reached(one), reached(theirs), strict=True)


def correlated_numbers(results: Sequence[Figures]) -> Correlated:
    """Return correlations of offline numbers with goals missed: over all changes of the simulated arm, and one."""
    cells = [one for one in results if "offline" in one and "visited" in one["reach"]["l1"]]
    groups = {"all": cells, "randomized": [one for one in cells if one["cell"]["shift"] == "randomized"]}
    correlated = {}
    for label, some in groups.items():
        if len(some) >= FEWEST:
            missed = [-float(np.mean(reached(one))) for one in some]
            kinds = [tuple(one["cell"][key] for key in ("shift", "base", "method", "episodes")) for one in some]
            correlated[label] = len(some), correlations([_offline_row(one) for one in some], missed, kinds)
    return correlated


def _offline_row(one: Figures) -> dict[str, float]:
    shifted = one["shifted"]
    errors = enumerate(shifted["rollout_over_persistence"], start=1)
    return {
        **{f"error over persistence, {step} steps": value for step, value in errors},
        "cost of wrong actions, negative": 1 - shifted["one_step_shuffled_actions"] / shifted["one_step"],
        **one["offline"],
        "energy and distance over visited plans, negative": -one["reach"]["l1"]["visited"],
    }


def summary_of_correlations(correlated: Correlated) -> str:
    """Return the short table of correlations: over all changes, and where every episode differs."""
    if not correlated:
        return ""
    heads = [f"{CHANGES.get(label, 'all changes')}, {count} cells" for label, (count, _) in correlated.items()]
    rows = [
        f"| {words} | {' | '.join(_interval(numbers[name]) for _, numbers in correlated.values())} |"
        for name, words in OFFLINE.items()
    ]
    return "\n".join([f"| | {' | '.join(heads)} |", "|---|" + "---|" * len(correlated), *rows])


def _interval(one: dict[str, float]) -> str:
    return f"{one['value']:.2f} [{one['low']:.2f}, {one['high']:.2f}]"


def _made_with(results: Sequence[Figures]) -> str:
    """Return which commits and versions computed the cells, and how many each."""
    names = Counter(
        "torch {torch}, commit {commit}".format(**one["made_with"]) if "made_with" in one else "not recorded"
        for one in results
    )
    return "- Made with " + "; ".join(f"{name} ({count} cells)" for name, count in names.most_common()) + "."


def draw(results: Sequence[Figures], path: Path) -> None:
    """Plot the share of goals reached, a group of bars for each change and base."""
    from vjepa2_ac.media.figure import new_figure

    figure = new_figure(9.2, 4.6, layout="constrained")
    axes = figure.subplots()
    groups, shown = [(shift, base) for shift in SHIFTS for base in BASES], {}
    for place, (name, colour) in enumerate(COLOURS.items()):
        for group, (shift, base) in enumerate(groups):
            if cells := main_cells(results, base, name, shift):
                share, at = share_reached(cells), group + 0.16 * (place - 2)
                error = [[share.value - share.low], [share.high - share.value]]
                shown[name] = axes.bar(at, share.value, 0.15, yerr=error, capsize=2, color=colour)
    axes.set_xticks(range(len(groups)), [f"{CHANGES[shift]}\nbase of {base}" for shift, base in groups], fontsize=8)
    axes.set_ylim(0, 1.05)
    axes.set_ylabel("goals reached: within 5 cm at the end")
    axes.set_title("Reach after a change of the scene, 20 demonstrations", fontsize=11)
    axes.legend(shown.values(), shown, fontsize=8, ncols=len(COLOURS), loc="upper center", bbox_to_anchor=(0.5, -0.14))
    figure.savefig(path, dpi=130)
