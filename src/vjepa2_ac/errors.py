"""What does the user read when something they gave cannot be used?"""


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
