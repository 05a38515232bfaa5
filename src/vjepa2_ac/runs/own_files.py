"""Link checks for the files of a run: a link to elsewhere is never written through, whoever made it.

The folder itself may be a link, to another disk for example.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from vjepa2_ac.errors import InputError


def refuse_links_out(run: Path, names: Iterable[str]) -> None:
    """Check that no file to be written leads out of a run's folder.

    Args:
        run: The run's folder.
        names: Of files and folders in it; parts of a path may be links, too.

    Raises:
        InputError: One is, or is behind, a link that leads out.
    """
    home = run.resolve()
    for link in (link for name in names for link in _links(run, name)):
        target = _target(link)
        if target is None or not target.is_relative_to(home):
            raise refused_link(link)


def refused_link(link: Path) -> InputError:
    """Return the error of a link in a run's folder that is not followed."""
    target = _target(link)
    found = "a link that leads nowhere" if target is None else f"a link that leads out of the run, to {target}"
    fix = "Remove it. To have a run on another disk, make the run's folder itself the link, or set run_dir to that disk"
    return InputError(where=str(link), found=found, needed="a file or folder of the run's own", fix=fix)


def _links(run: Path, name: str) -> Iterator[Path]:
    """Yield the links among the parts of `a/b/c`: `a`, `a/b`, `a/b/c`."""
    path = run
    for part in Path(name).parts:
        path /= part
        if path.is_symlink():
            yield path


def _target(link: Path) -> Path | None:
    try:
        return link.resolve()
    except (OSError, RuntimeError):  # a cycle of links
        return None
