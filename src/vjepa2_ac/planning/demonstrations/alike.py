"""Goals by one photograph: of the demonstration that begins and ends most like what is seen now and what is wanted."""

from __future__ import annotations

import logging
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

logger = logging.getLogger(__name__)

Image = UInt8[np.ndarray, "height width 3"]
StartAndGoal = tuple[Image, Image]


def demonstrations_alike(
    config: DataConfig, session: PlanningSession, wanted: Sequence[StartAndGoal], reporter: Reporter = SILENT
) -> tuple[Recording, ...]:
    """Return for each start and goal the demonstration that is most alike.

    It has the least sum of two energies: of its first image to the start, and of its last one to the goal. All episodes
    count where the data do not say which succeeded; one that cannot be read, or whose images have another size, is left
    out with a warning. Two images of each are read; their latents are not kept.

    Args:
        config: The demonstrations.
        session: Of the model that will plan, by whose latents and energy they are compared.
        wanted: As the camera sees them, views side by side.
        reporter: Shows the progress.

    Raises:
        InputError: No episode is left, or the data are latents without frames.
    """
    require_frames(config, to="make goals of")
    views, both = (
        session.config.planning.views,
        [latents_of(session, np.stack(pair).__getitem__, [0, 1]) for pair in wanted],
    )
    dataset = open_dataset(config, progress=reporter.task(INDEXING))
    chosen = np.flatnonzero(dataset.taking_part & (dataset.table.success != 0)).tolist()
    progress, apart, unusable = reporter.task("looking for a demonstration alike", "episodes"), {}, list[InputError]()
    for done, index in enumerate(chosen, start=1):
        try:
            shown = recording_of(dataset, index, views)
            ends = shown.read([0, shown.frames - 1])
            require_image(ends[0], where=shown.name, like=wanted[0][0])
        except InputError as error:
            unusable.append(error)
        else:
            seen = latents_of(session, ends.__getitem__, [0, 1])
            apart[index] = [float(energies_of(session, seen, pair).sum()) for pair in both]
        progress(done, len(chosen))
    if not apart:
        needed = "a successful episode, of the size of the images: its key frames become goals"
        raise InputError(where=config.path, found=str(unusable[0]) if unusable else "none", needed=needed)
    if unusable:
        logger.warning("%d of %d episodes were left out, the first since %s", len(unusable), len(chosen), unusable[0])
    nearest = np.argmin(list(apart.values()), axis=0).tolist()
    return tuple(recording_of(dataset, list(apart)[place], views) for place in nearest)


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
