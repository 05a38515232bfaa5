"""Checks of episode excerpts for `data check`: whether frames and states belong together, and what is unusual."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from vjepa2_ac import storage
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.inspection import oddities
from vjepa2_ac.data.inspection.agreement import FEWEST_EPISODES, Agreement, agreement_of
from vjepa2_ac.data.inspection.excerpts import EPISODES, Excerpt, excerpts_of
from vjepa2_ac.data.inspection.finding import Finding, Level
from vjepa2_ac.spaces import StateSpace

_EPISODES_FAR = 12  # of some 5 MB each, for DROID


def excerpt_findings(dataset: Dataset) -> Iterator[Finding]:
    """Read some episodes and yield what is unusual in them.

    Raises:
        InputError: An episode cannot be read, and `data.broken_episodes` does not skip it.
    """
    if dataset.config.is_cache:
        yield Finding("ok", "agreement", "not looked at in a latent cache: check the data set that it was made from")
        return
    is_far = storage.is_url(dataset.config.path)
    excerpts = list(excerpts_of(dataset, episodes=_EPISODES_FAR if is_far else EPISODES))
    yield from signs_in(
        excerpts,
        space=dataset.spaces.state,
        stride=dataset.config.model_stride,
        control_rate_hz=dataset.control_rate_hz,
    )


def signs_in(
    excerpts: Sequence[Excerpt], *, space: StateSpace, stride: int, control_rate_hz: float
) -> Iterator[Finding]:
    """Yield what is unusual in excerpts, and whether frames and states belong together; reads nothing."""
    excerpts = [one for one in excerpts if len(one.states) > 1]
    if not excerpts:
        return
    moved = oddities.motion_in(excerpts, space)
    found = [oddities.noise_as_frames(excerpts), *oddities.repetitions(excerpts, moved)]
    if space.position is not None:
        deltas = oddities.deltas_for_poses(excerpts)
        found += [deltas or oddities.shaking(excerpts), oddities.too_fast(excerpts, control_rate_hz)]
    wrong = [one for one in found if one is not None]
    yield from wrong
    hint = oddities.blue_hint(excerpts)
    if hint is not None:
        yield hint
    yield _agreement(
        agreement_of(excerpts, moved, least_lag=min(2, stride)), stride, control_rate_hz, is_sound=not wrong
    )


def _agreement(found: Agreement, stride: int, control_rate_hz: float, *, is_sound: bool) -> Finding:
    measure = f"rank correlation of their changes over {found.episodes} episodes"
    text = f"{measure} {found.best:.2f}, {found.chance:.2f} with another episode's frames"
    if found.episodes < FEWEST_EPISODES:
        needed = f"{FEWEST_EPISODES} are needed to tell whether frames and states belong together"
        return Finding("ok", "agreement", f"not known of {found.episodes} moving episodes of enough steps: {needed}")
    if found.verdict == "reversed":
        text = f"{measure} {found.backwards:.2f} with the frames backwards, {found.best:.2f} forwards"
        return Finding("error", "agreement", f"frames and states run against each other in time: {text}")
    if found.verdict == "late":
        steps = abs(found.lag)
        text = f"{measure} {found.best:.2f} so, {found.unshifted:.2f} as they are"
        fix = f"Give each frame the state of {_steps(steps)} {'before' if found.lag > 0 else 'after'}"
        level: Level = "error" if steps >= stride else "warning"  # then each action is paired with another one's frames
        by = f"frames are {'at least ' * found.is_farthest}{_shift(found.lag)} ({steps / control_rate_hz:.2f} s)"
        return Finding(level, "agreement", f"{by}: {text}. {fix}")
    if found.verdict == "foreign" and is_sound:
        return Finding(
            "warning",
            "agreement",
            f"frames do not change when the robot moves: {text}. Are they of these episodes, and of this robot?",
        )
    if found.verdict == "together":
        shift = f", best where frames are {_shift(found.lag)}" if found.lag else ""
        return Finding("ok", "agreement", f"frames change when the robot moves: {text}{shift}")
    return Finding("ok", "agreement", f"not known whether frames and states belong together: {text}")


def _steps(count: int) -> str:
    return "1 step" if count == 1 else f"{count} steps"


def _shift(lag: int) -> str:
    return f"{_steps(abs(lag))} {'late' if lag > 0 else 'early'}"
