"""Every benchmark runs to its end, small: those that no other test runs."""

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from benches import imported
from browser import browser
from paths import ROOT
from vjepa2_ac.cli import main as command_line
from vjepa2_ac.config import EncoderSizes, ModelSizes, PredictorSizes
from vjepa2_ac.config.loading import load_config
from vjepa2_ac.config.planning import CemConfig, PlanningConfig

OTHERS = "\n".join(path.read_text() for path in Path(__file__).parent.glob("test_*.py"))


@pytest.mark.parametrize(
    ("name", "options", "printed"),
    [
        ("clip_bytes", "--episodes 2 --steps 70 --clips 3", "drawn"),
        ("index", "--shards 2 --in-flight 4 --latency-ms 1", "a hash's"),
        ("image_metrics", "--starts 3 --futures 3 --draws 2", "smoothed"),
        ("load_memory", "{folder}/new --small", "bfloat16"),
        ("video", "--clips 1", "ours"),
        ("encode_engines", "--episodes 4 --ways plain shares", "cores; plain 1.00x, shares"),
        ("loader", "--clips 4", "index of 2,000 episodes"),
        ("explore", "builtin:sim-tiny --rounds 1", "p95"),
        ("scaling", "--check --processes 1 2 --steps 4", "| 2 |"),
    ],
)
def test_it_runs_to_its_end(
    name: str,
    options: str,
    printed: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    if name == "explore":
        browser()
    for module in imported(name, monkeypatch):
        if name in {"video", "loader"}:
            video = sys.modules["video"]
            short = [replace(one, steps=90, height=90, width=160) for one in video.RECORDINGS]
            monkeypatch.setattr(video, "RECORDINGS", short)
        if name == "index":  # it changes these itself, for a process of its own
            for attribute in ("FEWEST_IN_FLIGHT", "_possible_copies"):
                monkeypatch.setattr(module.rlds_index, attribute, getattr(module.rlds_index, attribute))
            monkeypatch.setenv("STORAGE_EMULATOR_HOST", "")
        if name == "load_memory":
            few = ModelSizes(encoder=EncoderSizes(depth=1), predictor=PredictorSizes(depth=1))
            monkeypatch.setattr(module, "SMALL", few)
            monkeypatch.setattr(subprocess, "run", lambda words, main=module.main, **_: main(words[2:]))
        if name == "scaling":
            monkeypatch.setattr(module, "PREDICTOR", {**module.PREDICTOR, "depth": 1})
        if name == "loader":
            monkeypatch.setattr(module, "DROID_EPISODES", 2_000)
            monkeypatch.setattr(module.measure_workers, "__defaults__", (2, 2))
        module.main(options.format(folder=tmp_path).split())
    assert printed in capfd.readouterr().out


def test_two_processes_that_share_an_evaluation_find_the_same(
    whole_run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (module,) = imported("shared_evaluation", monkeypatch)
    module.main([str(whole_run), "--clips", "4", "--ranking-clips", "2", "--samples", "4", "--landscapes", "0"])
    *_, last = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"\| 2 \| [\d.]+ \| [\d.]+ \| [\d.]+e-(0[6-9]|1\d) \||\| 2 \|.* 0.0e\+00 \|", last)


def test_a_prediction_follows_from_the_config_and_from_what_was_measured(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (module,) = imported("scaling", monkeypatch)

    def predicted(*words: str) -> list[list[float]]:
        module.main(["builtin:default", "model.dtype=float32", *words])
        rows = [line for line in capsys.readouterr().out.splitlines() if re.match(r"\| \d", line)]
        return [[float(cell.strip().strip("%").replace(",", "")) for cell in row[1:-1].split("|")] for row in rows]

    usual = predicted()
    assert [row[0] for row in usual] == [2**power for power in range(10)]
    assert usual[0][8:12] == [0, 0, 100, 100], "one process waits for nobody"
    assert usual[9][5] == pytest.approx(512 * usual[0][5] * usual[9][10] / 100, rel=0.03)
    other = predicted("data.cache_dtype=int8", "adapter.rank=32", "--encoder-fps=800")
    assert other[9][6] / usual[9][6] == pytest.approx(0.5, abs=0.02), "latents have half the bytes"
    assert other[3][8] > usual[3][8], "more is summed"
    assert other[0][12] == pytest.approx(usual[0][12] / 2, abs=0.01)
    assert [module.all_reduce_s(n, [10**9], gb_s=1.0, message_us=0.0) for n in (1, 2, 4)] == [0, 4, 6], "a ring"


def test_two_trainings_at_once_are_commands_that_are_there(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Here:
        def __init__(self, words: list[str], folder: Path, _: str) -> None:
            with monkeypatch.context() as within:
                within.chdir(folder)
                if words[0] == "train":  # which takes 7 s
                    self.returncode = int(load_config(words[1], words[2:]).training.steps != 20)
                else:
                    self.returncode = command_line(words)

        def communicate(self) -> tuple[None, bytes]:
            return None, b""

    for module in imported("two_at_once", monkeypatch):
        monkeypatch.setattr(module, "_command", Here)
        assert module.main(["--spins", "shipped", "--steps", "20", "--episodes", "6", "--rounds", "1"]) == 0
    assert re.search(r"two at once +\S+ s \(\S+x\)", capsys.readouterr().out)


def test_tfds_is_asked_in_an_environment_that_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in imported("tfds_reads", monkeypatch):
        with pytest.raises(subprocess.CalledProcessError) as raised:
            module.main(["--tfds-python", sys.executable])
        assert b"tensorflow" in raised.value.stderr.encode()
        folder = raised.value.cmd[3]
        assert not Path(folder).exists()


def test_no_benchmark_is_left_out() -> None:
    scripts = {path.stem for path in (ROOT / "benchmarks").glob("*.py") if "__main__" in path.read_text()}
    assert len(scripts) > 15
    assert not {name for name in scripts if not re.search(rf"\b{name}\b", OTHERS)}


@pytest.mark.parametrize("part", ["prior", "judge", "order", "monitor", "replan"])
def test_policies_are_measured_in_every_part(
    part: str, whole_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mujoco", reason="the extra `sim` is not installed")
    run = tmp_path / "run"
    shutil.copytree(whole_run, run)
    assert command_line(["prior", str(run), "--steps", "2"]) == 0
    (module,) = imported("policies", monkeypatch)
    few = PlanningConfig(samples=12, iterations=2, cem=CemConfig(elites=2))
    loaded = module.load_to_plan

    def quick(subject: str, overrides: list[str]) -> object:
        session = loaded(subject, overrides=overrides)
        return replace(session, config=session.config.model_copy(update={"planning": few}))

    monkeypatch.setattr(module, "load_to_plan", quick)
    monkeypatch.setattr(module, "STEPS", {"reach": 1, "push": 1, "pick": 1})
    words = [part, str(run), "--episodes", "1", "--false-alarms", "0.5", "--steps", "1", "2", "3"]
    module.main([*words, "--out", str(tmp_path / "found.json")])
    rows = json.loads((tmp_path / "found.json").read_text())
    assert len(rows) == {"prior": 7, "judge": 4, "order": 1, "monitor": 5, "replan": 3}[part]
    assert all(key.startswith(f"{part} run reach A seed 7: ") for key in rows)
    capsys.readouterr()
    module.main([*words, "--out", str(tmp_path / "found.json")])  # nothing is run again
    assert len(capsys.readouterr().out.splitlines()) == len(rows)


def test_the_figures_of_policies_are_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (module,) = imported("policies_plot", monkeypatch)
    module.draw(json.loads((ROOT / "benchmarks/results/policies.json").read_text()), tmp_path / "policies.png")
    assert (tmp_path / "policies.png").read_bytes().startswith(b"\x89PNG")
