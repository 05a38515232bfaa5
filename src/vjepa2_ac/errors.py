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
_GPU_OUT_OF_MEMORY = "OutOfMemoryError"  # name of PyTorch's error; PyTorch is not imported here
_MEMORY_FIX = (
    "Set training.gradient_checkpointing=true, or lower training.batch_size (and raise training.accumulation),"
    " validation.batch_size, planning.energy.samples_at_once or decoder.batch_size"
)
_NO_PERMISSION = frozenset({errno.EACCES, errno.EPERM})
_NO_MORE_FILES = frozenset({errno.EMFILE, errno.ENFILE})
_MAX_CHARACTERS = 8_000  # limit of a part of a message, since quoted input may have any length
_CONTROL = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})  # some control terminals; lone surrogates cannot be encoded


class UserError(Exception):
    """An error that the user can fix: where it is, what was found, what was expected, and how to fix it.

    The command line prints the message without a traceback and exits with status 2. Quoted input is untrusted: control
    characters are escaped, and long parts are cut. It is raised as one of two subclasses: code that skips broken data
    catches `InputError` only, so that unreachable data are never treated as broken.

    Args:
        where: A config key, file, episode or command that the user can look at.
        found: What was found.
        needed: What was expected; empty if `found` implies it.
        fix: How to fix it, as a sentence.
    """

    is_reported = False  # whether another process of the run prints it

    def __init__(self, *, where: str, found: str, needed: str = "", fix: str = "") -> None:
        self.where, self.found, self.needed, self.fix = where, found, needed, fix
        sentences = [_short(found), f"Expected {_short(needed)}" if needed else "", _short(fix)]
        text = f"{_short(where)}: " + "".join(_sentence(text) for text in sentences if text).rstrip()
        super().__init__(printable(text))

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        """Pickle the error, so that a loader worker can send it to the main process."""
        return partial(type(self), where=self.where, found=self.found, needed=self.needed, fix=self.fix), ()


class InputError(UserError):
    """Input that cannot be used: a file, an episode, a config, a command line."""


class MissingFileError(InputError):
    """A file does not exist."""


class UnreachableError(UserError):
    """Data cannot be reached at the moment. The data itself may be valid."""


class RefusedError(UnreachableError):
    """A server or a disk refuses access permanently, for example without permission or if a bucket does not exist."""


def _sentence(text: str) -> str:
    """Add the final period and a space, unless the part ends with a newline."""
    if text.endswith("\n"):
        return text
    return text + (" " if text.endswith((".", "?", "!")) else ". ")


def printable(text: str) -> str:
    r"""Return a text that is safe to show on a terminal: control characters are escaped, as \x1b.

    Newlines and tabs are kept.
    """
    if text.isprintable():
        return text
    return "".join(
        char if char in "\n\t" or unicodedata.category(char) not in _CONTROL else char.encode("unicode_escape").decode()
        for char in text
    )


def escaped(text: str) -> str:
    r"""Return a text on one line, for untrusted names in comments: newlines are escaped, as \n."""
    return "".join(char if char.isprintable() else char.encode("unicode_escape").decode() for char in text)


def _short(text: str) -> str:
    if len(text) <= _MAX_CHARACTERS:
        return text
    half = _MAX_CHARACTERS // 2
    return f"{text[:half]} … {text[-half:]}"


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return "Did you mean X? " for the most similar known name; empty if none is similar."""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.7)
    return f"Did you mean {close[0]}? " if close else ""


def describe_error(error: BaseException) -> str:
    """Return the message of an error, with a fix if permission, file descriptors or memory are missing."""
    if isinstance(error, OSError) and (
        error.errno in _NO_MORE_FILES or (error.filename and error.errno in _NO_PERMISSION)
    ):
        problem, fix = describe_refusal(error)
        return str(InputError(where=str(error.filename or "ulimit -n"), found=problem, fix=fix))
    if not is_out_of_memory(error):
        return str(error)
    message = str(error).splitlines()[0] if str(error) else "MemoryError"
    if type(error).__name__ == _GPU_OUT_OF_MEMORY:
        return f"the GPU has too little memory ({message}). {_MEMORY_FIX}"
    return f"this machine has too little memory ({message})"


def describe_refusal(error: OSError) -> tuple[str, str]:
    """Return why the operating system refused access (with mode and owner of the file), and how to fix it."""
    reason = error.strerror or str(error)
    if error.errno in _NO_MORE_FILES:
        limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        fix = "Raise the limit where the program is started, as with `ulimit -n 4096`, or lower"
        return f"too many open files: the limit of this process is {limit} (ulimit -n)", f"{fix} data.workers"
    if error.errno not in _NO_PERMISSION or error.filename is None:
        return reason, "Check its permissions, and the disk"
    path = Path(str(error.filename)).absolute()
    # If a parent folder is not readable, it is named instead of the file; Path.exists would raise.
    existing = next(parent for parent in (path, *path.parents) if os.path.exists(parent))  # noqa: PTH110
    status, name = existing.stat(), "" if existing == path else f"{existing}: "
    owned = f"{name}mode {stat.S_IMODE(status.st_mode):04o}, owner uid {status.st_uid}"
    fix = "As the owner, change the permissions with chmod; or run this command as a user who has access"
    return f"{reason} ({owned}; this process runs as uid {os.geteuid()})", fix


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: "1 episode", "1,200 episodes"."""
    plural = re.sub("(ch|x|s)$", r"\1e", noun)
    return f"{number:,} {noun if number == 1 else f'{plural}s'}"


