"""The postcard: a page that plays without us, a tree of imagined futures that were computed beforehand, in one file."""

from __future__ import annotations

import base64
import json
from importlib.resources import files
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from vjepa2_ac.episode import Progress
from vjepa2_ac.explore.explorer import Pixels, Place, token_errors
from vjepa2_ac.explore.views import Views
from vjepa2_ac.media.images import encode_webp, resized
from vjepa2_ac.storage import user_can_write, write_atomically
from vjepa2_ac.storage.structured import plain

MOVES, DEPTH = 6, 4
FILE = "index.html"
FORMS = (112, 60), (112, 45), (112, 30), (96, 20), (64, 5)  # side and quality of images, until they fit
MOST_BYTES = 4_200_000  # of all images, as text
_BLOCK, _SEEN = 16, 8.0  # pixels of WebP's blocks; which differences are stored: root mean square of a block, of 255
_DATA, _SCRIPT = "/*DATA*/", "/*SCRIPT*/"


def write_postcard(views: Views, folder: Path, progress: Progress, depth: int = DEPTH) -> Path:
    """Compute the futures of six moves from a frame with room around it, and write the page.

    What is true stands beside what is imagined, where it is known: of simulated data everywhere.

    Args:
        views: Of the models; the last two imagine: of an adapter its base, and itself.
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
    actions, found = [views.action(move) for move in moves], {}
    for done, path in enumerate(sorted(paths)):  # depth first: what a path shares with the last one is known
        progress(done, len(paths))
        found[path] = _place(views, Place(first.episode, first.start, tuple(actions[move] for move in path)))
    progress(len(paths), len(paths))
    places = [told for told, _ in map(found.__getitem__, paths)]
    images = _fitting([shown for _, shown in map(found.__getitem__, paths)])
    content: dict[str, Any] = plain({
        "subject": views.subject,
        "notes": views.explorer.notes,
        "episode": views.episode_names[first.episode],
        "tellers": [one.name for one in views.explorer.contenders[-2:]],
        "is_pose": views.explorer.spaces.state.is_base_pose,
        "seconds": views.explorer.stride / views.explorer.dataset.control_rate_hz,
        "moves": [{"label": move["label"], "size": _size(views, move)} for move in moves],
        "depth": depth,
        "places": [{**told, "images": shown} for told, shown in zip(places, images, strict=True)],
    })  # fmt: skip
    return content


def _place(views: Views, place: Place) -> tuple[dict[str, Any], list[Pixels]]:
    """Return what is told of a place, and its images: what each model imagines, and the true one where it is known."""
    explorer, true = views.explorer, views.truth.outcome(place)
    tellers = range(len(explorer.contenders))[-2:]
    latents = [explorer.imagined(teller, place) for teller in tellers]
    images, told = [explorer.decoded(one) for one in latents], dict[str, Any]()
    if explorer.spaces.state.position is not None:
        told["at"] = [round(float(one), 4) for one in explorer.states(place)[-1][explorer.spaces.state.position]]
    if true is not None:
        start = explorer.moment(place.episode, place.start).latents
        compared = (token_errors(one, true.latents) for one in (*latents, start))
        *told["errors"], told["copying"] = (round(float(one.mean()), 3) for one in compared)
        told["reached"] = true.reached
        images.append(true.pixels)
    side = min(FORMS[0][0], explorer.world_model.image_size)
    return told, [resized(one, side) for one in images]


def _fitting(images: list[list[Pixels]]) -> list[list[str]]:
    """Return the images of all places as text, in the best form in which they fit; those of the first place whole."""
    for side, quality in FORMS:
        side = min(side, len(images[0][0])) // _BLOCK * _BLOCK or len(images[0][0])  # never enlarged
        small = [[resized(one, side) for one in place] for place in images]
        encoded = [[_text(one, 90) for one in small[0]]]
        encoded += [
            [_text(_changes(one, first), quality) for one, first in zip(place, small[0], strict=False)]
            for place in small[1:]
        ]
        if sum(len(one) for place in encoded for one in place) <= MOST_BYTES:
            break
    return encoded


def _changes(image: Pixels, first: Pixels) -> np.ndarray:
    """Return an image that is transparent where it looks like the first one, which lies behind it in the page."""
    block = np.gcd(_BLOCK, len(image))
    squares = np.square(image.astype(np.float64) - first).mean(axis=2)
    grid = squares.reshape(len(image) // block, block, -1, block).mean(axis=(1, 3))
    seen = np.kron(grid > _SEEN**2, np.full((block, block), 255))
    return np.dstack([image, seen]).astype(np.uint8)


def _text(pixels: np.ndarray, quality: int) -> str:
    return base64.b64encode(encode_webp([pixels], [1.0], quality=quality)).decode()


def _size(views: Views, move: dict[str, Any]) -> str:
    number = views.numbers[move["axis"]]
    return f"{number['step'] * number['factor']:.3g} {number['shown_unit']}".strip()
