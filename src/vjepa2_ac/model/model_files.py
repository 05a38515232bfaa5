"""Find model files, read their sizes without reading weights, and download published files.

This module does not import PyTorch. An interrupted download resumes. A complete download is checked and then renamed.
Sources: facebookresearch/vjepa2 @ 204698b, src/hub/backbones.py and app/vjepa_2_1/models; model cards on the Hub.
"""

from __future__ import annotations

import http.client
import importlib.resources
import math
import urllib.error
import urllib.request
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from vjepa2_ac import storage
from vjepa2_ac.config import EncoderSizes, ModelConfig, ModelSizes, SizesConfig
from vjepa2_ac.config.loading import flatten
from vjepa2_ac.config.model import Family, FramePath
from vjepa2_ac.errors import InputError, RefusedError, UnreachableError, shell_command
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.storage.paths import BUILTIN, HUB
from vjepa2_ac.storage.retries import RetryPolicy, call_with_retries
from vjepa2_ac.storage.structured import parse_record, read_json_object

ASSETS = Path(str(importlib.resources.files("vjepa2_ac"))) / "assets"
FORMAT = "vjepa2-ac world model 1"
CONFIG = "config.json"
ENCODER_NEEDED = "an encoder of V-JEPA 2 or 2.1: Meta's .pt, a transformers folder, or a model of this project"

_HEADS_KEY = "heads_are_told"  # in config.json, for `EncoderOrigin.has_heads_in_fingerprint`
_TINY = f"{BUILTIN}sim-tiny"
NEEDED_MODEL = "a folder written by `vjepa2-ac export` or WorldModel.save_pretrained"
_FIX = "For a run, `vjepa2-ac export RUN FOLDER` writes one"


def find_base(name: str) -> Path:
    """Return the path of the file or folder in `model.base`.

    Raises:
        InputError: The path does not exist.
    """
    needed = f"the official .pt, a folder written by `vjepa2-ac export`, or {_TINY}"
    fix = "`vjepa2-ac download` fetches the official checkpoint to checkpoints/vjepa2-ac-vitg.pt"
    return _find(name, f"model.base: {name}", needed, fix)


def find_encoder_path(name: str) -> Path | None:
    """Return the path of the file or folder in `model.encoder.path`; None if the encoder is on the Hub.

    Raises:
        InputError: The path does not exist.
    """
    if name.startswith(HUB):
        return None
    fix = "`vjepa2-ac download --list` shows the published files"
    return _find(name, f"model.encoder.path: {name}", ENCODER_NEEDED, fix)


def require_model(config: ModelConfig) -> None:
    """Check that the model and the encoder of a config exist on this machine.

    Raises:
        InputError: One of them does not exist.
    """
    if not config.is_random:
        find_base(config.base)
    if config.encoder is not None:
        find_encoder_path(config.encoder.path)


def require_base_of_run(config: ModelConfig, run: Path, command: Sequence[str] = ()) -> None:
    """Check that the base model and the encoder of a run still exist at their paths.

    Args:
        config: The section `model` of the run.
        run: The run folder.
        command: The command to recommend with the new path; if empty, the command that resumes the run.

    Raises:
        InputError: One of them does not exist; the message shows how to set the new path.
    """
    try:
        require_model(config)
    except InputError as error:
        key = error.where.partition(":")[0]
        moved = shell_command(*(command or ("train", run, "--resume")), f"{key}=PATH")
        needed = f"the model on which {run} was trained, at any path: the fingerprint of the weights is compared"
        fix = f"If it was moved, run `{moved}`"
        raise InputError(where=error.where, found=error.found, needed=needed, fix=fix) from None


def _find(name: str, where: str, needed: str, fix: str) -> Path:
    path = ASSETS / name.removeprefix(BUILTIN) if name.startswith(BUILTIN) else Path(name)
    if name.startswith(BUILTIN) and not (path / CONFIG).is_file():
        raise InputError(where=where, found="no model of that name in the package", needed=_TINY)
    if not path.exists():
        raise InputError(where=where, found="no such file or folder", needed=needed, fix=fix)
    return path


