"""The postcard: a page that plays without us, a tree of imagined futures that were computed beforehand, in one file."""

from __future__ import annotations

import base64
import json
from importlib.resources import files
from itertools import product
from pathlib import Path
from typing import Any

from vjepa2_ac.episode import Progress
from vjepa2_ac.explore.explorer import Pixels, Place, token_errors
from vjepa2_ac.explore.views import Views
from vjepa2_ac.media.images import encode_webp
from vjepa2_ac.storage import user_can_write, write_atomically
from vjepa2_ac.storage.structured import plain

MOVES, DEPTH = 6, 4
FILE = "index.html"
_QUALITY = 40  # of images of 96 pixels: 1,555 pairs are 4 MB
_DATA, _SCRIPT = "/*DATA*/", "/*SCRIPT*/"


def write_postcard(views: Views, folder: Path, progress: Progress, depth: int = DEPTH) -> Path:
    """Compute the futures of six moves from a frame with room around it, and write the page.

    What is true stands beside what is imagined, where it is known: of simulated data everywhere.

    Args:
        views: Of the model; its subject imagines.
        folder: Where the page goes.
        progress: Called with the futures that are computed.
        depth: How many moves a path has at most.

    Raises:
        InputError: The folder cannot be written.
    """
    data = json.dumps(_tree(views, progress, depth), allow_nan=False).replace("<", "\\u003c")
    template, script = (_page_file(name) for name in ("postcard.html", "postcard.js"))
    page = template.replace(_SCRIPT, script).replace(_DATA, data)
    with user_can_write(folder):
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / FILE, page.encode())
    return folder / FILE


def _page_file(name: str) -> str:
    return files("vjepa2_ac").joinpath("explore/page", name).read_text(encoding="utf-8")


def _tree(views: Views, progress: Progress, depth: int) -> dict[str, Any]:
    """Return the content of the page; the places stand level by level, those of a level in the order of their moves."""
    moves, first = views.moves[:MOVES], views.middle()
    paths = [path for length in range(depth + 1) for path in product(range(len(moves)), repeat=length)]
    order = {path: number for number, path in enumerate(paths)}
    places: list[dict[str, Any]] = [{}] * len(paths)
    actions = [views.action(move) for move in moves]
    for done, path in enumerate(sorted(paths)):  # depth first: what a path shares with the last one is known
        progress(done, len(paths))
        places[order[path]] = _place(views, Place(first.episode, first.start, tuple(actions[move] for move in path)))
    progress(len(paths), len(paths))
    found: dict[str, Any] = plain({
        "subject": views.subject,
        "episode": views.episode_names[first.episode],
        "is_pose": views.explorer.spaces.state.is_base_pose,
        "seconds": views.explorer.stride / views.explorer.dataset.control_rate_hz,
        "moves": [{"label": move["label"], "size": _size(views, move)} for move in moves],
        "depth": depth,
        "places": places,
    })  # fmt: skip
    return found


def _place(views: Views, place: Place) -> dict[str, Any]:
    explorer, subject = views.explorer, len(views.explorer.contenders) - 1
    latents, true = explorer.imagined(subject, place), views.truth.outcome(place)
    found: dict[str, Any] = {"imagined": _encoded(explorer.decoded(latents))}
    if explorer.spaces.state.position is not None:
        found["at"] = [round(float(one), 4) for one in explorer.states(place)[-1][explorer.spaces.state.position]]
    if true is not None:
        start = explorer.moment(place.episode, place.start).latents
        found |= {
            "true": _encoded(true.pixels),
            "error": round(float(token_errors(latents, true.latents).mean()), 3),
            "copying": round(float(token_errors(start, true.latents).mean()), 3),
        }
    return found


def _encoded(pixels: Pixels) -> str:
    return base64.b64encode(encode_webp([pixels], [1.0], quality=_QUALITY)).decode()


def _size(views: Views, move: dict[str, Any]) -> str:
    number = views.numbers[move["axis"]]
    return f"{number['step'] * number['factor']:.3g} {number['shown_unit']}".strip()
