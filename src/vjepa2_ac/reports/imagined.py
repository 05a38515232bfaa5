"""The film of what a model imagines: strip, video, GIF, and the actions as JSON."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vjepa2_ac.decoding.imagine import Imagination, strip_of
from vjepa2_ac.errors import UnreachableError
from vjepa2_ac.media.film import draw_strip, film_frames, loop_of
from vjepa2_ac.media.images import encode_png
from vjepa2_ac.media.video import write_gif, write_video
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.storage import user_can_write, write_atomically
from vjepa2_ac.storage.structured import json_text

STRIP, VIDEO, GIF, JSON = "imagined.png", "imagined.mp4", "imagined.gif", "imagined.json"
_RATE_HZ = 15.0


def write_film_of(imagination: Imagination, folder: Path, *, reporter: Reporter = SILENT) -> list[Path]:
    """Write the film into a folder, and return the files; without PyAV there is no MP4, and a note says so.

    Raises:
        InputError: The folder cannot be written.
    """
    strip = strip_of(imagination)
    with user_can_write(folder):
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / STRIP, encode_png(draw_strip(strip)))
        images, loop = list(film_frames(strip)), loop_of(strip)
        frames, seconds = [images[place] for place, _ in loop], [shown for _, shown in loop]
        times = [max(1, round(shown * _RATE_HZ)) for shown in seconds]  # that a video repeats each frame
        written = [folder / STRIP, write_gif(folder / GIF, frames, seconds=seconds)]
        try:
            written.append(write_video(folder / VIDEO, np.repeat(frames, times, axis=0), rate_hz=_RATE_HZ))
        except UnreachableError as error:  # PyAV is not installed
            reporter.note(f"No {VIDEO}: {error}")
        write_atomically(folder / JSON, json_text(_as_dict(imagination)))
    return [*written, folder / JSON]


def _as_dict(imagination: Imagination) -> dict[str, object]:
    return {
        "subject": imagination.subject,
        "episode": imagination.episode_id,
        "start": imagination.start,
        "seconds_per_step": imagination.seconds_per_step,
        "rollouts": [
            {"model": one.model, "name": one.name, "actions": one.actions.tolist(), "truth": one.truth is not None}
            for one in imagination.rollouts
        ],
        "notes": list(imagination.notes),
    }
