"""Untrusted JSON: read within bounds, or refused with its file: no traceback, flood or wait."""

import json
import os
from pathlib import Path
from typing import Any

import pytest

from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.structured import MOST_DEPTH, json_list, json_object, read_json_object


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[" * 20_000 + "]" * 20_000, "too deep"),
        ('{"a":' * (MOST_DEPTH + 1) + "1" + "}" * (MOST_DEPTH + 1), "too deep"),
        ('{"a": 1, "a": 2}', "the key 'a' is given twice"),
        ('{"a": NaN}', "NaN"),
        ('{"a": -Infinity}', "Infinity"),
        ('{"a": 1e400}', "beyond all bounds"),
        ('{"a": ' + "9" * 5000 + "}", "5,000 digits"),
        ('{"a": "\\ud800"}', "not JSON"),
        ('{"a\\u0000b": 1}', "zero character"),
        ('{"a": 1} {}', "not JSON"),
        ("{'a': 1}", "not JSON"),
        ("", "not JSON"),
        ("[1]", "a JSON list"),
        ("null", "a JSON null"),
        ("true", "a JSON truth value"),
        (b"\xff\xfe\x00", "not JSON"),
        (b'{"a": "\xc3\x28"}', "not JSON"),
    ],
)
def test_what_is_no_object_within_the_bounds_is_refused(text: str | bytes, complaint: str) -> None:
    with pytest.raises(InputError) as caught:
        json_object(text, where="x.json", needed="a card", fix="Copy it again")
    assert complaint in str(caught.value)
    assert caught.value.where == "x.json"
    assert caught.value.fix in {"Copy it again", ""}


@pytest.mark.parametrize(
    "value",
    [{}, {"a": [1, -2, 3.5, 1e-300, None, True, "ü\U0001f600\\u0000"]}, {"n": 2**63, "m": -(2**63)}, {"": {"": []}}],
)
def test_what_python_writes_is_read_as_it_was(value: dict[str, Any]) -> None:
    for text in (json.dumps(value), json.dumps(value, ensure_ascii=False), json.dumps(value).encode("utf-8-sig")):
        assert json_object(text, where="") == value
    assert json_list(json.dumps([value]).encode("utf-16"), where="") == [value]


def test_values_as_deep_as_they_may_lie_are_read() -> None:
    assert json_object('{"a":' * MOST_DEPTH + "1" + "}" * MOST_DEPTH, where="")


def test_nan_is_read_where_the_reader_expects_it() -> None:
    found = json_object('{"a": [NaN, Infinity, 1e400]}', where="", allow_nan=True)
    assert str(found) == "{'a': [nan, inf, inf]}"


def test_no_more_of_a_file_is_read_than_its_reader_wants(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text('{"a": "' + "x" * 100 + '"}')
    assert read_json_object(path, most_bytes=200)
    with pytest.raises(InputError, match="more than 50 bytes"):
        read_json_object(path, most_bytes=50)
    with path.open("r+b") as file:
        file.truncate(1 << 40)  # a sparse terabyte
    with pytest.raises(InputError, match="more than"):
        read_json_object(path)


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.json")
    with pytest.raises(InputError, match="a pipe"):
        read_json_object(tmp_path / "pipe.json")


def test_what_the_system_has_against_a_file_stays_its_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_json_object(tmp_path / "nowhere.json")
    with pytest.raises(IsADirectoryError):
        read_json_object(tmp_path)
