"""Spot machines: the files for SkyPilot and Kubernetes are valid, and their runs survive preemption."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from gcs import Gcs
from installing import install
from paths import ROOT
from ranks import Rank, free_port
from same_run import assert_equal_up_to_rounding
from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_yaml, load_config
from vjepa2_ac.runs.checkpoint import newest_checkpoint, read_state
from vjepa2_ac.runs.metrics_log import read_metrics_log
from vjepa2_ac.training.loop import train

SKYPILOT, KUBERNETES = (ROOT / f"scripts/spot_{name}.yaml" for name in ("skypilot", "kubernetes"))
REMOTE_URL, STEPS = "gs://bucket/run", 40


def read_kubernetes_job() -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Return the service, the specification of the job, and that of its pods."""
    service, job = yaml.safe_load_all(KUBERNETES.read_text())
    return service, job["spec"], job["spec"]["template"]["spec"]


def command_in_a_pod() -> list[str]:
    return [str(word) for word in read_kubernetes_job()[2]["containers"][0]["command"]]


def command_on_a_skypilot_machine(folder: Path) -> list[str]:
    """Run the script of the file with a torchrun that only records its arguments."""
    (folder / "torchrun").write_text('#!/bin/bash\nprintf "%s\\n" torchrun "$@" >words\n')
    (folder / "torchrun").chmod(0o755)
    task = yaml.safe_load(SKYPILOT.read_text())
    variables = {**task["envs"], "REMOTE": REMOTE_URL, "SKYPILOT_NUM_NODES": "2", "SKYPILOT_NODE_RANK": "1"}
    variables |= {"SKYPILOT_NUM_GPUS_PER_NODE": "4", "SKYPILOT_NODE_IPS": "10.0.0.1\n10.0.0.2"}
    environment = {**os.environ, **variables, "PATH": f"{folder}:{os.environ['PATH']}"}
    subprocess.run(["bash", "-e", "-c", task["run"]], env=environment, cwd=folder, check=True)
    return (folder / "words").read_text().splitlines()


@pytest.mark.parametrize("platform", ["kubernetes", "skypilot"])
def test_commands_of_the_files_are_valid_and_uploads_have_time(platform: str, tmp_path: Path) -> None:
    from torch.distributed.run import config_from_args, parse_args

    words = command_in_a_pod() if platform == "kubernetes" else command_on_a_skypilot_machine(tmp_path)
    options = parse_args(words[1:])
    launch, (command, config, *overrides) = config_from_args(options)[0], options.training_script_args
    assert (words[0], options.training_script, command) == ("torchrun", "vjepa2_ac.cli", "train")
    read = load_config(config if config.startswith("builtin:") else ROOT / config, overrides).checkpoint
    assert str(read.remote).startswith("gs://")
    notice_s = read_kubernetes_job()[2]["terminationGracePeriodSeconds"] if platform == "kubernetes" else 30
    assert read.remote_wait_seconds < launch.shutdown_timeout < notice_s
    assert {"SIGTERM", "SIGUSR1"} <= set(launch.signals_to_handle.split(","))
    assert launch.min_nodes == launch.max_nodes == 2
    if platform == "skypilot":
        assert (options.node_rank, launch.nproc_per_node, options.master_addr) == (1, 4, "10.0.0.1")


def test_kubernetes_schema_accepts_the_file_and_rejects_a_misspelt_key(tmp_path: Path) -> None:
    words = ["--no-deps", "--target", str(tmp_path), "kubernetes-validate==1.37.0", "importlib_resources==7.1.0"]
    install(sys.executable, *words)
    (tmp_path / "wrong.yaml").write_text(KUBERNETES.read_text().replace("backoffLimit", "backofLimit"))
    for file, message in (
        (KUBERNETES, "passed for resource job"),
        (tmp_path / "wrong.yaml", "'backofLimit' was unexp"),
    ):
        command = [sys.executable, "-m", "kubernetes_validate", "--strict", str(file)]
        environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
        process = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert (process.returncode == 0) == (file == KUBERNETES), process.stderr
        assert message in process.stdout + process.stderr


