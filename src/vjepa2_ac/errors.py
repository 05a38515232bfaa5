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
        parts = [found]
        if needed:
            parts.append(f"needed: {needed}")
        if fix:
            parts.append(fix if fix.endswith((".", "?", "`")) else f"{fix}.")
        super().__init__(f"{where}: " + ". ".join(part.rstrip(".") if i < len(parts) - 1 else part for i, part in enumerate(parts)))

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        """Survive the trip from a loader worker to the main process."""
        return (_rebuild, (type(self), self.where, self.found, self.needed, self.fix))


def _rebuild(kind: type[InputError], where: str, found: str, needed: str, fix: str) -> InputError:
    return kind(where=where, found=found, needed=needed, fix=fix)
