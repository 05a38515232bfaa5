"""Regular expressions from files: only those that terminate quickly on any text are accepted."""

from __future__ import annotations

import re

from vjepa2_ac.errors import InputError

_MOST_CHARACTERS = 100
_MOST_GROUPS = 2
_MOST_REPEATS = 2  # the run time grows with the text's length to this power
_ESCAPED = re.compile(r"\\.", re.DOTALL)
_SET = re.compile(r"\[\^?\]?[^\]]*\]")
_REPEAT = re.compile(r"[*+?{]")
_REPEATED_GROUP = re.compile(r"\)[*+?{]")
_NOT_PLAIN = re.compile(r"\(\?|\\\d")  # look-around, names, flags; back references

NEEDED = (
    f"at most {_MOST_CHARACTERS} characters, {_MOST_GROUPS} groups, and {_MOST_REPEATS} of * + ? {{}}, none of them"
    " behind a group"
)


def require_quick(pattern: str, *, where: str) -> None:
    """Refuse a regular expression that may run for ever by backtracking.

    Raises:
        InputError: It repeats a group, has too many repeats or groups, a back reference, or is no regular expression.
    """
    plain = _SET.sub("x", _ESCAPED.sub("x", pattern))  # in these, special characters are literal
    too_long = len(pattern) > _MOST_CHARACTERS or len(_REPEAT.findall(plain)) > _MOST_REPEATS
    nested = _REPEATED_GROUP.search(plain) or _NOT_PLAIN.search(pattern) or plain.count("(") > _MOST_GROUPS
    if too_long or nested:
        found = f"{pattern[:_MOST_CHARACTERS]!r}, a pattern that may take for ever"
        raise InputError(where=where, found=found, needed=NEEDED)
    try:
        re.compile(pattern)
    except (re.error, OverflowError, RecursionError) as error:
        raise InputError(where=where, found=f"{pattern!r}, no regular expression ({error})") from None
