"""Where a model is, its sizes as its folder says them, and which encoder it has.

No weight is read, and PyTorch is not imported.
Source of the published shapes: facebookresearch/vjepa2 @ 204698b, src/hub/backbones.py and the classes it names.
"""

from __future__ import annotations

import hashlib
import importlib.resources
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vjepa2_ac.config import EncoderSizes, ModelConfig, ModelSizes
from vjepa2_ac.config.loading import flat
from vjepa2_ac.config.model import Family, FramePath
from vjepa2_ac.errors import InputError, shell_command
from vjepa2_ac.storage.places import BUILTIN, HUB
from vjepa2_ac.storage.structured import read_json_object, record_of

ASSETS = Path(str(importlib.resources.files("vjepa2_ac"))) / "assets"
FORMAT = "vjepa2-ac world model 1"
CONFIG = "config.json"
ENCODER_NEEDED = "an encoder of V-JEPA 2 or 2.1: Meta's .pt, a transformers folder, or a model of this project"

_TINY = f"{BUILTIN}sim-tiny"
NEEDED_MODEL = "a folder written by `vjepa2-ac export` or WorldModel.save_pretrained"
_FIX = "Of a run, `vjepa2-ac export RUN FOLDER` makes one"


def find_base(name: str) -> Path:
    """Return the file or folder that `model.base` names.

    Raises:
        InputError: There is none.
    """
    needed = f"the official .pt, a folder written by `vjepa2-ac export`, or {_TINY}"
    fix = "`vjepa2-ac download` fetches the official checkpoint to checkpoints/vjepa2-ac-vitg.pt"
    return _find(name, f"model.base: {name}", needed, fix)


def find_encoder_path(name: str) -> Path | None:
    """Return the file or folder that `model.encoder.path` names; None: it is on the Hub.

    Raises:
        InputError: There is none.
    """
    if name.startswith(HUB):
        return None
    fix = "`vjepa2-ac download --list` shows those that are published"
    return _find(name, f"model.encoder.path: {name}", ENCODER_NEEDED, fix)


def require_model(config: ModelConfig) -> None:
    """Refuse a model or an encoder of this machine that is not there.

    Raises:
        InputError: It is not.
    """
    if config.base is not None:
        find_base(config.base)
    if config.encoder is not None:
        find_encoder_path(config.encoder.path)


def require_base_of_run(config: ModelConfig, run: Path, command: Sequence[str] = ()) -> None:
    """Refuse a run whose base or encoder is no longer at its path.

    Args:
        config: The model of the run.
        run: Its folder.
        command: The words of a command that takes the new path; none: the command that resumes the run is advised.

    Raises:
        InputError: It is not there; says how to give the new path.
    """
    try:
        require_model(config)
    except InputError as error:
        key = error.where.partition(":")[0]
        moved = shell_command(*(command or ("train", run, "--resume")), f"{key}=PATH")
        needed = f"what {run} was trained on. It may be at any path: the fingerprint of its weights is compared"
        fix = f"If it was moved, run `{moved}`"
        raise InputError(where=error.where, found=error.found, needed=needed, fix=fix) from None


def _find(name: str, where: str, needed: str, fix: str) -> Path:
    path = ASSETS / name.removeprefix(BUILTIN) if name.startswith(BUILTIN) else Path(name)
    if name.startswith(BUILTIN) and not (path / CONFIG).is_file():
        there = ", ".join(sorted(f"{BUILTIN}{config.parent.name}" for config in ASSETS.glob(f"*/{CONFIG}")))
        found = f"no model of that name in the package; it has {there or 'none: install it again, or run `make base`'}"
        raise InputError(where=where, found=found, needed=_TINY)
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
    return record_of(ModelSizes, card.get("sizes"), where=f"{where}: sizes", needed=NEEDED_MODEL, fix=_FIX)


