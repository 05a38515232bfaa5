"""The rule by which goals follow one another: laws that hold for any energies."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vjepa2_ac.planning.goals import GoalProgress, SubGoal


def rule(*given: object, **named: object) -> SubGoal:
    """Return a goal of which only the rule counts."""
    return SubGoal(np.zeros(0), *given, **named)


def progress_over(rules: Sequence[SubGoal], energies: Sequence[Sequence[float]]) -> list[GoalProgress]:
    """Return the progress at each decision, from the energy of each image to each goal."""
    found = [GoalProgress(0, 0, energies[0][0])]
    for step, row in enumerate(energies[1:], start=1):
        found.append(found[-1].after(rules, step, row.__getitem__))
    return found


numbers = st.floats(0.0, 2.0) | st.just(float("nan"))
bounds = st.tuples(st.integers(1, 4), st.integers(0, 4))


@st.composite
def courses(draw: st.DrawFn) -> tuple[list[SubGoal], list[list[float]]]:
    """Rules of some goals, and the energies of as many images as they need at most, and more."""
    some = draw(st.lists(st.tuples(bounds, st.none() | st.floats(0.05, 0.95)), min_size=1, max_size=4))
    rules = [rule("", low, low + more, share) for (low, more), share in some]
    rules.append(rule(share=draw(st.none() | st.floats(0.05, 0.95))))
    steps = sum(goal.at_most or 0 for goal in rules) + 3
    row = st.lists(numbers, min_size=len(rules), max_size=len(rules))
    return rules, draw(st.lists(row, min_size=steps, max_size=steps))


@given(courses())
def test_goals_never_go_back_and_each_applies_within_its_bounds(course: tuple) -> None:
    rules, energies = course
    found = progress_over(rules, energies)
    places = [one.place for one in found]
    assert all(0 <= after - before <= 1 for before, after in pairwise(places))
    for place, goal in enumerate(rules[:-1]):
        assert goal.at_least <= places.count(place) <= goal.at_most
    assert places[-1] == len(rules) - 1, "bounded goals are over after all their steps"
    for before, after in pairwise(found):
        assert bool(after.changed) == (after.place != before.place or after.done != before.done)
        assert after.since == before.since or after.place == before.place + 1


@given(courses())
def test_a_goal_that_gave_way_early_was_below_its_share(course: tuple) -> None:
    rules, energies = course
    found = progress_over(rules, energies)
    for step, (before, after) in enumerate(pairwise(found), start=1):
        goal, now = rules[before.place], energies[step][before.place]
        if after.place > before.place:
            share = goal.share is not None and (now < goal.share * before.began or now <= 1e-6)
            assert share or step - before.since == goal.at_most
            assert after.began == pytest.approx(energies[step][after.place], nan_ok=True)
        elif not before.done and step - before.since >= goal.at_least and goal.share is not None:
            reached = now < goal.share * before.began or now <= 1e-6
            assert after.done == reached


def test_the_next_goal_begins_with_its_own_first_energy() -> None:
    rules = [rule("grasp", 1, 9, 0.5), rule(share=0.5)]
    found = progress_over(rules, [[1.0, 5.0], [0.6, 4.0], [0.4, 3.0], [9.0, 2.0], [9.0, 1.4], [9.0, 9.0]])
    assert [one.place for one in found] == [0, 0, 1, 1, 1, 1]
    assert [one.since for one in found] == [0, 0, 2, 2, 2, 2]
    assert [one.began for one in found] == [1.0, 1.0, 3.0, 3.0, 3.0, 3.0]
    assert [one.done for one in found] == [False] * 4 + [True] * 2, "what is reached stays so"
    assert found[2].changed == "Goal 1 (grasp), after 2 steps: energy 0.4 is below 50% of 1."
    assert found[4].changed == "Goal 2, after 2 steps: energy 1.4 is below 50% of 3."
    assert not found[5].changed


def test_an_energy_that_is_no_number_moves_nothing_on_before_its_time() -> None:
    nan = float("nan")
    rules = [rule("", 1, 3, 0.5), rule(share=0.5)]
    found = progress_over(rules, [[nan, nan]] * 6)
    assert [one.place for one in found] == [0, 0, 0, 1, 1, 1]
    assert not found[-1].done
