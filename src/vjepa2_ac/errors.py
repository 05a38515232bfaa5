"""Error types, and their messages for the user: unusable input, or a machine that lacks what is needed."""

import difflib
import errno
import gc
import importlib
import json
import logging
import os
import re
import resource
import shlex
import shutil
import stat
import sys
import unicodedata
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib.metadata import PackageNotFoundError, distribution, version
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

_PACKAGE = "vjepa2-ac"
_GPU_IS_FULL = "OutOfMemoryError"  # PyTorch's, which is not imported here
_LESS_MEMORY = (
    "Set training.gradient_checkpointing=true, or lower training.batch_size (and raise training.accumulation),"
    " validation.batch_size, planning.energy.samples_at_once or decoder.batch_size"
)
_CLOSED = frozenset({errno.EACCES, errno.EPERM})
_NO_MORE_FILES = frozenset({errno.EMFILE, errno.ENFILE})
_MOST_CHARACTERS = 8_000  # of a part of a message: quoted input may have any length
_CONTROL = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})  # some control terminals; lone surrogates cannot be encoded


class UserError(Exception):
    """What the user has to know and can change: where it is, what was found, what was needed, and how to fix it.

    The command line prints the message without a traceback and exits with status 2. Quoted input is untrusted: control
    characters are escaped, and long parts are cut. It is raised as one of its two kinds, which are never mistaken for
    one another: handlers of broken data catch an `InputError`, and what cannot be reached passes them.

    Args:
        where: A config key, file, episode or command that the user can look at.
        found: What was found.
        needed: What should be there; may be empty where `found` already says it.
        fix: How to fix it, as a sentence.
    """

    is_reported = False  # by another process of the run, which met it

    def __init__(self, *, where: str, found: str, needed: str = "", fix: str = "") -> None:
        self.where, self.found, self.needed, self.fix = where, found, needed, fix
        sentences = [_short(found), f"Expected {_short(needed)}" if needed else "", _short(fix)]
        text = f"{_short(where)}: " + "".join(_sentence(text) for text in sentences if text).rstrip()
        super().__init__(printable(text))

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        """Pickle the error, for the way from a loader worker to the main process."""
        return partial(type(self), where=self.where, found=self.found, needed=self.needed, fix=self.fix), ()


class InputError(UserError):
    """Input that cannot be used: a file, an episode, a config, a command line."""


class MissingFileError(InputError):
    """There is no such file."""


class UnreachableError(UserError):
    """Data cannot be reached now. This says nothing about the data itself."""


class RefusedError(UnreachableError):
    """A server or a disk refuses permanently: no permission, no such bucket."""


def _sentence(text: str) -> str:
    """End a part of the message as a sentence; a part that ends with a new line has its own layout."""
    if text.endswith("\n"):
        return text
    return text + (" " if text.endswith((".", "?", "!")) else ". ")


def printable(text: str) -> str:
    r"""Return a text that is safe to show on a terminal: control characters are escaped, as \x1b.

    Line ends and tabs stay.
    """
    if text.isprintable():
        return text
    is_shown = [one in "\n\t" or unicodedata.category(one) not in _CONTROL for one in text]
    shown = zip(text, is_shown, strict=True)
    return "".join(one if is_safe else one.encode("unicode_escape").decode() for one, is_safe in shown)


def escaped(text: str) -> str:
    r"""Return a text on one line, as names of third parties have to be in comments: line ends are escaped, as \n."""
    return "".join(one if one.isprintable() else one.encode("unicode_escape").decode() for one in text)


def _short(text: str) -> str:
    if len(text) <= _MOST_CHARACTERS:
        return text
    half = _MOST_CHARACTERS // 2
    return f"{text[:half]} … {text[-half:]}"


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return a question that names the nearest of the known names, and a space; empty where none is near."""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.7)
    return f"Did you mean {close[0]}? " if close else ""


def describe_error(error: BaseException) -> str:
    """Return the message of an error; for a lack of permission, files or memory, with a fix."""
    if isinstance(error, OSError) and (error.errno in _NO_MORE_FILES or (error.filename and error.errno in _CLOSED)):
        found, fix = describe_refusal(error)
        return str(InputError(where=str(error.filename or "ulimit -n"), found=found, fix=fix))
    if not is_out_of_memory(error):
        return str(error)
    said = str(error).splitlines()[0] if str(error) else "MemoryError"
    if type(error).__name__ == _GPU_IS_FULL:
        return f"the GPU's memory is not enough ({said}). {_LESS_MEMORY}"
    return f"this machine's memory is not enough ({said})"


def describe_refusal(error: OSError) -> tuple[str, str]:
    """Return what the operating system refused, with mode and owner for a lack of permission, and how to fix it."""
    said = error.strerror or str(error)
    if error.errno in _NO_MORE_FILES:
        limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        fix = "Raise the limit where the program is started, as with `ulimit -n 4096`, or lower"
        return f"too many open files: this process may have {limit} at once (ulimit -n)", f"{fix} data.workers"
    if error.errno not in _CLOSED or error.filename is None:
        return said, "Check its permissions, and the disk"
    path = Path(str(error.filename)).absolute()
    # A closed folder above the file hides it, and is named instead; Path.exists would raise.
    place = next(one for one in (path, *path.parents) if os.path.exists(one))  # noqa: PTH110
    status, name = place.stat(), "" if place == path else f"{place}: "
    owned = f"{name}mode {stat.S_IMODE(status.st_mode):04o}, owner uid {status.st_uid}"
    fix = "As the owner, change the permissions with chmod; or run this command as a user who has access"
    return f"{said} ({owned}; this process runs as uid {os.geteuid()})", fix


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: "1 episode", "1,200 episodes"."""
    plural = re.sub("(ch|x|s)$", r"\1e", noun)
    return f"{number:,} {noun if number == 1 else f'{plural}s'}"


