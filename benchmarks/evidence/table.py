"""What came out? One table and one plot over all cells that are done, in Markdown and PNG."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from cells import (
    AXES,
    BASES,
    BEFORE,
    BEST,
    FROM_PRIOR,
    IN_EVERY_WORLD,
    IN_SOME_WORLDS,
    LONGER,
    METHODS,
    SHIFTS,
    TURNS,
)
from offline import correlations
from other_worlds import MANY, TASKS
from plot import draw
from results import CHANGES, Figures, arrived, last, main_cells, of_policy, pick, reached, read_results, share_reached
from scipy.stats import binomtest

from vjepa2_ac.intervals import mean_of, share_of

FEWEST = 20  # cells from which a correlation is told
EPISODES = 20  # demonstrations of a cell of the main tables
SHORT = ("zero-shot", AXES, BEST, LONGER, "full", "scratch", "scratch, 3x steps")  # of the short table
TABLE, PLOT = "evidence.md", "evidence.png"
Correlated = dict[str, tuple[int, dict[str, dict[str, float]]]]  # by change: number of cells, and by figure an interval
MARKS = {  # of the short tables in a page
    "": "made by `make evidence`",
    "trust": "which figure, made by `make evidence`",
    "worlds": "worlds, made by `make evidence`",
}
TOLD = {  # offline figures in the short table
    "energy and distance over visited plans, negative": "energy and distance over visited plans",
    "cost of wrong actions, negative": "cost of shuffled actions",
    "action-ranking error": "**action-ranking error**",
    "Action Score, cm missed": "Action Score of three steps",
    "error over persistence, 3 steps": "error over persistence, 0.8 s ahead",
}

NOTES = """Read it so:

- *LoRA*: on the layers of the blocks; *+ in/out*: the layers before and after the blocks are trained whole, beside it.
- *error*: open-loop L1 error over that of copying the first frame, on held-out episodes of the changed world; mean over
  seeds (smallest to largest 0.8 s ahead). *zero / shuffled actions*: one-step error with no actions and with another
  clip's, over persistence.
- *reach at the end*: of all goals, with Wilson's interval, then how many each seed reached. A seed is a model of its
  own with its own demonstrations and goals, so the interval leaves out part of what chance does: look at the seeds.
  Decision n of every episode draws the same noise.
- *calibrated axes*: no weight is trained. The base plans in axes fitted to 200 pairs of frames of the demonstrations;
  where the fit is refused (its angle stays unknown), it plans as zero-shot. Its error is that of turned actions.
- *L2 energy*: the same when plans are compared by squared error. *error on A, on*: 0.8 s ahead, in the world that the
  base was trained on, adapter on; off: whether switching it off gives the base's figures back to the last bit.
- *scratch* keeps the frozen encoder of the bases and starts close to copying: a kind start. Learning rates were chosen
  for every change apart (of other worlds on Lift, for all), with 20 demonstrations, seed 0, on validation goals
  (`--choose`): of LoRA for ranks 16 and 32 with in/out, of full fine-tuning and of scratch; all else inherits them.