def read_sizes(folder: Path) -> ModelSizes:
    """Read the sizes of the model in a folder.

    Raises:
        InputError: The folder is not a world model.
    """
    where, card = str(folder / CONFIG), read_json_object(folder / CONFIG, needed=NEEDED_MODEL, fix=_FIX)
    if card.get("format") != FORMAT:
        raise InputError(where=where, found="not the config of a world model", needed=NEEDED_MODEL, fix=_FIX)
    return parse_record(ModelSizes, card.get("sizes"), where=f"{where}: sizes", needed=NEEDED_MODEL, fix=_FIX)


def check_sizes(model_sizes: ModelSizes, config_sizes: ModelSizes, *, where: str) -> None:
    """Check that no configured size differs from the size in the model.

    Configured sizes that equal the default are not compared, because the config of a run contains all defaults.

    Raises:
        InputError: A size differs; the message names it.
    """
    actual, configured, default = (flatten(sizes.model_dump()) for sizes in (model_sizes, config_sizes, ModelSizes()))
    wrong = [key for key in flatten(SizesConfig().model_dump()) if configured[key] not in (actual[key], default[key])]
    if wrong:
        problem = ", ".join(f"{key} {actual[key]}, and model.sizes has {configured[key]}" for key in wrong)
        raise InputError(where=where, found=problem, fix="Remove them from model.sizes: they are read from the model")


def read_encoder_origin(folder: Path) -> EncoderOrigin | None:
    """Return the origin of the encoder in a model folder; None if it is unknown or the model has its original encoder.

    Raises:
        InputError: The record of the origin is damaged.
    """
    origin = read_json_object(folder / CONFIG, needed=NEEDED_MODEL).get("encoder_origin")
    if origin is None:
        return None
    if isinstance(origin, dict) and _HEADS_KEY in origin:
        origin["has_heads_in_fingerprint"] = origin.pop(_HEADS_KEY)
    where, needed = f"{folder / CONFIG}: encoder_origin", "file, key and licence of an encoder"
    return parse_record(EncoderOrigin, origin, where=where, needed=needed)


@dataclass(frozen=True)
class EncoderShape:
    """The architecture of a published encoder."""

    name: str  # such as ViT-B
    width: int
    depth: int
    heads: int
    hidden: int  # width of the MLP

    @property
    def parameters(self) -> int:
        """The approximate number of parameters: blocks and patch embedding, without biases and norms."""
        return self.depth * (4 * self.width**2 + 2 * self.width * self.hidden) + 2 * 3 * 16**2 * self.width

    def sizes(self, family: Family, frame: FramePath) -> EncoderSizes:
        """Return the sizes of an encoder of this shape."""
        shape = {"width": self.width, "depth": self.depth, "heads": self.heads, "mlp_ratio": self.hidden / self.width}
        return EncoderSizes.model_validate({**shape, "family": family, "frame": frame})


VIT_B = EncoderShape("ViT-B", 768, 12, 12, 3072)
VIT_L = EncoderShape("ViT-L", 1024, 24, 16, 4096)
VIT_H = EncoderShape("ViT-H", 1280, 32, 16, 5120)
VIT_g = EncoderShape("ViT-g", 1408, 40, 22, 6144)
VIT_G = EncoderShape("ViT-G", 1664, 48, 26, 8192)

PUBLISHED_HEADS: Mapping[int, int] = {shape.width: shape.heads for shape in (VIT_B, VIT_L, VIT_H, VIT_g, VIT_G)}
"""The number of attention heads by the width of an encoder. The shapes of tensors do not determine this number."""


@dataclass(frozen=True)
class EncoderOrigin:
    """The file or repository from which an encoder was loaded."""

    file: str  # name of the file or repository
    key: str = ""  # key of the weights in the file; "" for a folder
    licence: str = ""  # "" if it is not known
    has_heads_in_fingerprint: bool = True  # whether an unpublished number of heads changes the encoder's fingerprint

    def as_dict(self) -> dict[str, str | bool]:
        """Return the origin as plain values, with the keys of config.json."""
        values = asdict(self)
        values[_HEADS_KEY] = values.pop("has_heads_in_fingerprint")
        return values

    def __str__(self) -> str:
        key = f", {self.key}" if self.key else ""
        return f"{self.file}{key}{f' ({self.licence})' if self.licence else ''}"


# ---- published checkpoints ----

