"""Files of a model from the Hugging Face Hub, through its own library and cache."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from vjepa2_ac.errors import InputError, RefusedError, UnreachableError
from vjepa2_ac.storage.places import HUB


def from_hub(name: str, files: Sequence[str], *, where: str) -> Path:
    """Return the folder of a model in the Hub's cache, after downloading what is missing; a part is gone on with.

    Args:
        name: hf://owner/name, with @revision if it is not the newest.
        files: Patterns of the files that are wanted.
        where: For messages.

    Raises:
        RefusedError: There is no such model, or not for this user.
        UnreachableError: The Hub cannot be reached, and the model is not in the cache.
        InputError: The Hub answers something else, or the disk is full.
    """
    from huggingface_hub import errors, snapshot_download

    model, _, revision = name.removeprefix(HUB).partition("@")
    try:
        return Path(snapshot_download(model, revision=revision or None, allow_patterns=list(files)))
    except (errors.RepositoryNotFoundError, errors.RevisionNotFoundError):  # or gated
        fix = "Check the name (hf://owner/name@revision). A gated model must be asked for on its page; for one that is"
        found = "no such model or revision, or none for you"
        raise RefusedError(where=where, found=found, fix=f"{fix} not public, `hf auth login` or set HF_TOKEN") from None
    except errors.LocalEntryNotFoundError:
        fix = "Check the network, or name a folder of this machine"
        raise UnreachableError(where=where, found="the Hub cannot be reached", fix=fix) from None
    except (errors.HfHubHTTPError, OSError, ValueError) as error:
        said = next(iter(str(error).strip().splitlines()), type(error).__name__)
        raise InputError(where=where, found=said, needed="the files of a model", fix="Check name and disk") from None
