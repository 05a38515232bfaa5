"""LPIPS and FVD by files that are named on the command line: in metrics.json, report and console, or null with why."""

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from metric_files import know_i3d, know_lpips, sha256_of, write_i3d, write_lpips
from run_fixtures import one_thread
from synthetic import write_synthetic_droid
from vjepa2_ac.cli import main
from vjepa2_ac.evaluation.video.record import FVD_MEANING, LPIPS_MEANING, NO_I3D, NO_LPIPS

QUICK = ["--sensitivity-clips", "0", "--examples", "0"]
DECODER = ["--decoder", "builtin:sim-tiny"]


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a config of clips of 12 frames, of 20 clips of five test episodes or more."""
    folder = tmp_path_factory.mktemp("metrics")
    data = write_synthetic_droid(folder / "set", episodes=12, steps=18, size=(36, 64))
    values = {
        "run_dir": str(folder / "run"),
        "data": {
            "path": str(data), "frames": 12, "stride": 1, "validation_share": 0.1, "test_share": 0.7, "workers": 0,
        },
        "model": {"base": "builtin:sim-tiny", "dtype": "float32"},
        "training": {"precision": "fp32", "device": "cpu"},
        "validation": {"batch_size": 8},
    }  # fmt: skip
    (folder / "config.yaml").write_text(yaml.safe_dump(values))
    return folder / "config.yaml"


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the options that name all files, which pass for the published ones."""
    lpips, i3d = write_lpips(tmp_path, "alex"), write_i3d(tmp_path)
    know_lpips(monkeypatch, "alex", lpips)
    know_i3d(monkeypatch, i3d)
    return ["--lpips", str(lpips.backbone), "--lpips-heads", str(lpips.heads), "--i3d", str(i3d)]


def evaluated(config: Path, out: Path, *options: str) -> int:
    with one_thread():
        return main(["evaluate", "builtin:sim-tiny", "--data", str(config), "--out", str(out), *QUICK, *options])