def shell_command(*words: object) -> str:
    """Return a shell command of this program, with quoting where needed."""
    return shlex.join([_PACKAGE, *map(str, words)])


def pip_install(extra: str = "") -> str:
    """Return the pip command that installs this package or an extra of it, from its checkout or wheel.

    It works in any folder, and in a shell in which this environment is not activated.

    Source: PEP 610, direct_url.json.
    """
    try:
        origin = json.loads(distribution(_PACKAGE).read_text("direct_url.json") or "{}")
    except (PackageNotFoundError, ValueError):
        origin = {"url": "", "dir_info": {"editable": True}}
    extras = f"[{extra}]" if extra else ""
    if origin.get("dir_info", {}).get("editable"):
        clone = Path(unquote(urlsplit(origin["url"]).path))
        is_cwd = clone.resolve() == Path.cwd()
        constraints = "constraints.txt" if is_cwd else shlex.quote(str(clone / "constraints.txt"))
        target = f'"{"." if is_cwd else clone}{extras}"' if extra else "." if is_cwd else shlex.quote(str(clone))
        return f"{_pip()} install -c {constraints} -e {target}"
    if "url" in origin and "vcs_info" not in origin:  # a wheel, or a folder
        return f'{_pip()} install "{_PACKAGE}{extras} @ {origin["url"]}"'
    # Not the name alone: a third party could have registered it on a package index.
    return f'{_pip()} install "./vjepa2_ac-{version(_PACKAGE)}-py3-none-any.whl{extras}"'


def require_library(module: str, *, where: str, called: str, extra: str) -> Any:
    """Import and return a module of an optional library.

    Args:
        module: Name of the module.
        where: What needs the library, for the message.
        called: Name and purpose of the library, such as "PyAV, which decodes video".
        extra: The extra of this package that installs it.

    Raises:
        UnreachableError: The library is not installed. (Not an InputError, because the data are not broken.)
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise UnreachableError(where=where, found=f"{called}, is not installed", fix=pip_install(extra)) from None


@contextmanager
def quiet_imports() -> Iterator[None]:
    """Context for imports of transformers and PEFT: silences warnings of some libraries, and pauses garbage collection.

    The warnings are about kernels for other devices that cannot be loaded, and about deprecations inside the libraries.
    The imports create half a million permanent objects; garbage collection would take a third of the time.
    """
    loggers = [logging.getLogger(name) for name in ("bitsandbytes", "torchao", "torch.utils._pytree")]
    levels, was_enabled = [logger.level for logger in loggers], gc.isenabled()
    gc.disable()
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
        if was_enabled:
            gc.enable()


def _pip() -> str:
    """Return the pip command of this environment: `python -m pip` if `pip` on the path belongs to another one."""
    path = shutil.which("pip")
    is_own = path is not None and Path(path).parent == Path(sys.executable).parent
    return "pip" if is_own else f"{shlex.quote(sys.executable)} -m pip"


def extra_for_library(library: str) -> str:
    """Return the first extra of this package that installs a library; "" if it is a normal dependency."""
    try:
        lines = distribution(_PACKAGE).requires or []
    except PackageNotFoundError:
        return ""
    matches = (re.fullmatch(rf"{re.escape(library)}\b.*extra == ['\"](\w+)['\"]", line) for line in lines)
    return next((match[1] for match in matches if match), "")


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether the GPU or the machine ran out of memory; for the latter PyTorch has no error type."""
    is_gpu = type(error).__name__ == _GPU_OUT_OF_MEMORY
    return is_gpu or isinstance(error, MemoryError) or "DefaultCPUAllocator: can't allocate memory" in str(error)
