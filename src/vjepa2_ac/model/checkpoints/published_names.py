"""Which published checkpoint does a name mean? Ours, Meta's names of files and those of torch.hub are understood."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable
from pathlib import PurePath

from vjepa2_ac.errors import InputError
from vjepa2_ac.model.checkpoints import published
from vjepa2_ac.model.checkpoints.published import Published
from vjepa2_ac.model.network.published_sizes import VIT_G, VIT_g

OFFICIAL = "vjepa2-ac-vitg"  # Meta's world model, which `download` fetches without a name

_LIST = "`vjepa2-ac download --list` shows all"


def find_published(text: str) -> Published:
    """Return the published checkpoint that a name means.

    The exact name counts first, then one that differs by dots, dashes and underscores, then one that differs by case,
    too: Meta's vjepa2_1_vitg_384 and vjepa2_1_vitG_384 are two files, so case is only ignored where one file is left.

    Args:
        text: Our name, Meta's name of the file or the name in torch.hub; with or without `.pt`.

    Raises:
        InputError: None has this name, or several have; or it is a path, which belongs behind `--to`.
    """
    for spelling in _SPELLINGS:
        meant = _spelt(text, spelling)
        if len(meant) == 1 and _is_other_letter(text, meant[0]):
            meant += [one for one in published.PUBLISHED if one.encoder is VIT_G]
        if len(meant) == 1:
            return meant[0]
        if meant:
            found = f"{len(meant)} published files can be meant: vitg (1 B) and vitG (2 B) are two"
            fix = f"Write {' or '.join(one.name for one in meant)}"
            raise InputError(where=f"download {text}", found=found, needed="one of them", fix=fix)
    if text.endswith(".pt") or text.startswith(("/", "./", "../", "~")):
        raise _is_path(text)
    raise _unknown(text)


def _exactly(name: str) -> str:
    return name.removesuffix(".pt")


def _without_separators(name: str) -> str:
    return re.sub(r"[-_. ]", "", _exactly(name))


def _without_case(name: str) -> str:
    return _without_separators(name.casefold())


_SPELLINGS: tuple[Callable[[str], str], ...] = (_exactly, _without_separators, _without_case)


def _names(one: Published) -> tuple[str, ...]:
    return one.name, one.remote, *one.aliases


def _is_other_letter(text: str, one: Published) -> bool:
    """Return whether a name says ViT-G, of 2 B, where the file is ViT-g, of 1 B."""
    return re.search(r"(?i:vit)[-_]?G", text) is not None and one.encoder is VIT_g


def _spelt(text: str, spelling: Callable[[str], str]) -> list[Published]:
    return [one for one in published.PUBLISHED if spelling(text) in map(spelling, _names(one))]


def _is_path(text: str) -> InputError:
    close = _near(PurePath(text).name)
    name = close[0] if close else OFFICIAL
    return InputError(
        where=f"download {text}",
        found="a path, and no published checkpoint of this name",
        needed="the name of a checkpoint; the path of the file belongs behind --to",
        fix=f"Write `vjepa2-ac download {name} --to {text}`; {_LIST}",
    )


def _unknown(text: str) -> InputError:
    close = _near(PurePath(text).name)
    return InputError(
        where=f"download {text}",
        found="no published checkpoint of this name",
        fix=f"Did you mean {' or '.join(close)}? {_LIST}" if close else f"{_LIST}",
    )


def _near(text: str) -> list[str]:
    """Return our names of the checkpoints with names near a text, the nearest first."""
    names = {_without_case(name): one.name for one in published.PUBLISHED for name in _names(one)}
    return list(dict.fromkeys(names[near] for near in difflib.get_close_matches(_without_case(text), names, n=3)))
