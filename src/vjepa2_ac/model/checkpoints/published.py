"""The checkpoints that Meta has published: names, addresses, sizes; and their download over an unstable connection.

A download is resumed where it stopped, checked, then renamed. PyTorch is not imported.
Sources: facebookresearch/vjepa2 @ 204698b, src/hub/backbones.py and app/vjepa_2_1/models; the models' cards on the Hub.
"""

from __future__ import annotations

import difflib
import http.client
import math
import re
import urllib.error
import urllib.request
from dataclasses import dataclass
from pathlib import Path

from vjepa2_ac import storage
from vjepa2_ac.config.model import Family
from vjepa2_ac.errors import InputError, RefusedError, UnreachableError
from vjepa2_ac.model.base_model import VIT_B, VIT_G, VIT_H, VIT_L, EncoderShape, VIT_g
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.storage.retries import RetryPolicy, with_retries

OFFICIAL = "vjepa2-ac-vitg"  # Meta's world model, which `download` fetches without a name

_URL = "https://dl.fbaipublicfiles.com/vjepa2/"
_TOLERANCE = 0.25  # of a size that is only estimated


@dataclass(frozen=True)
class Published:
    """A file that can be downloaded; Meta publishes no hashes."""

    name: str  # for `vjepa2-ac download`; names differ by more than the case of a letter
    remote: str  # Meta's name of the file
    encoder: EncoderShape
    image_size: int  # at which it was trained last, in pixels
    key: str  # of the encoder's weights in the file
    hub_name: str  # its name in Meta's torch.hub
    gigabytes: float  # about: encoder, its average, predictor and the optimizer's moments, in float32
    bytes: int | None = None  # exactly, where known
    licence: str = "MIT"  # of Meta's repository; Meta's server sends none with the file

    @property
    def holds(self) -> str:
        """What it is."""
        return "world model" if self.name == OFFICIAL else "encoder"

    @property
    def family(self) -> Family:
        """The family of its encoder."""
        return "v2.1" if self.name.startswith("vjepa2.1") else "v2"

    @property
    def url(self) -> str:
        """Its address."""
        return _URL + self.remote

    @property
    def file(self) -> str:
        """The name under which it is stored: it tells ViT-g from ViT-G on a disk that is blind to case."""
        return f"{self.name}.pt"

    @property
    def size(self) -> str:
        """Its size, for people."""
        return f"about {self.gigabytes:g} GB" if self.bytes is None else f"{self.bytes:,} bytes"

    @property
    def knob(self) -> str:
        """The knob of a config that takes the file."""
        return "model.base" if self.name == OFFICIAL else "model.encoder.path"


PUBLISHED: tuple[Published, ...] = (
    Published(OFFICIAL, "vjepa2-ac-vitg.pt", VIT_g, 256, "encoder", "vjepa2_ac_vit_giant", 11.7),
    Published("vjepa2-vitl", "vitl.pt", VIT_L, 256, "target_encoder", "vjepa2_vit_large", 5.1),
    Published("vjepa2-vith", "vith.pt", VIT_H, 256, "target_encoder", "vjepa2_vit_huge", 10.4),
    Published("vjepa2-vitg", "vitg.pt", VIT_g, 256, "target_encoder", "vjepa2_vit_giant", 16.5),
    Published("vjepa2-vitg-384", "vitg-384.pt", VIT_g, 384, "target_encoder", "vjepa2_vit_giant_384", 16.5),
    Published(
        "vjepa2.1-vitb-384", "vjepa2_1_vitb_dist_vitG_384.pt", VIT_B, 384, "ema_encoder", "vjepa2_1_vit_base_384",
        1.66, 1_664_223_428,
    ),
    Published(
        "vjepa2.1-vitl-384", "vjepa2_1_vitl_dist_vitG_384.pt", VIT_L, 384, "ema_encoder", "vjepa2_1_vit_large_384", 5.1
    ),
    Published(
        "vjepa2.1-vitg-1b-384", "vjepa2_1_vitg_384.pt", VIT_g, 384, "target_encoder", "vjepa2_1_vit_giant_384", 16.5
    ),
    Published(
        "vjepa2.1-vitG-2b-384", "vjepa2_1_vitG_384.pt", VIT_G, 384, "target_encoder", "vjepa2_1_vit_gigantic_384", 29.8
    ),
)  # fmt: skip


def published_as(file_name: str) -> Published | None:
    """Return the published file of this name, Meta's or ours, exactly as it is spelt; None: it is none of them."""
    return next((one for one in PUBLISHED if file_name in {one.remote, one.file}), None)


def find_published(text: str) -> Published:
    """Return the published checkpoint that a name means; dots, dashes and underscores do not matter, the case does.

    Args:
        text: Our name, Meta's name of the file or the name in torch.hub; with or without `.pt`.

    Raises:
        InputError: None has this name.
    """
    names = {_plain(name): one for one in PUBLISHED for name in (one.name, one.remote, one.hub_name)}
    if (meant := names.get(_plain(text))) is not None:
        return meant
    folded = [name.casefold() for name in names]
    near = difflib.get_close_matches(_plain(text.rpartition("/")[2]).casefold(), folded, n=3)
    close = " or ".join(dict.fromkeys(one.name for name, one in names.items() if name.casefold() in near))
    hint = f"Did you mean {close}? " if close else ""
    fix = f"{hint}`vjepa2-ac download --list` shows all; where the file goes is said by --to"
    raise InputError(where=f"download {text}", found="no published checkpoint of this name", fix=fix)


