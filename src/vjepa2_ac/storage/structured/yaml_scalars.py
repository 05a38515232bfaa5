"""YAML scalars: number, boolean, null or text, by the rules of YAML 1.1 as in PyYAML.

Exceptions: a date is text, 1e-4 is a number, and a number that YAML reads differently from people is an error.
"""

from __future__ import annotations

import re

from vjepa2_ac.storage.structured.messages import shown

Scalar = str | int | float | bool | None

_BIGGEST = 2**64
_LONGEST = 66  # digits of such a number to base 2, and 0b
_NOTHING = frozenset({"", "~", "null", "Null", "NULL"})
_TRUTHS = {
    spelt: value
    for word, value in (("yes", True), ("no", False), ("true", True), ("false", False), ("on", True), ("off", False))
    for spelt in (word, word.capitalize(), word.upper())
}
_WHOLE = re.compile(r"[-+]?(?:0b[01_]+|0x[0-9a-fA-F_]+|[0-9][0-9_]*)")
_BASE_60 = re.compile(r"[-+]?[0-9][0-9_]*(?::[0-5]?[0-9])+(?:\.[0-9_]*)?")
_DECIMAL = re.compile(
    r"[-+]?(?:[0-9][0-9_]*\.[0-9_]*(?:[eE][-+]?[0-9]+)?|\.[0-9][0-9_]*(?:[eE][-+]?[0-9]+)?|[0-9]+[eE][-+]?[0-9]+)"
)
_NOT_FINITE = re.compile(r"[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)")
_BASES = {"0b": 2, "0x": 16}


class NotAValueError(ValueError):
    """A scalar that is not what it looks like, or what its tag says."""

    def __init__(self, found: str, fix: str) -> None:
        super().__init__(found)
        self.found, self.fix = found, fix


def plain_value(text: str) -> Scalar:
    """Return the value of a scalar without quotes.

    Raises:
        NotAValueError: It is a number that YAML reads differently from people, or out of range.
    """
    if text in _NOTHING:
        return None
    if text in _TRUTHS:
        return _TRUTHS[text]
    if _BASE_60.fullmatch(text):
        raise NotAValueError(f"{shown(text)}, which YAML takes for a number to base 60", _quoted(text))
    if _WHOLE.fullmatch(text):
        return _whole(text)
    if _DECIMAL.fullmatch(text) or _NOT_FINITE.fullmatch(text):
        return _decimal(text)
    return text


def tagged_value(tag: str, text: str) -> Scalar:
    """Return the value of a scalar with a tag, as in `!!int "3"`.

    Raises:
        NotAValueError: It is not of this type, or the type is not allowed in a config.
    """
    if tag == "str":
        return text
    if tag == "null" and text in _NOTHING:
        return None
    if tag == "bool" and text in _TRUTHS:
        return _TRUTHS[text]
    if tag == "int" and _WHOLE.fullmatch(text):
        return _whole(text)
    if tag == "float" and (_WHOLE.fullmatch(text) or _DECIMAL.fullmatch(text) or _NOT_FINITE.fullmatch(text)):
        return _decimal(text)
    if tag in {"null", "bool", "int", "float"}:
        raise NotAValueError(f"{shown(text)}, which is no !!{tag}", "Leave the tag out")
    raise NotAValueError(f"the tag !!{tag}", "Leave it out")


def _whole(text: str) -> int | str:
    digits = text.lstrip("+-").replace("_", "")
    base = _BASES.get(digits[:2], 10)
    if base == 10 and len(digits) > 1 and digits[0] == "0":
        if not re.fullmatch("[0-7]+", digits):
            return text  # 089 is no octal number: text, to YAML, too
        number = digits.lstrip("0") or "0"
        fix = f"Write {number} for the number, {text!r} in quotes for text"
        raise NotAValueError(f"{shown(text)}, which YAML takes for an octal number", fix)
    if len(digits) > _LONGEST or (size := int(digits.removeprefix("0b").removeprefix("0x") or "0", base)) >= _BIGGEST:
        raise NotAValueError(f"a whole number of {len(digits):,} digits", _quoted(text[:20]))
    return -size if text.startswith("-") else size


def _decimal(text: str) -> float:
    return float(text.replace("_", "").lower().replace(".inf", "inf").replace(".nan", "nan"))


def _quoted(text: str) -> str:
    return f"For text, put it in quotes: {text!r}"