OFFICIAL = "vjepa2-ac-vitg"  # Meta's world model, which `vjepa2-ac download` fetches by default

_URL = "https://dl.fbaipublicfiles.com/vjepa2/"
_TOLERANCE = 0.25  # relative tolerance of an approximate file size


@dataclass(frozen=True)
class Published:
    """A file that can be downloaded; Meta publishes no hashes."""

    name: str  # argument of `vjepa2-ac download`; unique even if case is ignored
    remote: str  # file name on Meta's server
    encoder: EncoderShape
    image_size: int  # frame size in the last phase of training, in pixels
    key: str  # key of the encoder's weights in the file
    gigabytes: float  # approximate file size, including averaged weights and the optimizer's moments
    bytes: int | None = None  # exact file size; None if it is not known
    licence: str = "MIT"  # the licence of Meta's repository, because the server sends none with the file

    @property
    def model_kind(self) -> str:
        """The kind of model in the file."""
        return "world model" if self.name == OFFICIAL else "encoder"

    @property
    def family(self) -> Family:
        """The family of the file's encoder."""
        return "v2.1" if self.name.startswith("vjepa2.1") else "v2"

    @property
    def url(self) -> str:
        """The URL of the file."""
        return _URL + self.remote

    @property
    def file(self) -> str:
        """The local file name, which is unique even on a case-insensitive disk."""
        return f"{self.name}.pt"

    @property
    def size(self) -> str:
        """The size of the file, as text."""
        return f"about {self.gigabytes:g} GB" if self.bytes is None else f"{self.bytes:,} bytes"

    @property
    def config_key(self) -> str:
        """The config key to which the file can be assigned."""
        return "model.base" if self.name == OFFICIAL else "model.encoder.path"


PUBLISHED: tuple[Published, ...] = (
    Published(OFFICIAL, "vjepa2-ac-vitg.pt", VIT_g, 256, "encoder", 11.7),
    Published("vjepa2-vitl", "vitl.pt", VIT_L, 256, "target_encoder", 5.1),
    Published("vjepa2-vith", "vith.pt", VIT_H, 256, "target_encoder", 10.4),
    Published("vjepa2-vitg", "vitg.pt", VIT_g, 256, "target_encoder", 16.5),
    Published("vjepa2-vitg-384", "vitg-384.pt", VIT_g, 384, "target_encoder", 16.5),
    Published("vjepa2.1-vitb-384", "vjepa2_1_vitb_dist_vitG_384.pt", VIT_B, 384, "ema_encoder", 1.66, 1_664_223_428),
    Published("vjepa2.1-vitl-384", "vjepa2_1_vitl_dist_vitG_384.pt", VIT_L, 384, "ema_encoder", 5.1),
    Published("vjepa2.1-vitg-1b-384", "vjepa2_1_vitg_384.pt", VIT_g, 384, "target_encoder", 16.5),
    Published("vjepa2.1-vitG-2b-384", "vjepa2_1_vitG_384.pt", VIT_G, 384, "target_encoder", 29.8),
)


def find_published_file(file_name: str) -> Published | None:
    """Return the published file with this name (on Meta's server or after the download); None if there is none."""
    return next((published for published in PUBLISHED if file_name in {published.remote, published.file}), None)


def find_published(text: str) -> Published:
    """Return the published checkpoint with a name.

    Args:
        text: The argument of `vjepa2-ac download`, or the name of the file on Meta's server; with or without `.pt`.

    Raises:
        InputError: No published checkpoint has this name.
    """
    name = text.removesuffix(".pt")
    published = next((entry for entry in PUBLISHED if name in {entry.name, entry.remote.removesuffix(".pt")}), None)
    if published is None:
        fix = "`vjepa2-ac download --list` shows all names; --to sets the path of the file"
        raise InputError(where=f"download {text}", found="no published checkpoint with this name", fix=fix)
    return published


CHUNK_BYTES = 2**20
_POLICY = RetryPolicy(attempts=5, first_wait_s=2.0, total_s=math.inf)
_PROXY = "Check the URL, and whether a proxy answers instead of the server"


