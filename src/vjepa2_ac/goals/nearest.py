"""Goals by one photograph: of the demonstration that begins and ends most like what is seen now and what is wanted."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.windows import require_stride
from vjepa2_ac.encoding.batch import encode_frames
from vjepa2_ac.errors import InputError
from vjepa2_ac.goals.make_goals import (
    KeyFrameOptions,
    MadeGoals,
    Recording,
    make_goals,
    recording_of,
)
from vjepa2_ac.media.images import require_image
from vjepa2_ac.planning.cameras import require_views
from vjepa2_ac.planning.energy import distance
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.reporter import INDEXING, SILENT, Reporter
from vjepa2_ac.runs.subject import Subject

logger = logging.getLogger(__name__)

Image = UInt8[np.ndarray, "height width 3"]
StartAndGoal = tuple[Image, Image]


def demonstrations_alike(
    config: DataConfig, session: Subject, wanted: Sequence[StartAndGoal], reporter: Reporter = SILENT
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
        InputError: No episode is left, the data are latents without frames, or of fewer cameras than are planned with.
    """
    views = session.config.planning.views
    require_views(config, views)
    encoded = partial(encode_frames, session.world_model, crop=session.config.data.crop, views=views)
    both = [encoded(np.stack(pair)) for pair in wanted]
    dataset = open_dataset(config, progress=reporter.task(INDEXING))
    chosen = np.flatnonzero(dataset.taking_part & (dataset.table.success != 0)).tolist()
    progress = reporter.task("looking for a demonstration alike", "episodes")
    apart, unusable = dict[int, list[float]](), list[str]()
    for done, index in enumerate(chosen, start=1):
        progress(done, len(chosen))
        try:
            shown = recording_of(dataset, index, views)
            ends = shown.read([0, shown.frames - 1])
            require_image(ends[0], where=shown.name, like=wanted[0][0] if apart else None)
        except InputError as error:
            unusable.append(str(error))
            continue
        if not apart:  # before thousands are read
            require_image(wanted[0][0], where="the image of the start", like=ends[0])
        seen = encoded(ends)
        apart[index] = [float(distance(seen, pair, session.config.planning.energy).sum()) for pair in both]
    if not apart:
        found = unusable[0] if unusable else "no successful episode"
        raise InputError(where=config.path, found=found, needed="one that can be read: its key frames become goals")
    if unusable:
        logger.warning("%d of %d episodes were left out, the first since %s", len(unusable), len(chosen), unusable[0])
    energies = np.array(list(apart.values()))
    least, usual = energies.min(axis=0).mean(), np.median(energies, axis=0).mean()
    reporter.note(
        f"Start and goal are {least:.3g} from those of the demonstration most alike, {usual:.3g} of the median one."
    )
    return tuple(recording_of(dataset, list(apart)[place], views) for place in energies.argmin(axis=0).tolist())


def ending_with(made: MadeGoals, photograph: Image) -> MadeGoals:
    """Return the goals of a demonstration with a photograph as the last one."""
    return replace(made, goals=(*made.goals[:-1], replace(made.goals[-1], image=photograph, name="the photograph")))


def goals_alike(
    session: Subject, wanted: Sequence[StartAndGoal], reporter: Reporter = SILENT
) -> tuple[tuple[SubGoal, ...], ...]:
    """Return for each start and goal the key frames of the demonstration that is most alike, and the goal itself.

    Raises:
        InputError: As `demonstrations_alike`; or there are no poses, or a model step has no known length.
    """
    config = session.config.data
    if config.states != "pose":
        raise InputError(where="data.states", found=config.states, needed="pose: of it key frames are found")
    options = KeyFrameOptions(stride=require_stride(config, to="make goals of"))
    alike = demonstrations_alike(config, session, wanted, reporter)
    return tuple(
        ending_with(make_goals(one, options), goal).goals for one, (_, goal) in zip(alike, wanted, strict=True)
    )
