"""Patterns that may run for ever are refused; records match their annotations."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import pytest
from pydantic import Field

from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.structured import record_of, require_quick, require_shallow


@pytest.mark.parametrize(
    "pattern",
    [
        "(a+)+$", "(a|a)*b", "((a*)*)*", r"(\w+\s?)*x", "(.*)(.*)(.*)", ".*.*.*x", "a?" * 30 + "a" * 30, r"(a)\1",
        "(?=a)b", "(.|.)" * 20, r"\[(a+)+]", "[](a+)+", "x" * 101, "(a+){2,}", "(a", "[z-a]", "*", "a{99999999999}",
    ],
)  # fmt: skip
def test_a_pattern_that_may_take_for_ever_or_is_none_is_refused(pattern: str) -> None:
    with pytest.raises(InputError, match=r"^here: "):
        require_quick(pattern, where="here")


@pytest.mark.parametrize(
    "pattern",
    ["fc1", "blocks.0.attn.q", r"blocks\.(0|1|2)\.attn\.(q|k)", r"blocks\.\d+\.mlp\..*", "[+*(]", r"\(a\)+", "1[0-9]"],
)
def test_patterns_of_layers_are_taken(pattern: str) -> None:
    require_quick(pattern, where="")


@dataclass(frozen=True)
class Sample:
    step: Annotated[int, Field(ge=0)]
    name: str = ""
    error: float | None = None
    reasons: Mapping[str, str] = field(default_factory=dict)
    names: tuple[str, ...] = ()


def test_a_record_is_made_of_plain_values() -> None:
    values = {"step": 3, "error": 1, "reasons": {"a": "b"}, "names": ["x"]}
    assert record_of(Sample, values, where="") == Sample(3, "", 1.0, {"a": "b"}, ("x",))


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        ({}, "step: missing"),
        ({"step": "3"}, "step: Input should be a valid integer (found '3')"),
        ({"step": True}, "step: Input should be a valid integer (found True)"),
        ({"step": 1.5}, "step: "),
        ({"step": -1}, "step: Input should be greater than or equal to 0 (found -1)"),
        ({"step": 1, "reasons": []}, "reasons: Input should be a mapping"),
        ({"step": 1, "reasons": {"a": 1}}, "reasons.a: Input should be a valid string (found 1)"),
        ({"step": 1, "names": "ab"}, "names: Input should be a list (found 'ab')"),
        ({"step": 1, "steps": 2}, "steps: unknown"),
        ({f"k{n}": 1 for n in range(1000)}, "; and 996 more"),
    ],
)
def test_values_of_other_types_are_refused_by_name(values: dict[str, object], complaint: str) -> None:
    with pytest.raises(InputError) as caught:
        record_of(Sample, values, where="state.json")
    assert complaint in str(caught.value)
    assert len(str(caught.value)) < 500


def test_values_that_lie_too_deep_are_refused_without_going_down() -> None:
    deep: list[object] = []
    for _ in range(100_000):
        deep = [deep]
    with pytest.raises(InputError, match="too deep"):
        require_shallow(deep, where="x")