- *behaviour cloning*: an action prior (`vjepa2-ac prior`), which does not search.
- *all anew*: measured before `SimulatedArm.reset_clock` existed. Every goal had a new arm, so objects that circle were
  at the same places for every method. Today they start 0.13 s earlier on their circles: a repetition, which takes
  hours and was not done, would see other images."""


def write_tables(folder: Path, out: Path, page: Path | None = None, done: Path | None = None) -> None:
    """Write evidence.md, .json and .png of what is there, print the table, and put the short one into a page.

    Raises:
        ValueError: The page has no place for it.
    """
    results = read_results(folder / "results", done)
    if not results:
        print(f"nothing to show: no cell is done in {folder / 'results'}")
        return
    out.mkdir(parents=True, exist_ok=True)
    correlated = correlated_figures(results)
    text = "\n\n".join(
        part
        for part in (
            _main(results),
            _shifted(results, "motion"),
            _shifted(results, "randomized"),
            _axes(results),
            _by_episodes(results),
            _lora(results),
            of_worlds(results),
            goal_by_goal(results),
            trust(correlated),
        )
        if part
    )
    text = f"{text}\n\n{NOTES}\n{_made_with(results)}"
    (out / TABLE).write_text(text + "\n")
    (out / "evidence.json").write_text(json.dumps(results) + "\n")
    print(text)
    draw(results, out / PLOT)
    if page is not None:
        write_summary(results, correlated, page)
    print(f"\n{out / TABLE}\n{out / PLOT}")


def write_summary(results: Sequence[Figures], correlated: Correlated, page: Path) -> None:
    """Put the short tables between their marks in a page, which stays as it is otherwise; also where none is done yet.

    Raises:
        ValueError: The marks are not there.
    """
    texts = {"": summary(results), "trust": summary_of_trust(correlated), "worlds": summary_of_worlds(results)}
    for part, text in texts.items():
        if not text:
            continue
        before, begin, end, after = place_in(page, part)
        page.write_text(f"{before}{begin}\n{text}\n{end}{after}")


def place_in(page: Path, part: str = "") -> tuple[str, str, str, str]:
    """Return what stands before a short table in a page, the marks around it, and what stands after it.

    Raises:
        ValueError: The marks are not there.
    """
    marks = [f"<!-- {MARKS[part]}: {end} -->" for end in ("begin", "end")]
    before, begin, rest = page.read_text().partition(marks[0])
    _, end, after = rest.partition(marks[1])
    if not (begin and end):
        raise ValueError(f"{page} has no {marks[0]} ... {marks[1]}")
    return before, begin, end, after


def summary(results: Sequence[Figures]) -> str:
    """Return the short table: the share of goals that the methods of every change reach, with Wilson's interval."""
    columns = [(shift, base) for shift in SHIFTS for base in BASES]
    heads = [f"{CHANGES[shift]}; {base}" for shift, base in columns]
    rows = [f"| {EPISODES} demonstrations | trained | {' | '.join(heads)} |", "|---|---|" + "---|" * len(columns)]
    for method in map(METHODS.__getitem__, SHORT):
        found = [main_cells(results, base, method.name, shift) for shift, base in columns]
        share = next((one["trained_share"] for cells in found for one in cells), 0.0)
        if any(found):
            rows.append(f"| {method.name} | {f'{share:.1%}' if share else ''} | {' | '.join(map(_share, found))} |")
    return "\n".join(rows)


def summary_of_worlds(results: Sequence[Figures]) -> str:
    """Return the short table of worlds that others made: the share of problems that were solved, and how many seeds."""
    tasks = [task for task in TASKS if pick(results, shift=task, method=BEST)]
    if not tasks:
        return ""
    counts = [len(pick(results, shift=task, method=BEST, episodes=EPISODES)) for task in tasks]
    heads = [f"{task} ({count} seeds)" if count > 1 else task for task, count in zip(tasks, counts, strict=True)]
    rows = [f"| {EPISODES} demonstrations | {' | '.join(heads)} |", "|---|" + "---|" * len(tasks)]
    rows += [
        f"| {method} | {' | '.join(_share(main_cells(results, BASES[0], method, task)) for task in tasks)} |"
        for method in (BEFORE, *IN_EVERY_WORLD, FROM_PRIOR)
    ]
    return "\n".join(rows)


def _hand(found: Sequence[Figures]) -> str:
    """Return in which share of all problems of some cells the hand arrived."""
    flags = [flag for one in found for flag in arrived(one)]
    return f"; hand {np.mean(flags):.0%}" if flags else ""


def _share(found: Sequence[Figures]) -> str:
    """Return the share of all goals or problems of some cells that were reached, with its interval."""
    if not found:
        return ""
    share = share_reached(found)
    return f"{share.value:.0%} [{100 * share.low:.0f}, {100 * share.high:.0f}]"


def _main(results: Sequence[Figures]) -> str:
    parts = ["### Another camera, light, colours and table (20 demonstrations)"]
    for base in BASES:
        rows = _policies(results, base)
        for method in METHODS.values():
            found = main_cells(results, base, method.name)
            if found:
                rows.append(_row(method.name, found))
        if len(rows) > 3:
            parts.append(f"Base of **{base}**\n\n" + _table(rows))
    return "\n\n".join(parts) if len(parts) > 1 else ""


