"""What does the user read when something they gave cannot be used, or the machine cannot give what is needed?"""

import errno
import resource


class InputError(Exception):
    """Something the user gave cannot be used: where it is, what was found, what was needed, and the way out.

    The command line prints the message without a traceback and exits with status 2.

    Args:
        where: A config key, file, episode or command: what the user can go and look at.
        found: What is there.
        needed: What should be there; may be empty where `found` already says it.
        fix: The way out, as a sentence.
    """

    def __init__(self, *, where: str, found: str, needed: str = "", fix: str = "") -> None:
        self.where, self.found, self.needed, self.fix = where, found, needed, fix
        sentences = [found, f"needed: {needed}" if needed else "", fix]
        super().__init__(f"{where}: " + "".join(_sentence(text) for text in sentences if text).rstrip())

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        """Survive the trip from a loader worker to the main process."""
        return (_rebuild, (type(self), self.where, self.found, self.needed, self.fix))


def _rebuild(kind: type[InputError], where: str, found: str, needed: str, fix: str) -> InputError:
    return kind(where=where, found=found, needed=needed, fix=fix)


def _sentence(text: str) -> str:
    """End a part of the message; a part that begins on a new line brings its own layout."""
    if text.endswith("\n"):
        return text
    return text + (" " if text.endswith((".", "?", "!")) else ". ")


def in_words(error: BaseException) -> str:
    """Return what to tell of an error: of files and memory that the system does not give, with the way out."""
    if isinstance(error, OSError) and error.errno in {errno.EMFILE, errno.ENFILE}:
        return str(too_few_files(str(error.filename or "")))
    if is_out_of_memory(error):
        return f"this machine's memory is not enough ({str(error).splitlines()[0] if str(error) else 'MemoryError'})"
    return str(error)


def too_few_files(where: str = "") -> InputError:
    """Return the error of a process that may not open as many files as it needs."""
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return InputError(
        where=where or "ulimit -n",
        found=f"too many open files: this process may have {limit} of them at once (ulimit -n)",
        fix="Raise that where it is started, as with `ulimit -n 4096`, or lower data.workers and data.connections",
    )


def is_out_of_memory(error: BaseException) -> bool:
    """Tell whether the machine's memory, not the GPU's, was not enough: PyTorch has no error of its own for that."""
    return isinstance(error, MemoryError) or "DefaultCPUAllocator: can't allocate memory" in str(error)
