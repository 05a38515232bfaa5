"""A process that is killed or fails ends all others, and the run resumes on any number of processes."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from paths import ROOT
from ranks import Rank, finish, free_port, run_ranks, start_rank, wait_until
from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.distributed import make_accelerator
from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.checkpoint import newest_checkpoint, read_state
from vjepa2_ac.runs.metrics_log import read_metrics_log

pytestmark = pytest.mark.usefixtures("default_signals")
NUM_KILLS = int(os.environ.get("VJEPA2_AC_SOAK", "1"))  # 20 before a release
TRAIN_COMMAND = "-m", "vjepa2_ac.cli", "train"
STORE = "TORCH_DISABLE_SHARE_RDZV_TCP_STORE"
SCRIPT = str(ROOT / "tests/support/disagreeing_ranks.py")


@pytest.fixture
def endless(make_config, tmp_path: Path):
    """Write a config of a run that does not end during a test, with 4 micro-batches for 4 processes."""
    changes = {"training__steps": 100_000, "training__batch_size": 1, "training__accumulation": 1}
    config = make_config(**changes, adapter__dropout=0.0, checkpoint__every=1, validation__every=1000)
    (tmp_path / "config.yaml").write_text(config_as_yaml(config))
    return config


def started(config: object, processes: int) -> list[Rank]:
    """Start processes, and wait until they have completed a step."""
    run, port = Path(config.run_dir), free_port()
    before = len(steps_of(run))
    path = str(run.parent / "config.yaml")
    ranks = [start_rank([*TRAIN_COMMAND, path], rank, processes, port) for rank in range(processes)]
    wait_until(lambda: len(steps_of(run)) > before, ranks, timeout_s=600)
    return ranks


def steps_of(run: Path) -> list[int]:
    rows = read_metrics_log(run / "metrics.jsonl") if (run / "metrics.jsonl").exists() else []
    return [row["step"] for row in rows if row["kind"] == "train"]


def errors_of(ranks: list[Rank]) -> list[str]:
    """Return the error output of processes that have ended."""
    return [rank.communicate(timeout=600)[1] for rank in ranks]


def test_killed_process_ends_all_and_fewer_processes_resume(endless) -> None:
    """After 4 processes, 3 resume, one with two micro-batches per step; then 4 again, with the same clips."""
    rng, run = np.random.default_rng(0), Path(endless.run_dir)
    for kill in range(NUM_KILLS):
        ranks = started(endless, 4 - kill % 2)
        victim = rng.integers(len(ranks))
        time.sleep(rng.uniform(0.0, 1.0))
        ranks[victim].kill()
        survivors = [rank for rank in ranks if rank is not ranks[victim]]
        for output in errors_of(survivors):
            assert "another process of this run" in output
            assert "to resume from the newest checkpoint" in output
        assert {rank.returncode for rank in survivors} == {2}
    resumed = started(endless, 3 + NUM_KILLS % 2)
    resumed[-1].send_signal(signal.SIGUSR1)
    finish(resumed, 75, timeout=300)
    state = read_state(newest_checkpoint(run / "checkpoints"))
    assert (state.clips_per_step, state.clips_done) == (4, 4 * state.step)


def test_restarts_with_a_shared_store_raise(make_config, monkeypatch: pytest.MonkeyPatch) -> None:
    """Restarted processes would wait for processes that have ended."""
    monkeypatch.setenv("TORCHELASTIC_USE_AGENT_STORE", "True")
    monkeypatch.setenv("TORCHELASTIC_MAX_RESTARTS", "3")
    with pytest.raises(InputError, match=f"{STORE}=1"):
        make_accelerator(make_config())


def test_relaunched_processes_resume(make_config, tmp_path: Path, popen) -> None:
    path, run = tmp_path / "config.yaml", tmp_path / "run"
    path.write_text(config_as_yaml(make_config(checkpoint__every=1)))
    launcher = ["--nproc-per-node=2", "--max-restarts=1", "--rdzv-backend=c10d", "--rdzv-endpoint=127.0.0.1:0"]
    words = [sys.executable, "-m", "torch.distributed.run", *launcher, SCRIPT, str(path), "one_is_killed_once"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    started = popen(words, env={**environment, STORE: "1"}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    output, _ = started.communicate(timeout=300)
    assert started.returncode == 0, output
    assert steps_of(run) == [1, 2, 3, 4, 5, 6]
    assert read_state(newest_checkpoint(run / "checkpoints")).num_processes == 2


def test_unexpected_error_of_one_process_ends_all_with_one_error(make_config, tmp_path: Path) -> None:
    """After a bug in a single process, the other process does not wait for it."""
    path = tmp_path / "config.yaml"
    path.write_text(config_as_yaml(make_config(training__accumulation=1)))
    (first, _), (second, _) = run_ranks([SCRIPT, str(path), "one_has_a_bug"], status=3)
    assert second == "ValueError: a bug\n"
    assert first.startswith("UnreachableError: another process of this run: ")
