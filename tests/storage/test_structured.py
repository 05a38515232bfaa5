"""JSON and YAML: parsed as intended or rejected with the position, without execution or unlimited growth."""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import pytest
import yaml
from pydantic import Field

from gcs import Gcs
from paths import ROOT
from vjepa2_ac.errors import InputError, MissingFileError
from vjepa2_ac.storage.structured import format_json, parse_json_object, parse_record, parse_yaml, read_json_object

# ---- JSON ----


@pytest.mark.parametrize(
    "text", ["[" * 200_000, '{"a": 1} {}', "", "[1]", "null", b"\xff\xfe\x00", '{"a": ' + "9" * 5000 + "}"]
)
def test_invalid_json_object_raises_with_the_file(text: str | bytes) -> None:
    with pytest.raises(InputError, match=r"^x\.json: .*JSON.*Expected a card\. Copy it again\.") as caught:
        parse_json_object(text, where="x.json", needed="a card", fix="Copy it again")
    assert len(str(caught.value)) < 400


def test_reads_are_bounded_and_missing_json_file_raises(tmp_path: Path, gcs: Gcs) -> None:
    (tmp_path / "a.json").write_text('{"a": "' + "x" * 100 + '"}')
    assert read_json_object(tmp_path / "a.json", max_bytes=200)
    with pytest.raises(InputError, match=r"too large.*at most 50 bytes"):
        read_json_object(tmp_path / "a.json", max_bytes=50)
    for path in (tmp_path / "none.json", gcs.put("bucket/a.json", b"{}").replace("a.", "none.")):
        with pytest.raises(MissingFileError, match=r"none\.json: cannot be read: No such"):
            read_json_object(path)
    with pytest.raises(InputError, match="Is a directory"):
        read_json_object(tmp_path)


def test_lists_of_numbers_are_written_on_one_line() -> None:
    value = {"a": [1, 2.5, None], "b": [[1e-5, -2], ["text, 1"]]}
    assert format_json({"a": [1, 2.5, None]}) == '{\n "a": [1, 2.5, null]\n}\n'
    assert json.loads(format_json(value)) == value
    with pytest.raises(ValueError, match="JSON"):
        format_json(math.nan)


# ---- records ----


@dataclass(frozen=True)
class Sample:
    step: Annotated[int, Field(ge=0)]
    name: str = ""
    error: float | None = None
    reasons: Mapping[str, str] = field(default_factory=dict)
    names: tuple[str, ...] = ()


def test_record_is_parsed_from_plain_values() -> None:
    values = {"step": 3, "error": 1, "reasons": {"a": "b"}, "names": ["x"]}
    assert parse_record(Sample, values, where="") == Sample(3, "", 1.0, {"a": "b"}, ("x",))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, "step: missing"),
        ({"step": "3"}, "step: Input should be a valid integer (found '3')"),
        ({"step": -1}, "step: Input should be greater than or equal to 0 (found -1)"),
        ({"step": 1, "reasons": {"a": 1}}, "reasons.a: Input should be a valid string (found 1)"),
        ({"step": 1, "names": "ab"}, "names: Input should be a list (found 'ab')"),
        ({"step": 1, "steps": 2}, "steps: unknown"),
        ({f"k{n}": 1 for n in range(1000)}, "; and 996 more"),
    ],
)
def test_values_of_wrong_types_raise_with_their_names(values: dict[str, object], message: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_record(Sample, values, where="state.json")
    assert message in str(caught.value)
    assert len(str(caught.value)) < 500


# ---- YAML ----


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("a: [1e-4, 1.5e3, .5, 1_000, 0x1F, 0b11, -7, 0, 0.0]", {"a": [1e-4, 1500.0, 0.5, 1000, 31, 3, -7, 0, 0.0]}),
        ("a: [on, Off, yes, no, TRUE, false, 'on']", {"a": [True, False, True, False, True, False, "on"]}),
        ("a: [null, ~, '', 'null']\nb:", {"a": [None, None, "", "null"], "b": None}),
        ("a: [2024-01-31, 017, 12:30, 089, 0o10, =]", {"a": ["2024-01-31", "017", "12:30", "089", "0o10", "="]}),
        ("off: 1\n22008760: 2\n010: 3\n2024-01-01: 4", {"off": 1, "22008760": 2, "010": 3, "2024-01-01": 4}),
        ("a: [.inf, -.INF, 1e400]", {"a": [math.inf, -math.inf, math.inf]}),
        ("", None),
    ],
)
def test_yaml_numbers_and_dates_are_read_as_intended(text: str, value: Any) -> None:
    assert parse_yaml(text, where="") == value
    assert repr(parse_yaml(text, where="")) == repr(value)  # distinguishes True from 1


def test_configs_are_read_as_pyyaml_reads_them() -> None:
    values = {"a": [1, -2.5, 1e-05, True, None, "text", "off", "010", "1:30", "~", "", "a: b", "=", "<<"], "b": {}}
    assert parse_yaml(yaml.safe_dump(values), where="") == values
    for path in (ROOT / "configs").glob("*.yaml"):
        text = path.read_text()
        assert parse_yaml(text, where="") == yaml.safe_load(re.sub(r"(?<![\d.])(\d+)e-", r"\1.0e-", text))


@pytest.mark.parametrize(
    ("text", "position", "message"),
    [
        ("a: 1\nb: 2\na: 3", ": line 3, column 1", "duplicate key 'a'"),
        ("a: &x [1, 2]\nb: [*x, *x]", ": line 2, column 5", "an alias"),
        ("a: &a [1, *a]", ": line 1, column 11", "an alias"),
        ("seed: 1\nrun: {{ RUN }}\n", ": line 2, column 7", "replace template placeholders"),
        ("a: !!python/object:os.system x", ": line 1, column 4", "os.system"),
        ("a: !env HOME", ": line 1, column 4", "!env"),
        ("a: [1,\nb", ": line 2, column 2", "invalid YAML"),
        ("a: \x1b[2J", "", "special characters"),
        ("[" * 20_000, "", "recursion"),
        ("a: " + "9" * 5000, "", "digits"),
    ],
)
def test_invalid_yaml_raises_with_line_and_column(text: str, position: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_yaml(text, where="my.yaml")
    assert str(caught.value).startswith(f"my.yaml{position}: invalid YAML")
    assert message in str(caught.value)