def check_sizes(found: ModelSizes, given: ModelSizes, *, where: str) -> None:
    """Refuse sizes that were given, and are not those of the model.

    Only those other than the default count as given: a run's own config spells out every default.

    Raises:
        InputError: Names what differs.
    """
    actual, wanted, standard = (flat(sizes.model_dump()) for sizes in (found, given, ModelSizes()))
    wrong = [key for key in actual if wanted[key] not in (actual[key], standard[key])]
    if wrong:
        said = ", ".join(f"{key} {actual[key]}, and model.sizes says {wanted[key]}" for key in wrong)
        raise InputError(where=where, found=said, fix="Leave them out of model.sizes: the model tells")


@dataclass(frozen=True)
class EncoderShape:
    """A published encoder."""

    name: str  # ViT-B, ...
    width: int
    depth: int
    heads: int
    hidden: int  # width of the MLP

    @property
    def parameters(self) -> int:
        """About how many weights it has: those of blocks and patches, without biases and norms."""
        return self.depth * (4 * self.width**2 + 2 * self.width * self.hidden) + 2 * 3 * 16**2 * self.width

    def sizes(self, family: Family, frame: FramePath) -> EncoderSizes:
        """Return the sizes of an encoder of this shape."""
        own = {"width": self.width, "depth": self.depth, "heads": self.heads, "mlp_ratio": self.hidden / self.width}
        return EncoderSizes.model_validate({**own, "family": family, "frame": frame})


VIT_B = EncoderShape("ViT-B", 768, 12, 12, 3072)
VIT_L = EncoderShape("ViT-L", 1024, 24, 16, 4096)
VIT_H = EncoderShape("ViT-H", 1280, 32, 16, 5120)
VIT_g = EncoderShape("ViT-g", 1408, 40, 22, 6144)
VIT_G = EncoderShape("ViT-G", 1664, 48, 26, 8192)

HEADS: Mapping[int, int] = {one.width: one.heads for one in (VIT_B, VIT_L, VIT_H, VIT_g, VIT_G)}
"""Width of an encoder -> its attention heads, which its tensors do not show."""


@dataclass(frozen=True)
class EncoderOrigin:
    """The file or repository that an encoder was read from."""

    file: str  # its name
    key: str = ""  # of the weights in it; "" of a folder
    licence: str = ""  # where it is known
    heads_are_told: bool = True  # False: of a model whose own fingerprint does not know them

    def __str__(self) -> str:
        key = f", {self.key}" if self.key else ""
        return f"{self.file}{key}{f' ({self.licence})' if self.licence else ''}"


def beyond_tensors(sizes: EncoderSizes, *, heads_are_told: bool) -> dict[str, str | int]:
    """Return what latents depend on and tensors do not show; nothing of V-JEPA 2's tubelets with the published heads.

    Args:
        sizes: Of the encoder.
        heads_are_told: Whether the heads belong to it; not of a model that was made with its encoder.
    """
    found: dict[str, str | int] = {}
    if sizes.family != "v2":
        found |= {"encoder.family": sizes.family, "encoder.frame": sizes.frame}
    if heads_are_told and HEADS.get(sizes.width) != sizes.heads:
        found["encoder.heads"] = sizes.heads
    return found


def identified(fingerprint: str, beyond: Mapping[str, str | int]) -> str:
    """Return the fingerprint of an encoder: that of its tensors, with what they do not show.

    Args:
        fingerprint: Of the tensors.
        beyond: As `beyond_tensors` gives it; where there is nothing, the fingerprint stays that of the tensors,
            whatever file they came from.
    """
    if not beyond:
        return fingerprint
    return hashlib.sha256(json.dumps([fingerprint, dict(beyond)], sort_keys=True).encode()).hexdigest()


def described(sizes: EncoderSizes, origin: EncoderOrigin | None) -> str:
    """Return an encoder in words, for cards."""
    frame = "" if sizes.family == "v2" else f", each frame as {'a tubelet' if sizes.frame == 'tubelet' else 'an image'}"
    text = f"V-JEPA {sizes.family[1:]}, {sizes.depth} blocks of {sizes.width}, {sizes.heads} heads{frame}"
    return text if origin is None else f"{text}; from {origin}"