def download(
    url: str,
    path: str | Path,
    *,
    published: Published | None = None,
    reporter: Reporter = SILENT,
    policy: RetryPolicy = _POLICY,
) -> Path:
    """Download a file to `path`, or resume the partial download of an earlier call.

    Args:
        url: The URL of the file.
        path: The path of the complete file, which exists only after the download has finished. An existing file is
            kept if it has the right size.
        published: The published checkpoint, whose size is checked; None for any other file.
        reporter: Receives the progress in megabytes.
        policy: The maximum number of consecutive attempts without progress, and the waits between attempts.

    Raises:
        InputError: The server sends no size of the file, or a size that the published file cannot have; the disk has
            too little space; the path is not writable.
        UnreachableError: The server refuses, or cannot be reached.
    """
    path = Path(path)
    with storage.translate_write_errors(path):
        if path.is_dir():
            raise InputError(where=str(path), found="a folder", needed="the path of a file", fix="Add a file name")
        if path.exists():
            _require_size(published, _size(path), where=str(path))
            return path
        path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.{published.name}.part" if published else f"{path.name}.part")
    try:
        call_with_retries(
            url,
            lambda timeout_s: _fetch(url, part, published, reporter, timeout_s),
            policy=policy,
            access="Check the URL",
            progress=lambda: _size(part),
        )
    except RefusedError:
        raise
    except UnreachableError as error:
        problem = f"{error.found}; {_size(part)} bytes are in {part}"
        fix = "Check the network and start again: the download resumes where it stopped"
        raise UnreachableError(where=url, found=problem, fix=fix) from None
    return part.replace(path)


def _fetch(url: str, part: Path, published: Published | None, reporter: Reporter, timeout_s: float) -> None:
    """Download the rest of a file of which `part` contains the beginning."""
    start = _size(part)
    try:
        request = urllib.request.Request(url, headers={"Range": f"bytes={start}-"} if start else {})  # noqa: S310  # the user sets the URL
        response = urllib.request.urlopen(request, timeout=timeout_s)  # noqa: S310  # the user sets the URL
    except http.client.InvalidURL as error:
        raise ValueError(error) from None  # another attempt cannot succeed
    except urllib.error.HTTPError as error:
        if error.code != 416:
            raise
        if error.headers.get("Content-Range", "").endswith(f"/{start}"):  # the file is complete
            return
        part.unlink()
        raise http.client.HTTPException("the partial download does not match the file; starting again") from None
    with response:
        start = start if response.headers.get("Content-Range", "").startswith(f"bytes {start}-") else 0
        content_length = response.headers.get("Content-Length", "")
        if not content_length.isdigit():
            needed = "the size of the file, without which an incomplete download is not detected"
            raise InputError(where=url, found="a response without Content-Length", needed=needed, fix=_PROXY)
        total = start + int(content_length)
        _require_size(published, total, where=url)
        free = storage.free_bytes(part.parent.absolute()) + _size(part)
        if total > free:
            needed = f"{total / 1e9:.4g} GB, of which {start / 1e9:.4g} GB are downloaded"
            fix = "Free some space, or set --to to a file on a larger disk"
            raise InputError(where=str(part), found=f"{free / 1e9:.4g} GB free on its disk", needed=needed, fix=fix)
        report_progress = reporter.task(f"{part.name.removesuffix('.part')} (MB)")
        with storage.translate_write_errors(part), part.open("ab" if start else "wb") as file:
            while block := response.read(CHUNK_BYTES):
                file.write(block)
                report_progress(file.tell() // 10**6, total // 10**6)
        if _size(part) < total:
            raise http.client.IncompleteRead(b"", total - _size(part))


def _require_size(published: Published | None, size: int, *, where: str) -> None:
    """Check the size of a file; an approximate size is sufficient to detect an error page from a proxy."""
    if published is None:
        return
    bounds = [round(published.gigabytes * factor * 10**9) for factor in (1 - _TOLERANCE, 1 + _TOLERANCE)]
    smallest, largest = bounds if published.bytes is None else (published.bytes, published.bytes)
    if not smallest <= size <= largest:
        needed = f"{smallest:,} to {largest:,} bytes for {published.name}"
        fix = f"{_PROXY}; or delete the file, or set --to to another path"
        raise InputError(where=where, found=f"a file of {size:,} bytes", needed=needed, fix=fix)


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0