def _plain(name: str) -> str:
    return re.sub(r"[-_. ]", "", name.removesuffix(".pt"))


CHUNK_BYTES = 2**20
_POLICY = RetryPolicy(attempts=5, first_wait_s=2.0, total_s=math.inf)
_PROXY = "Check the URL, and whether a proxy answers in the server's place"


def download(
    url: str,
    path: str | Path,
    *,
    known: Published | None = None,
    reporter: Reporter = SILENT,
    policy: RetryPolicy = _POLICY,
) -> Path:
    """Fetch a file to `path`; a part that an earlier call left beside it is gone on with.

    Args:
        url: What to fetch.
        path: Where the whole file goes; it appears there only when it is whole. One that is there is kept, if it can
            be the file.
        known: The published checkpoint that it has to be, whose size is checked; None: any file.
        reporter: Is told how far it is, in megabytes.
        policy: How often in a row the line may break without a byte having come, and the waits.

    Raises:
        InputError: The server does not say how large the file is, or sends another size than the published file can
            have; the disk has too little space; the path cannot be written.
        UnreachableError: The server refuses, or cannot be reached.
    """
    path = Path(path)
    with storage.user_can_write(path):
        if path.is_dir():
            raise InputError(where=str(path), found="a folder", needed="the name of a file", fix="Name a file in it")
        if path.exists():
            _require_size(known, _size(path), where=str(path))
            return path
        path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.{known.name}.part" if known else f"{path.name}.part")
    try:
        with_retries(
            url,
            lambda timeout_s: _fetch(url, part, known, reporter, timeout_s),
            policy=policy,
            access="Check the URL",
            progress=lambda: _size(part),
        )
    except RefusedError:
        raise
    except UnreachableError as error:
        found = f"{error.found}; {_size(part)} bytes are in {part}"
        fix = "Check the network and start again: it goes on where it stopped"
        raise UnreachableError(where=url, found=found, fix=fix) from None
    return part.replace(path)


def _fetch(url: str, part: Path, known: Published | None, reporter: Reporter, timeout_s: float) -> None:
    """Bring the rest of a file."""
    start = _size(part)
    try:
        request = urllib.request.Request(url, headers={"Range": f"bytes={start}-"} if start else {})  # noqa: S310  # the user's
        answer = urllib.request.urlopen(request, timeout=timeout_s)  # noqa: S310  # the user's
    except http.client.InvalidURL as error:
        raise ValueError(error) from None  # it does not pass
    except urllib.error.HTTPError as error:
        if error.code != 416:
            raise
        if error.headers.get("Content-Range", "").endswith(f"/{start}"):  # nothing is left
            return
        part.unlink()
        raise http.client.HTTPException("the part that is here does not fit the file; starting again") from None
    with answer:
        start = start if answer.headers.get("Content-Range", "").startswith(f"bytes {start}-") else 0
        promised = answer.headers.get("Content-Length", "")
        if not promised.isdigit():
            needed = "its size (Content-Length): without it, half a file looks like a whole one"
            raise InputError(where=url, found="a server that does not say it", needed=needed, fix=_PROXY)
        whole = start + int(promised)
        _require_size(known, whole, where=url)
        free = storage.free_bytes(part.parent.absolute()) + _size(part)
        if whole > free:
            needed = f"{whole / 1e9:.4g} GB, of which {start / 1e9:.4g} GB are here"
            fix = "Free some space, or name a file on a larger disk with --to"
            raise InputError(where=str(part), found=f"{free / 1e9:.4g} GB free on its disk", needed=needed, fix=fix)
        show = reporter.task(f"{part.name.removesuffix('.part')} (MB)")
        with storage.user_can_write(part), part.open("ab" if start else "wb") as file:
            while block := answer.read(CHUNK_BYTES):
                file.write(block)
                show(file.tell() // 10**6, whole // 10**6)
        if _size(part) < whole:
            raise http.client.IncompleteRead(b"", whole - _size(part))


def _require_size(known: Published | None, size: int, *, where: str) -> None:
    """Refuse another size than the known one; the range around an estimate excludes a proxy's answer."""
    if known is None:
        return
    around = [round(known.gigabytes * share * 10**9) for share in (1 - _TOLERANCE, 1 + _TOLERANCE)]
    least, most = around if known.bytes is None else (known.bytes, known.bytes)
    if not least <= size <= most:
        needed = f"{known.name}, of {least:,} to {most:,} bytes"
        fix = f"{_PROXY}; or delete the file, or name another with --to"
        raise InputError(where=where, found=f"a file of {size:,} bytes", needed=needed, fix=fix)


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0
