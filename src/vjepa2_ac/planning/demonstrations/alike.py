"""Goals by one photograph: of the demonstration that begins and ends most like what is seen now and what is wanted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.windows import require_frames, require_stride
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.images import require_image
from vjepa2_ac.planning.demonstrations.make_goals import (
    KeyFrameOptions,
    MadeGoals,
    Recording,
    energies_of,
    latents_of,
    make_goals,
    recording_of,
)
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.planning.session import PlanningSession
from vjepa2_ac.reporter import INDEXING, SILENT, Reporter

Image = UInt8[np.ndarray, "height width 3"]
StartAndGoal = tuple[Image, Image]


def demonstrations_alike(
    config: DataConfig, session: PlanningSession, wanted: Sequence[StartAndGoal], reporter: Reporter = SILENT
) -> tuple[Recording, ...]:
    """Return for each start and goal the demonstration that is most alike.

    It has the least sum of two energies: of its first image to the start, and of its last one to the goal. All episodes
    count where the data do not say which succeeded. Two images of each are read; their latents are not kept.

    Args:
        config: The demonstrations.
        session: Of the model that will plan, by whose latents and energy they are compared.
        wanted: As the camera sees them, views side by side.
        reporter: Shows the progress.

    Raises:
        InputError: No episode succeeded, or one cannot be read, or the data are latents without frames.
    """
    require_frames(config, to="make goals of")
    views = session.config.planning.views
    dataset = open_dataset(config, progress=reporter.task(INDEXING))
    chosen = np.flatnonzero(dataset.taking_part & (dataset.table.success != 0)).tolist()
    if not chosen:
        raise InputError(where=config.path, found="no successful episode", needed="one: its key frames become goals")
    both = [latents_of(session, np.stack(pair).__getitem__, [0, 1]) for pair in wanted]
    first = recording_of(dataset, chosen[0], views).read([0])[0]
    require_image(wanted[0][0], where="a start", like=first)
    progress, apart = reporter.task("looking for a demonstration alike", "episodes"), list[list[float]]()
    for done, index in enumerate(chosen, start=1):
        shown = recording_of(dataset, index, views)
        seen = latents_of(session, shown.read, [0, shown.frames - 1])
        apart.append([float(energies_of(session, seen, ends).sum()) for ends in both])
        progress(done, len(chosen))
    return tuple(recording_of(dataset, chosen[place], views) for place in np.argmin(apart, axis=0).tolist())


def ending_with(made: MadeGoals, photograph: Image) -> MadeGoals:
    """Return the goals of a demonstration with a photograph as the last one."""
    return replace(made, goals=(*made.goals[:-1], replace(made.goals[-1], image=photograph, name="the photograph")))


def goals_alike(
    session: PlanningSession, wanted: Sequence[StartAndGoal], reporter: Reporter = SILENT
) -> tuple[tuple[SubGoal, ...], ...]:
    """Return for each start and goal the key frames of the demonstration that is most alike, and the goal itself.

    Raises:
        InputError: As `demonstrations_alike`; or it has no poses, or a model step has no known length.
    """
    config = session.config.data
    options = KeyFrameOptions(stride=require_stride(config, to="make goals of"))
    alike = demonstrations_alike(config, session, wanted, reporter)
    return tuple(
        ending_with(make_goals(one, options), goal).goals for one, (_, goal) in zip(alike, wanted, strict=True)
    )
