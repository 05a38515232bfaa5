"""Errors: they read as sentences, and can be sent between processes."""

import pickle
import re
import shlex
import sys
from importlib.metadata import PathDistribution, version
from pathlib import Path

import pytest

import vjepa2_ac
from vjepa2_ac.errors import InputError, counted, pip_install, printable, shell_command
from vjepa2_ac.reports.metrics_json import read_metrics


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (InputError(where="a.yaml", found="nothing"), "a.yaml: nothing."),
        (
            InputError(where="a.yaml", found="3", needed="4", fix="Set it to 4"),
            "a.yaml: 3. Expected 4. Set it to 4.",
        ),
        (InputError(where="a", found="2 are wrong\n  x\n", fix="See b"), "a: 2 are wrong\n  x\nSee b."),
        (InputError(where="a", found="is it?", fix="Yes."), "a: is it? Yes."),
    ],
)
def test_message_has_location_finding_expectation_and_fix(error: InputError, message: str) -> None:
    assert str(error) == message


def test_error_is_pickled_unchanged_from_a_worker() -> None:
    error = InputError(where="a", found="b", needed="c", fix="d")
    other = pickle.loads(pickle.dumps(error))  # noqa: S301 - our own bytes
    assert (type(other), str(other), other.fix) == (InputError, str(error), "d")


def test_control_characters_are_escaped() -> None:
    error = InputError(where="run\x1b[2J", found="key '\x1b]0;title\x07' and \u202e\udc80\u2028", fix="One\nTwo")
    assert str(error) == "run\\x1b[2J: key '\\x1b]0;title\\x07' and \\u202e\\udc80\\u2028. One\nTwo."
    assert str(error).encode()  # a lone surrogate could not be written
    assert printable("å 日本\u3000ö\n") == "å 日本\u3000ö\n"


def test_long_quoted_input_is_truncated() -> None:
    error = InputError(where="w", found="begin" + "x" * 1_000_000 + "end", fix="Way out")
    assert len(str(error)) < 10_000
    assert "begin" in str(error)
    assert str(error).endswith("end. Way out.")


WHEEL = f"vjepa2_ac-{version('vjepa2-ac')}-py3-none-any.whl"


@pytest.mark.parametrize(
    ("origin", "extra", "command"),
    [
        ('{"url": "file://HERE", "dir_info": {"editable": true}}', "sim", 'pip install -c constraints.txt -e ".[sim]"'),
        ('{"url": "file://HERE", "dir_info": {"editable": true}}', "", "pip install -c constraints.txt -e ."),
        (
            '{"url": "file:///x", "dir_info": {"editable": true}}',
            "sim",
            'pip install -c /x/constraints.txt -e "/x[sim]"',
        ),
        (
            '{"url": "file:///x%20y", "dir_info": {"editable": true}}',
            "",
            "pip install -c '/x y/constraints.txt' -e '/x y'",
        ),
        ('{"url": "file:///x.whl", "archive_info": {}}', "sim", 'pip install "vjepa2-ac[sim] @ file:///x.whl"'),
        ('{"url": "file:///x", "dir_info": {}}', "sim", 'pip install "vjepa2-ac[sim] @ file:///x"'),
        ('{"url": "https://x", "vcs_info": {}}', "sim", f'pip install "./{WHEEL}[sim]"'),
        (None, "sim", f'pip install "./{WHEEL}[sim]"'),
        (None, "", f'pip install "./{WHEEL}"'),
    ],
)
def test_install_command_fits_the_installation(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, origin: str | None, extra: str, command: str
) -> None:
    monkeypatch.chdir(tmp_path)
    origin = origin and origin.replace("HERE", str(tmp_path))
    read_text = PathDistribution.read_text  # also reads the version
    monkeypatch.setattr(
        PathDistribution,
        "read_text",
        lambda self, name: origin if name == "direct_url.json" else read_text(self, name),
    )
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent))
    assert pip_install(extra) == command
    monkeypatch.setenv("PATH", str(tmp_path))  # this environment is not activated
    assert pip_install(extra) == f"{sys.executable} -m {command}"


def test_printed_command_quotes_special_characters(tmp_path: Path) -> None:
    assert shell_command("evaluate", "runs/own") == "vjepa2-ac evaluate runs/own"
    odd = tmp_path / "e ü#50% [a]=b;'$(x)"
    words = ["vjepa2-ac", "train", str(odd), "--resume", f"run_dir={odd}"]
    assert shlex.split(shell_command("train", odd, "--resume", f"run_dir={odd}")) == words
    with pytest.raises(InputError) as caught:
        read_metrics(odd)
    assert shlex.split(str(caught.value).split("`")[1]) == ["vjepa2-ac", "evaluate", str(odd)]


def test_printed_commands_quote_paths() -> None:
    package = Path(vjepa2_ac.__file__).parent
    allowed = {"data converter {name}", "download {one.name}", "download {model.name}"}  # names of this package
    commands = [
        f"{path.relative_to(package)}: {command}"
        for path in package.rglob("*.py")
        for command in re.findall(r"vjepa2-ac ([a-z]+ [^`\"\n]*?\{[^}]*\})", path.read_text())
    ]
    assert [entry for entry in commands if entry.partition(": ")[2] not in allowed] == []


@pytest.mark.parametrize(
    ("number", "noun", "text"),
    [
        (0, "episode", "0 episodes"), (1, "held-out episode", "1 held-out episode"), (1200, "step", "1,200 steps"),
        (1, "process", "1 process"), (2, "process", "2 processes"), (2, "batch", "2 batches"),
    ],
)  # fmt: skip
def test_counted_noun_is_plural_if_needed(number: int, noun: str, text: str) -> None:
    assert counted(number, noun) == text