def _shifted(results: Sequence[Figures], shift: str) -> str:
    rows = _policies(results, BASES[0], shift)
    for base in (*BASES, "none"):
        for method in METHODS.values():
            found = pick(results, shift=shift, base=base, method=method.name)
            rows += [_row(method.name if base == "none" else f"{method.name} ({base})", found)] if found else []
    return f"### {CHANGES[shift].capitalize()} ({EPISODES} demonstrations)\n\n" + _table(rows) if rows else ""


def _axes(results: Sequence[Figures]) -> str:
    """Return which turns were fitted to the demonstrations, seed by seed, beside the true ones."""
    lines = []
    for shift, true in TURNS.items():
        for base in BASES:
            found = pick(results, shift=shift, base=base, method=AXES)
            fits = [
                f"{one['axes']['yaw_degrees']['value']:+.0f}" + (" (refused)" if one["axes"]["problem"] else "")
                for one in found
            ]
            lines += [f"- {shift}, {base}: yaw {'; '.join(fits)}; true {true:+.0f} degrees"] if fits else []
    return "### Calibrated axes\n\n" + "\n".join(lines) if lines else ""


def _by_episodes(results: Sequence[Figures]) -> str:
    rows = []
    with_base = [(base, method) for base in BASES for method in (BEST, "full")]
    for base, method in [*with_base, ("none", "scratch"), ("none", "scratch, 3x steps")]:
        for episodes in (10, 20, 40):
            found = pick(results, shift="look", base=base, method=method, episodes=episodes)
            if found:
                rows.append(_row(f"{method} ({base}), {episodes} demonstrations", found))
    few = any(one["cell"]["episodes"] in (10, 40) for one in results)
    return "### By the number of demonstrations\n\n" + _table(rows) if few else ""


def _lora(results: Sequence[Figures]) -> str:
    """Return what share of full fine-tuning's gain each LoRA has, seed by seed, and how its reaching compares."""
    lines = []
    for base in BASES:
        for method in METHODS.values():
            if method.kind != "LoRA":
                continue
            shares, ours, theirs = [], 0, 0
            for one in pick(results, shift="look", base=base, method=method.name, episodes=20):
                seed = one["cell"]["seed"]
                full = pick(results, shift="look", base=base, method="full", episodes=20, seed=seed)
                start = pick(results, shift="look", base=base, method="zero-shot", seed=seed)
                if full and start:
                    before = last(start[0])
                    shares.append((before - last(one)) / (before - last(full[0])))
                    ours += sum(reached(one))
                    theirs += sum(reached(full[0]))
            if shares:
                spread = f"{min(shares):.1%} to {max(shares):.1%} over {len(shares)} seeds"
                lines.append(
                    f"- {base}, {method.name}: {np.mean(shares):.1%} of full fine-tuning's gain in error 0.8 s ahead"
                    f" ({spread}); reached {ours}, full fine-tuning {theirs}"
                )
    return "### LoRA against full fine-tuning\n\n" + "\n".join(lines) if lines else ""


def of_worlds(results: Sequence[Figures]) -> str:
    """Return a table of what was done in worlds that others made, a column for each task."""
    tasks = [task for task in TASKS if pick(results, shift=task)]
    if not tasks:
        return ""
    rows = [f"| {EPISODES} demonstrations | {' | '.join(tasks)} |", "|---|" + "---|" * len(tasks)]
    for name, label in (("zero action", "zero action"), ("random", "random"), ("oracle", "expert")):
        rows.append(f"| {label} | {' | '.join(_done(of_policy(results, BASES[0], name, task)) for task in tasks)} |")
    for method in (BEFORE, *IN_EVERY_WORLD, FROM_PRIOR, *IN_SOME_WORLDS):
        found = [main_cells(results, BASES[0], method, task) for task in tasks]
        rows += [f"| {method} | {' | '.join(map(_done, found))} |"] if any(found) else []
    title = "### Worlds that others made: solved at the end; hand within 5 cm of the expert's; error 0.8 s ahead"
    return f"{title}\n\n" + "\n".join([*rows, "", *_few_and_many(results)])


