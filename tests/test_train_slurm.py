"""The Slurm script sets rank and address of every process, and requeues the job if the run can be resumed."""

import os
import subprocess
from pathlib import Path

import pytest

from paths import ROOT
from vjepa2_ac.config.loading import load_config

SCRIPT = ROOT / "scripts" / "train_slurm.sh"
SRUN = """#!/bin/bash
shift  # --kill-on-bad-exit=1
worst=0
for place in 0 1; do
  SLURM_PROCID=$place SLURM_LOCALID=0 "$@" || worst=$?
done
exit $worst
"""
SCONTROL = """#!/bin/bash
echo "scontrol $*" >>calls
if [[ $1 == show ]]; then printf 'node7\\nnode8\\n'; fi
"""
RUN = """#!/bin/bash
echo "$RANK of $WORLD_SIZE, GPU $LOCAL_RANK, $MASTER_ADDR:$MASTER_PORT: $*" >>calls
exit $RUN_ENDS_WITH
"""


def submit(folder: Path, run_ends_with: int, **variables: str) -> tuple[int, list[str]]:
    """Run the script as a job of two tasks, with programs that only record their arguments."""
    for name, text in {"srun": SRUN, "scontrol": SCONTROL, "vjepa2-ac": RUN}.items():
        (folder / name).write_text(text)
        (folder / name).chmod(0o755)
    job = {"SLURM_JOB_ID": "123456", "SLURM_NTASKS": "2", "SLURM_JOB_NODELIST": "node[7-8]"}
    environment = {"PATH": f"{folder}:{os.environ['PATH']}", "RUN_ENDS_WITH": str(run_ends_with), **job, **variables}
    process = subprocess.run(["bash", str(SCRIPT), "my.yaml", "seed=1"], env=environment, cwd=folder, check=False)
    calls = folder / "calls"
    return process.returncode, calls.read_text().splitlines() if calls.exists() else []


def test_every_process_receives_its_rank_and_address(tmp_path: Path) -> None:
    status, calls = submit(tmp_path, run_ends_with=0)
    assert status == 0
    assert calls == [
        "scontrol show hostnames node[7-8]",
        "0 of 2, GPU 0, node7:23456: train my.yaml seed=1",
        "1 of 2, GPU 0, node7:23456: train my.yaml seed=1",
    ]


@pytest.mark.parametrize(("ends_with", "status", "is_requeued"), [(75, 0, True), (2, 2, False), (137, 137, False)])
def test_only_a_resumable_run_is_queued_again(tmp_path, ends_with: int, status: int, is_requeued: bool) -> None:
    returncode, calls = submit(tmp_path, ends_with)
    assert returncode == status
    assert (calls[-1] == "scontrol requeue 123456") == is_requeued


def test_array_task_uses_its_grid_line_and_its_own_folder(tmp_path: Path) -> None:
    grid = tmp_path / "sweep.txt"
    grid.write_bytes((ROOT / "examples/sweeps/grid.txt").read_bytes())
    runs = set()
    for task, line in enumerate(grid.read_text().splitlines(), start=1):
        status, calls = submit(tmp_path, run_ends_with=75, GRID=str(grid), SLURM_ARRAY_TASK_ID=str(task))
        assert (status, calls[-1]) == (0, "scontrol requeue 123456"), "each task is queued again by itself"
        command, *words = calls[-2].partition(": ")[2].split()
        assert (command, words[0], words[2:-1]) == ("train", "my.yaml", line.split())
        config = load_config(ROOT / "configs/default.yaml", words[1:])
        runs.add(config.run_dir)
    assert runs == {str(tmp_path / f"sweep/{task}") for task in range(1, task + 1)}


@pytest.mark.parametrize(
    ("variables", "message"), [({}, "names the file of overrides"), ({"GRID": "sweep.txt"}, "sweep.txt has no line 2")]
)
def test_array_without_grid_or_line_starts_no_training(
    tmp_path: Path, variables: dict[str, str], message: str, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "sweep.txt").write_text("seed=1\n")
    status, calls = submit(tmp_path, run_ends_with=0, SLURM_ARRAY_TASK_ID="2", **variables)
    assert status
    assert calls == []
    assert message in capfd.readouterr().err