def shell_command(*words: object) -> str:
    """Return a command of this program as it is typed in a shell, with paths quoted where they need it."""
    return shlex.join([_PACKAGE, *map(str, words)])


def pip_install(extra: str = "") -> str:
    """Return the command that installs this package, or an extra of it, as it was installed: a checkout, or a wheel.

    It works where it is pasted: in any folder, and in a shell in which this environment is not activated.

    Source: PEP 610, direct_url.json.
    """
    try:
        origin = json.loads(distribution(_PACKAGE).read_text("direct_url.json") or "{}")
    except (PackageNotFoundError, ValueError):
        origin = {"url": "", "dir_info": {"editable": True}}
    wanted = f"[{extra}]" if extra else ""
    if origin.get("dir_info", {}).get("editable"):
        clone = Path(unquote(urlsplit(origin["url"]).path))
        here = clone.resolve() == Path.cwd()
        constraints = "constraints.txt" if here else shlex.quote(str(clone / "constraints.txt"))
        place = f'"{"." if here else clone}{wanted}"' if extra else "." if here else shlex.quote(str(clone))
        return f"{_pip()} install -c {constraints} -e {place}"
    if "url" in origin and "vcs_info" not in origin:  # a wheel, or a folder
        return f'{_pip()} install "{_PACKAGE}{wanted} @ {origin["url"]}"'
    # Not by the name alone: whoever registers it on an index could run code here.
    return f'{_pip()} install "./vjepa2_ac-{version(_PACKAGE)}-py3-none-any.whl{wanted}"'


def require_library(module: str, *, where: str, called: str, extra: str) -> Any:
    """Return a module of an extra.

    Args:
        module: Its name.
        where: What needs it, for the message.
        called: What the library is called and does, such as "PyAV, which decodes video".
        extra: Of this package, which installs it.

    Raises:
        UnreachableError: It is not installed, which says nothing of the data: they are not broken.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise UnreachableError(where=where, found=f"{called}, is not installed", fix=pip_install(extra)) from None


@contextmanager
def quiet_imports() -> Iterator[None]:
    """Import transformers and PEFT within this context: some libraries log errors only, and no garbage is collected.

    The messages are about kernels for other devices that cannot be loaded, and about deprecations inside the libraries.
    The imports create half a million objects that stay, among which a search for garbage takes a third of the time.
    """
    loggers = [logging.getLogger(name) for name in ("bitsandbytes", "torchao", "torch.utils._pytree")]
    levels, collects = [logger.level for logger in loggers], gc.isenabled()
    gc.disable()
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
        if collects:
            gc.enable()


def _pip() -> str:
    """Return the pip of this environment: by its interpreter where `pip` would be another one."""
    found = shutil.which("pip")
    is_ours = found is not None and Path(found).parent == Path(sys.executable).parent
    return "pip" if is_ours else f"{shlex.quote(sys.executable)} -m pip"


def extra_for_library(library: str) -> str:
    """Return the extra of this package that brings a library, the first of several; "" if every installation has it."""
    try:
        lines = distribution(_PACKAGE).requires or []
    except PackageNotFoundError:
        return ""
    found = (re.fullmatch(rf"{re.escape(library)}\b.*extra == ['\"](\w+)['\"]", line) for line in lines)
    return next((match[1] for match in found if match), "")


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether memory was too small: the GPU's, or the machine's, for which PyTorch has no error type."""
    is_gpus = type(error).__name__ == _GPU_IS_FULL
    return is_gpus or isinstance(error, MemoryError) or "DefaultCPUAllocator: can't allocate memory" in str(error)