def _few_and_many(results: Sequence[Figures]) -> list[str]:
    rows = []
    for task in MANY:
        for method in IN_EVERY_WORLD[1:]:
            found = [pick(results, shift=task, method=method, episodes=count) for count in (5, EPISODES, 80)]
            if found[0] or found[2]:
                rows.append(f"| {task}: {method} | {' | '.join(map(_done, found))} |")
    return ["| demonstrations | 5 | 20 | 80 |", "|---|---|---|---|", *rows] if rows else []


def goal_by_goal(results: Sequence[Figures]) -> str:
    """Return against whom LoRA wins: goals that it alone reached, those that the other alone did, and how likely it is.

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
                    rows.append(f"| {where} | {other} | {len(pairs)} | {won} | {lost} | {_p(chance)} |")
    head = f"### {BEST} against others, goal by goal\n\n| change | against | goals | won | lost | p |\n|" + "---|" * 6
    return "\n".join([head, *rows]) if rows else ""


def _p(chance: float) -> str:
    return f"{chance:.3f}" if chance >= 0.0005 else "< 0.001"


def _pairs(results: Sequence[Figures], shift: str, base: str, other: str) -> Iterator[tuple[bool, bool]]:
    """Yield which goals LoRA and another method reached, with the demonstrations of the main tables."""
    ours = {one["cell"]["seed"]: one for one in main_cells(results, base, BEST, shift)}
    for theirs in main_cells(results, base, other, shift):
        if one := ours.get(theirs["cell"]["seed"]):
            yield from zip(reached(one), reached(theirs), strict=True)


def _done(found: Sequence[Figures]) -> str:
    """Return problems that were solved, with their interval, hands that arrived, and the error 0.8 s ahead."""
    if not found:
        return ""
    error = [last(one) for one in found if "shifted" in one]
    return _share(found) + _hand(found) + (f"; {np.mean(error):.3f}" if error else "")


def summary_of_trust(correlated: Correlated) -> str:
    """Return the short table of offline figures: over all cells of our own arm, and where all is anew."""
    told = {label: found for label, found in correlated.items() if label in {"all", "randomized"}}
    heads = [f"{CHANGES.get(label, 'all changes')}, {count} cells" for label, (count, _) in told.items()]
    if not told:
        return ""
    rows = [
        f"| {words} | {' | '.join(_interval(found[name]) for _, found in told.values())} |"
        for name, words in TOLD.items()
    ]
    return "\n".join([f"| | {' | '.join(heads)} |", "|---|" + "---|" * len(told), *rows])


def trust(correlated: Correlated) -> str:
    """Return which offline figure goes with closed-loop success, over the cells of our own arm."""
    lines = [
        f"| {label}, {count} cells | {name} | {_interval(one)} |"
        for label, (count, found) in correlated.items()
        for name, one in sorted(found.items(), key=lambda pair: -pair[1]["value"])
    ]
    head = "| cells | offline figure, lower is better | Spearman with goals missed |\n|---|---|---|"
    title = "### Which offline figure predicts closed-loop success?"
    return f"{title}\n\n" + "\n".join([head, *lines]) if lines else ""


def correlated_figures(results: Sequence[Figures]) -> Correlated:
    """Return how many cells there are, of all changes and of each that has enough of them, and what was found."""
    cells = [one for one in results if "offline" in one and "visited" in one["reach"]["l1"]]
    groups = {"all": cells, **{shift: [one for one in cells if one["cell"]["shift"] == shift] for shift in SHIFTS}}
    return {label: (len(some), _correlations(some)) for label, some in groups.items() if len(some) >= FEWEST}


def _correlations(cells: Sequence[Figures]) -> dict[str, dict[str, float]]:
    missed, kinds = [-float(np.mean(reached(one))) for one in cells], [one["cell"] for one in cells]
    of = [(kind["shift"], kind["base"], kind["method"], kind["episodes"]) for kind in kinds]
    return correlations([_offline_row(one) for one in cells], missed, of)


def _interval(one: dict[str, float]) -> str:
    return f"{one['value']:.2f} [{one['low']:.2f}, {one['high']:.2f}]"


def _offline_row(one: Figures) -> dict[str, float]:
    shifted, first = one["shifted"], one["shifted"]["one_step"]
    errors = {
        f"error over persistence, {step} steps": value
        for step, value in enumerate(shifted["rollout_over_persistence"], 1)
    }
    return {
        **errors,
        "cost of wrong actions, negative": 1 - shifted["one_step_shuffled_actions"] / first,
        **one["offline"],
        "energy and distance over visited plans, negative": -one["reach"]["l1"]["visited"],
    }


def _made_with(results: Sequence[Figures]) -> str:
    """Return which commits and versions computed the cells, and how many each."""
    names = Counter(
        "torch {torch}, commit {commit}".format(**one["made_with"]) if "made_with" in one else "not recorded"
        for one in results
    )
    return "- Made with " + "; ".join(f"{name} ({count} cells)" for name, count in names.most_common()) + "."


_HEAD = (
    "method | error 0.27 / 0.53 / 0.80 s | zero / shuffled actions | reach at the end | distance, cm | L2 energy"
    " | trained | MB | CPU min | error on A, on"
)


def _table(rows: list[str]) -> str:
    columns = _HEAD.count("|") + 1
    return "\n".join([f"| {_HEAD} |", "|" + "---|" * columns, *rows])


def _row(name: str, found: Sequence[Figures]) -> str:
    shifted = [one["shifted"] for one in found]
    rollout = np.mean([one["rollout_over_persistence"] for one in shifted], axis=0)
    last = [one["rollout_over_persistence"][-1] for one in shifted]
    wrong = [np.mean([one[key] for one in shifted]) for key in ("one_step_zero_actions", "one_step_shuffled_actions")]
    trained = found[0]["trained_share"]
    cells = [
        name,
        f"{' / '.join(f'{value:.3f}' for value in rollout)} ({min(last):.3f} to {max(last):.3f})",
        f"{wrong[0]:.3f} / {wrong[1]:.3f}",
        _reach(found, "l1"),
        _distance(found, "l1"),
        _reach(found, "l2"),
        f"{trained:.1%}" if trained else "",
        f"{found[0]['adapter_mb']:.2f}" if trained else "",
        f"{np.mean([one['cpu_minutes'] for one in found]):.1f}" if trained else "",
        _forgotten(found),
    ]
    return "| " + " | ".join(cells) + " |"


def _policies(results: Sequence[Figures], base: str, shift: str = "look") -> list[str]:
    rows = []
    for name in ("zero action", "random", "oracle"):
        of_it = of_policy(results, base, name, shift)
        if of_it:
            rows.append(f"| {name} | | | {_reach(of_it, 'l1')} | {_distance(of_it, 'l1')} | | | | | |")
    return rows


def _reach(found: Sequence[Figures], distance: str) -> str:
    """Return the share of all goals with Wilson's interval, and how many each seed, a model of its own, reached."""
    by_seed = [reached(one, distance) for one in found if distance in one["reach"]]
    tries = sum(map(len, by_seed))
    if not tries:
        return ""
    share = share_of(sum(map(sum, by_seed)), tries)
    seeds = ", ".join(str(sum(flags)) for flags in by_seed)
    return f"{share.value:.0%} ({share.low:.0%} to {share.high:.0%}) of {tries}: {seeds}"


def _distance(found: Sequence[Figures], distance: str) -> str:
    ends = np.array([row[-1] for one in found for row in one["reach"][distance]["distance_cm"]])
    mean = mean_of(ends, [str(place) for place in range(len(ends))])
    return f"{mean.value:.1f} ({mean.low:.1f} to {mean.high:.1f})" if mean.has_interval else f"{mean.value:.1f}"


def _forgotten(found: Sequence[Figures]) -> str:
    on = [one["forgetting"]["on"]["rollout_over_persistence"][-1] for one in found if "forgetting" in one]
    if not on:
        return ""
    checked = [one["forgetting"].get("off_is_base_bit_for_bit") for one in found]
    word = (
        "; off: the base's, bit for bit"
        if all(checked)
        else "; **off differs from the base**"
        if False in checked
        else ""
    )
    return f"{np.mean(on):.3f}{word}"