def decoded_of(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((out / "metrics.json").read_text())["decoded"]
    return found


def sources_of(found: dict[str, Any]) -> dict[str, Any]:
    return {**found["models"], **found["neighbours"]}


def test_lpips_is_there_by_horizon_and_of_few_clips_there_is_no_fvd(
    config: Path, files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert evaluated(config, out, *DECODER, "--clips", "4", *files) == 0
    found, printed = decoded_of(out), " ".join(capsys.readouterr().out.split())
    assert found["lpips"] == {"backbone": "alex", "version": "0.1", "region": "whole", "meaning": LPIPS_MEANING}
    sources = sources_of(found)
    for source in sources.values():
        for reference in ("against_truth", "against_decoded_truth"):
            assert len(source["lpips"][reference]) == 11
            assert all(one["low"] <= one["value"] <= one["high"] for one in source["lpips"][reference])
    truth = {name: source["lpips"]["against_truth"] for name, source in sources.items()}
    assert truth["decoded_truth"][0]["value"] > 0, "this decoder is not perfect"
    assert {one["value"] for one in sources["decoded_truth"]["lpips"]["against_decoded_truth"]} == {0.0}
    assert truth["raw_persistence"][10]["value"] > truth["raw_persistence"][0]["value"] > 0, "the scene moves away"
    last = truth["model"][-1]["value"]
    assert "LPIPS (alex), " in printed
    assert f"model {last:.3f}." in printed
    page = (out / "report.html").read_text()
    assert '<th scope="col">LPIPS (alex)</th></tr>' in page
    assert f"<td>{last:.3f} <span" in page
    assert LPIPS_MEANING in page
    reason = sources["model"]["fvd"]["against_truth"]["reason"]
    assert reason == "4 clips of 4 episodes; it needs 20 clips and 5 episodes"
    assert f"FVD (biased): not measured, {reason}." in printed
    assert f"FVD (biased): not measured, {reason}." in page


def test_fvd_is_of_whole_clips_and_labelled(
    config: Path, files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert evaluated(config, out, *DECODER, "--clips", "20", *files[-2:]) == 0
    found, printed = decoded_of(out), " ".join(capsys.readouterr().out.split())
    sources = sources_of(found)
    fvd = {name: source["fvd"]["against_truth"] for name, source in sources.items()}
    assert {(one["clips"], one["label"]) for one in fvd.values()} == {(20, "FVD (biased)")}
    assert fvd["model"]["value"] > fvd["decoded_truth"]["value"] > 0
    assert (fvd["raw_persistence"]["value"], fvd["raw_persistence"]["reason"]) == (None, "not measured of this one")
    assert sources["decoded_truth"]["fvd"]["against_decoded_truth"]["value"] is None
    assert sources["model"]["fvd"]["against_decoded_truth"]["value"] > 0
    assert (found["fvd"]["clips"], found["fvd"]["meaning"]) == (20, FVD_MEANING)
    assert f"FVD (biased) of 20 clips to the truth: decoded truth {fvd['decoded_truth']['value']:.1f}, " in printed
    page = (out / "report.html").read_text()
    assert f"<td>{fvd['model']['value']:.1f}</td></tr>" in page
    assert FVD_MEANING in page
    assert found["models"]["model"]["lpips"]["against_truth"][0]["reason"] == NO_LPIPS


def test_without_files_both_are_null_with_the_reason(config: Path, tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "out"
    assert evaluated(config, out, *DECODER, "--clips", "4") == 0
    found = decoded_of(out)
    assert (found["lpips"]["value"], found["lpips"]["reason"]) == (None, NO_LPIPS)
    assert (found["fvd"]["value"], found["fvd"]["reason"]) == (None, NO_I3D)
    model = found["models"]["model"]
    assert {(one["value"], one["reason"]) for one in model["lpips"]["against_truth"]} == {(None, NO_LPIPS)}
    assert (model["fvd"]["against_truth"]["value"], model["fvd"]["against_truth"]["reason"]) == (None, NO_I3D)
    printed = capsys.readouterr().out
    assert "LPIPS" not in printed
    assert "FVD" not in printed
    assert f"LPIPS: not measured, {NO_LPIPS}." in (out / "report.html").read_text()


@pytest.mark.parametrize("wrong", ["--lpips", "--lpips-heads", "--i3d"])
def test_a_wrong_or_missing_file_is_refused_before_the_data_are_opened(
    wrong: str, config: Path, files: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    def opened(*_: object, **__: object) -> None:
        pytest.fail("the data were opened")

    monkeypatch.setattr("vjepa2_ac.evaluation.evaluate_run.open_dataset", opened)
    place = files.index(wrong) + 1
    missing = [*files[:place], str(tmp_path / "none"), *files[place + 1 :]]
    assert evaluated(config, tmp_path / "out", *DECODER, *missing) == 2
    message = " ".join(capsys.readouterr().err.split())
    assert f"{wrong} {tmp_path / 'none'}: cannot be read" in message
    (tmp_path / "other").write_bytes(b"another file")
    other = [*files[:place], str(tmp_path / "other"), *files[place + 1 :]]
    assert evaluated(config, tmp_path / "out", *DECODER, *other) == 2
    message = " ".join(capsys.readouterr().err.split())
    assert f"{wrong} {tmp_path / 'other'}: a file of SHA-256 {sha256_of(tmp_path / 'other')[:16]}" in message
    assert f"Give {wrong} the path of the file whose SHA-256 begins with" in message


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--lpips", "a.pth", "--lpips-heads", "b.pth"], "--lpips --lpips-heads: no --decoder"),
        (["--i3d", "a.pt"], "--i3d: no --decoder"),
        ([*DECODER, "--lpips", "a.pth"], "--lpips: no --lpips-heads"),
        ([*DECODER, "--lpips-heads", "a.pth", "--i3d", "b.pt"], "--lpips-heads: no --lpips"),
    ],
)
def test_files_without_a_decoder_or_half_of_them_are_refused(
    options: list[str], words: str, config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluated(config, tmp_path / "out", *options) == 2
    assert words + ". needed: " in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()
