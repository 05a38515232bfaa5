"""Error types, and their messages for the user: unusable input, or a machine that lacks what is needed."""

import errno
import resource
import unicodedata

_MOST_CHARACTERS = 8_000  # of a part of a message: what is quoted in it may be of any length
_CONTROL = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})  # terminals obey some of these; lone surrogates cannot be written


class InputError(Exception):
    """Something the user gave cannot be used: where it is, what was found, what was needed, and the way out.

    The command line prints the message without a traceback and exits with status 2. What is quoted in it may come from
    anybody: control characters are written out, and a part is cut where it is endless.

    Args:
        where: A config key, file, episode or command: what the user can go and look at.
        found: What is there.
        needed: What should be there; may be empty where `found` already says it.
        fix: The way out, as a sentence.
    """

    def __init__(self, *, where: str, found: str, needed: str = "", fix: str = "") -> None:
        self.where, self.found, self.needed, self.fix = where, found, needed, fix
        sentences = [_short(found), f"needed: {_short(needed)}" if needed else "", _short(fix)]
        text = f"{_short(where)}: " + "".join(_sentence(text) for text in sentences if text).rstrip()
        super().__init__(printable(text))

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


def printable(text: str) -> str:
    r"""Return a text that a terminal shows and does not obey: control characters are written out, as \x1b.

    Ends of lines and tabs stay.
    """
    if text.isprintable():
        return text
    return "".join(_written_out(character) for character in text)


def _written_out(character: str) -> str:
    if character in "\n\t" or unicodedata.category(character) not in _CONTROL:
        return character
    return character.encode("unicode_escape").decode()


def _short(text: str) -> str:
    if len(text) <= _MOST_CHARACTERS:
        return text
    half = _MOST_CHARACTERS // 2
    return f"{text[:half]} … {text[-half:]}"


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