# ---- preemption ----


class Pods:
    """The two pods of the job, as processes; a pod that fails is started again in an empty folder."""

    def __init__(self, config: Path, folder: Path, chdir: Callable[[Path], None]) -> None:
        self._config, self._folder, self._chdir, self.started = str(config), folder, chdir, 0
        self._port = free_port()
        self.running = [self._start(0), self._start(1)]

    def _start(self, index: int) -> Rank:
        self.started += 1
        machine = self._folder / f"machine-{self.started}"
        machine.mkdir()
        self._chdir(machine)
        variables = {
            "torchrun": str(ROOT / "tests/support/torchrun_forked.py"), "builtin:default": self._config,
            "checkpoint.remote=gs://my-bucket/my-run": f"checkpoint.remote={REMOTE_URL}",
            "--rdzv-endpoint=vjepa2-ac-0.vjepa2-ac:29500": f"--rdzv-endpoint=127.0.0.1:{self._port}",
        }  # fmt: skip
        words = [variables.get(word, word) for word in command_in_a_pod()]
        words[1:1] = ["--local-addr=127.0.0.1", f"--node-rank={index}"]
        return Rank(words, {**os.environ, "OMP_NUM_THREADS": "1"})

    def wait_until(self, happened: Callable[[], object]) -> None:
        """Wait, and restart failed pods, as the job's controller does."""
        deadline_s = time.monotonic() + 200
        while not happened():
            assert time.monotonic() < deadline_s, [pod.read_outputs() for pod in self.running]
            for index, pod in enumerate(self.running):
                if pod.poll():
                    self.running[index] = self._start(index)
            time.sleep(0.05)

    def steps_done(self) -> int:
        rows = [row for log in self._folder.glob("machine-*/run/metrics.jsonl") for row in read_metrics_log(log)]
        return max((row["step"] for row in rows if row["kind"] == "train"), default=0)


def newest(folder: Path, machines: str) -> Path:
    """Return the newest checkpoint on any of these machines."""
    checkpoints = [newest_checkpoint(run / "checkpoints") for run in folder.glob(f"{machines}/run")]
    return max(filter(None, checkpoints), key=lambda checkpoint: checkpoint.name)


@pytest.mark.usefixtures("default_signals")
def test_run_with_a_preempted_pod_equals_an_uninterrupted_run(
    gcs: Gcs, make_config: Callable[..., Config], reporter, tmp_path: Path, monkeypatch
) -> None:
    gcs.put("bucket/other", b"1")
    changes = {"adapter__dropout": 0.0, "training__steps": STEPS, "validation__every": STEPS, "checkpoint__every": 20}
    uninterrupted_run = train(make_config(training__accumulation=2, **changes), reporter)
    config = make_config(run_dir="run", training__accumulation=1, **changes)
    (tmp_path / "config.yaml").write_text(config_as_yaml(config))
    pods = Pods(tmp_path / "config.yaml", tmp_path, monkeypatch.chdir)
    try:
        pods.wait_until(lambda: pods.steps_done() >= 2)
        os.kill(pods.running[0].pid, signal.SIGTERM)  # as Kubernetes does, to the first process alone
        pods.wait_until(lambda: all(pod.poll() == 0 for pod in pods.running))
    finally:
        for pod in pods.running:
            pod.kill()
    assert pods.started > 2
    stopped, resumed_run = newest(tmp_path, "machine-[12]"), newest(tmp_path, "machine-*").parent
    assert 2 <= read_state(stopped).step < STEPS
    assert resumed_run != stopped.parent
    assert (resumed_run / stopped.name).is_dir(), "a new machine resumed from the checkpoint of the stopped ones"
    assert_equal_up_to_rounding(uninterrupted_run, resumed_run.parent)
