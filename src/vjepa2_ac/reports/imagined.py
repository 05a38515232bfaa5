"""The film of what a model imagines: strip, video, GIF, and the actions as JSON."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from vjepa2_ac.decoding.imagine import AS_RECORDED, Imagination
from vjepa2_ac.errors import UnreachableError
from vjepa2_ac.media.images import encode_png
from vjepa2_ac.media.video import write_gif, write_video
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.reports.figures.film import FilmStrip, StripRow, draw_strip, durations, film_frames, held
from vjepa2_ac.storage import user_can_write, write_atomically
from vjepa2_ac.storage.structured import json_text

STRIP, VIDEO, GIF, JSON = "imagined.png", "imagined.mp4", "imagined.gif", "imagined.json"
_SLOWER = 2.0  # than reality, so that an eye can follow
_RATE_HZ = 15.0
_LONGEST_NAME = 44  # characters
_LEAST_CM, _LEAST_GRIP = 0.15, 0.05  # smaller parts of an action are not named
_POSE = 7  # numbers
_WAYS = (("forward", "back"), ("left", "right"), ("up", "down"))  # of x, y, z in the robot base frame


def strip_of(imagination: Imagination) -> FilmStrip:
    """Return the rows: truth, decoded truth, recorded actions as each model imagines them, then other actions."""
    told, first, decoded_first = imagination, imagination.first[None], imagination.decoded_first[None]
    recorded = [one for one in told.rollouts if one.name == AS_RECORDED]
    rows = []
    if told.truth is not None:
        captions = ("", *map(_short_action, recorded[0].actions)) if recorded else ()
        rows.append(StripRow("what happened", "recorded", np.concatenate([first, told.truth]), captions))
    if told.decoded_truth is not None:
        frames = np.concatenate([decoded_first, told.decoded_truth])
        rows.append(StripRow("what happened,\nencoded and decoded", "decoded", frames))
    for one in sorted(told.rollouts, key=lambda one: one.name != AS_RECORDED):
        label = f"{one.model} imagines,\nsame actions"
        if one.name != AS_RECORDED:
            length = 100 * float(np.linalg.norm(one.actions[0, :3])) if one.actions.shape[1] == _POSE else 0.0
            label = f"{one.model} imagines:\n{one.name}" + (f", {length:.1f} cm a step" if length >= _LEAST_CM else "")
        rows.append(StripRow(label, "imagined", np.concatenate([decoded_first, one.frames])))
        if one.truth is not None and one.name != AS_RECORDED:
            frames = np.concatenate([first, one.truth])
            rows.append(StripRow(f"what really happens:\n{one.name}", "simulated", frames))
    clip = f"{_short(told.episode_id)} from control step {told.start}"
    title = f"{told.subject}, {clip if told.episode_id else 'from an image'}"
    times = range(len(rows[0].frames)) if rows else range(0)
    return FilmStrip(title, tuple(rows), tuple(time * told.seconds_per_step for time in times))


def _short_action(action: Float[np.ndarray, " action_dim"]) -> str:
    """Return a pose's action in a few words, in the robot's directions; of a vector nothing."""
    if len(action) != _POSE:
        return ""
    words = []
    for amount, (plus, minus) in zip(100 * action[:3], _WAYS, strict=True):
        if abs(amount) >= _LEAST_CM:
            words.append((abs(amount), f"{plus if amount > 0 else minus} {abs(amount):.1f}"))
    named = [text for _, text in sorted(words, reverse=True)[:2]]
    if abs(action[6]) >= _LEAST_GRIP:
        named.append("close" if action[6] > 0 else "open")
    return ", ".join(named) + " cm" * bool(words) if named else "still"


def write_film_of(imagination: Imagination, folder: Path, *, reporter: Reporter = SILENT) -> list[Path]:
    """Write the film into a folder, and return the files; without PyAV there is no MP4, and a note says so.

    Raises:
        InputError: The folder cannot be written.
    """
    strip = strip_of(imagination)
    with user_can_write(folder):
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / STRIP, encode_png(draw_strip(strip)))
        frames, seconds = list(film_frames(strip)), durations(strip, slower=_SLOWER)
        written = [folder / STRIP, write_gif(folder / GIF, frames, seconds=seconds)]
        try:
            written.append(write_video(folder / VIDEO, held(frames, seconds, _RATE_HZ), rate_hz=_RATE_HZ))
        except UnreachableError as error:  # PyAV is not installed
            reporter.note(f"No {VIDEO}: {error}")
        write_atomically(folder / JSON, json_text(_as_dict(imagination)))
    return [*written, folder / JSON]


def _short(name: str) -> str:
    """Return the end of an episode's name; of DROID's, which name several files, that of the first folder."""
    own = name.split("--", maxsplit=1)[0].removesuffix("/recordings/MP4").rstrip("/")
    return own if len(own) <= _LONGEST_NAME else f"...{own[-_LONGEST_NAME:]}"


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
