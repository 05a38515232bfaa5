"""Untrusted YAML: read as people mean it, or refused with line and column; nothing hangs."""

import math
from typing import Any

import pytest
import yaml

from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.structured import MOST_DEPTH, parse_yaml


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("a: &a {x: 1, y: 2}\nb:\n  <<: *a\n  y: 3", {"a": {"x": 1, "y": 2}, "b": {"x": 1, "y": 3}}),
        ("a: {<<: [{x: 1}, {x: 2, y: 3}], z: 4}", {"a": {"x": 1, "y": 3, "z": 4}}),
        ("a: &a {x: 1}\nb: &b {<<: *a, x: 2}\nc: {<<: *b}", {"a": {"x": 1}, "b": {"x": 2}, "c": {"x": 2}}),
        ("'<<': 1", {"<<": 1}),
        ("a: [1e-4, 1.5e3, .5, 1_000, 0x1F, 0b11, -7, 0, 0.0]", {"a": [1e-4, 1500.0, 0.5, 1000, 31, 3, -7, 0, 0.0]}),
        ("a: [on, Off, yes, no, TRUE, false, 'on']", {"a": [True, False, True, False, True, False, "on"]}),
        ("a: [null, ~, '', 'null']\nb:", {"a": [None, None, "", "null"], "b": None}),
        ("a: [2024-01-31, 2024-13-45, 2024-01-01T99:00]", {"a": ["2024-01-31", "2024-13-45", "2024-01-01T99:00"]}),
        ("a: ['010', !!str 010, 089, 0o10, =]", {"a": ["010", "010", "089", "0o10", "="]}),
        ('a: [!!int "12", !!float 3, !!bool "yes", !!null "", !!seq []]', {"a": [12, 3.0, True, None, []]}),
        ("off: 1\n22008760: 2\n010: 3\n2024-01-01: 4", {"off": 1, "22008760": 2, "010": 3, "2024-01-01": 4}),
        ('a: "\\ud83d\\ude00 \\u00fc"', {"a": "\U0001f600 ü"}),
        ("a: |\n  two\n  lines\n", {"a": "two\nlines\n"}),
        ("", None),
    ],
)  # fmt: skip
def test_what_people_mean_is_read(text: str, value: Any) -> None:
    assert parse_yaml(text, where="") == value
    assert repr(parse_yaml(text, where="")) == repr(value)  # True is not 1


def test_numbers_that_are_none_are_read_for_the_schema_to_refuse() -> None:
    found = parse_yaml("[.inf, -.INF, .nan, 1e400]", where="")
    assert found[:2] == [math.inf, -math.inf]
    assert math.isnan(found[2])
    assert found[3] == math.inf


@pytest.mark.parametrize(
    ("text", "place", "complaint"),
    [
        ("a: 1\nrun_dir: {{ RUN }}", "line 2, column 11", "Fill in the template"),
        ("run_dir: {{ RUN }}/x", "line 1, column 19", "Fill in the template"),
        ("{% if x %}\na: 1", "line 1, column 2", "Fill in the template"),
        ("? [1, 2]\n: 3", "line 1, column 3", "a key that is a mapping or a list"),
        ("seed: 010", "line 1, column 7", "octal number. Write 10 for the number, '010' in quotes"),
        ("seed: -0_10", "line 1, column 7", "octal"),
        ("a: 1:30", "line 1, column 4", "base 60"),
        ("a: " + "9" * 5000, "line 1, column 4", "5,000 digits"),
        ("a: 0x" + "f" * 40, "line 1, column 4", "digits"),
        ('a: !!int "abc"', "line 1, column 4", "'abc', which is no !!int"),
        ("a: !!bool maybe", "line 1, column 4", "no !!bool"),
        ("a: !!binary aa==", "line 1, column 4", "the tag !!binary"),
        ("a: !!python/object:os.system x", "line 1, column 4", "the tag !!python/object:os.system"),
        ("a: !env HOME", "line 1, column 4", "the tag !env"),
        ("a: !!set {b}", "line 1, column 4", "the tag !!set"),
        ("a: 1\nb: 2\na: 3", "line 3, column 1", "key 'a' is given twice"),
        ("<<: {a: 1}\n<<: {b: 2}", "line 2, column 1", "[*one, *other]"),
        ("<<: 3", "line 1, column 5", "neither a mapping nor a list"),
        ("a: &a [1, *a]", "line 1, column 4", "an alias within what it stands for"),
        ("a: &a {<<: *a}", "line 1, column 4", "an alias within what it stands for"),
        ("a: *b", "line 1, column 4", "undefined alias"),
        ("a: [1,\nb", "line 2, column 2", "not YAML"),
        ("--- 1\n--- 2", "line 2, column 1", "another document"),
        ("a: 1\nb: \x1b[2J", "line 2", r"control character '\x1b'"),
        ('a: 1\n"\\e[2J": 1', "line 2, column 1", r"a control character in '\x1b[2J'"),
        ('a: "\\0"', "line 1, column 4", "a control character"),
        ('a: "\\ud800"', "line 1, column 4", "a control character"),
        ("[" * 20_000, "line 1", f"deeper than {MOST_DEPTH}"),
    ],
)
def test_what_people_do_not_mean_is_refused_where_it_stands(text: str, place: str, complaint: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_yaml(text, where="my.yaml")
    assert str(caught.value).startswith(f"my.yaml: {place}")
    assert complaint in str(caught.value)
    assert "tag:yaml.org" not in str(caught.value)


def laughs(link: str, times: int) -> str:
    first = f"a0: &a0 {link % ('x', 'y')}\n"
    return first + "".join(f"a{n}: &a{n} {link % (f'*a{n - 1}', f'*a{n - 1}')}\n" for n in range(1, times))


@pytest.mark.parametrize(
    "text",
    [laughs("[%s, %s]", 40), laughs("{p: %s, q: %s}", 40), laughs("{<<: [%s, %s]}", 40).replace("[x, y]", "{x: 1}")],
)
def test_aliases_that_multiply_are_counted_as_what_they_stand_for(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(text) < 2_000
    monkeypatch.setattr("vjepa2_ac.storage.structured.yaml_text.MOST_VALUES", 1_000)
    with pytest.raises(InputError, match="more than 1,000 values"):
        parse_yaml(text, where="")


def test_many_values_are_refused_before_all_are_made(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vjepa2_ac.storage.structured.yaml_text.MOST_VALUES", 1_000)
    assert len(parse_yaml("[" + "a," * 900 + "]", where="")) == 900
    monkeypatch.setattr("vjepa2_ac.storage.structured.yaml_text._Values", None)
    with pytest.raises(InputError, match="more than 1,000 values"):
        parse_yaml("[" + "a," * 1_100, where="")


def test_what_is_written_is_read_as_pyyaml_reads_it() -> None:
    values = {
        "a": [1, -2.5, 1e-05, True, None, "text", "off", "010", "1:30", "~", "", "a: b", "=", "<<"],
        "b": {"c": {}},
    }
    assert parse_yaml(yaml.safe_dump(values), where="") == values
