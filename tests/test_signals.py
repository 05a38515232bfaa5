"""Stop signals: the first stops a run with a checkpoint, the second ends it immediately."""

import os
import signal
import subprocess
import sys
import threading

import psutil
import pytest

from ranks import Rank, wait_until
from run_fixtures import signalled_reporter
from same_run import assert_same_run
from vjepa2_ac import process as signals
from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.errors import UnreachableError
from vjepa2_ac.process import EXIT_STATUS, SIGNALS, StoppedError, stop_on_signals
from vjepa2_ac.runs.checkpoint import newest_checkpoint, read_state
from vjepa2_ac.runs.metrics_log import read_metrics_log
from vjepa2_ac.training.loop import train
from vjepa2_ac.training.step import iterate_batches

WAITING = """
import time
from vjepa2_ac import process
process.SAME_WITHIN_S = 0.0
with process.stop_on_signals() as stop:
    print(stop.reason, flush=True)
    while stop.reason is None:
        time.sleep(0.01)
    print(stop.reason, flush=True)
    while True:
        time.sleep(0.01)
"""


pytestmark = pytest.mark.usefixtures("default_signals")


@pytest.mark.parametrize(("number", "at"), [(signal.SIGTERM, 3), (signal.SIGINT, 1)])
def test_resume_after_a_stop_signal_is_exact(make_config, reporter, tmp_path, whole_run, number, at) -> None:
    config = make_config(run_dir=str(tmp_path / "stopped"), checkpoint__keep_best=False)
    with pytest.raises(StoppedError, match=f"{signal.Signals(number).name}: stopped after step {at}"):
        train(config, signalled_reporter(type(reporter)(), at, number))
    assert read_state(newest_checkpoint(tmp_path / "stopped/checkpoints")).step == at
    train(config, reporter)
    assert reporter.steps[0] == at + 1
    assert_same_run(whole_run, tmp_path / "stopped")


def test_run_under_nohup_ignores_sighup(make_config, reporter, tmp_path, whole_run) -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    train(make_config(run_dir=str(tmp_path / "run")), signalled_reporter(reporter, 3, signal.SIGHUP))
    assert_same_run(whole_run, tmp_path / "run")


def test_signal_to_the_process_group_stops_run_and_workers_cleanly(make_config, reporter, tmp_path) -> None:
    changes = {"training__steps": 40, "validation__every": 40, "checkpoint__every": 40, "data__workers": 2}
    config = make_config(run_dir=str(tmp_path / "stopped"), **changes)
    (tmp_path / "config.yaml").write_text(config_as_yaml(config))
    process = Rank(["-m", "vjepa2_ac.cli", "train", str(tmp_path / "config.yaml")], dict(os.environ))
    log = tmp_path / "stopped/metrics.jsonl"
    wait_until(lambda: any(row["kind"] == "train" for row in read_metrics_log(log)), [process])
    family = psutil.Process(process.pid).children(recursive=True)
    assert len(family) >= 3, "a fork server and two workers"
    os.killpg(process.pid, signal.SIGUSR1)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == EXIT_STATUS, errors
    assert errors.splitlines()[-1].startswith("SIGUSR1: stopped after step"), errors
    assert len([line for line in errors.splitlines() if "so far" not in line]) == 1, (
        errors
    )  # slow machines report waits
    assert not psutil.wait_procs(family, timeout=120)[1], "a worker stayed"
    train(config, reporter)
    assert 1 < reporter.steps[0] < 40
    train(make_config(run_dir=str(tmp_path / "whole"), **{**changes, "data__workers": 0}), reporter)
    assert_same_run(tmp_path / "whole", tmp_path / "stopped")


@pytest.mark.parametrize("number", SIGNALS)
def test_second_signal_ends_the_process_immediately(popen, number: int) -> None:
    process = popen([sys.executable, "-c", WAITING], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "None\n"
    process.send_signal(number)
    assert process.stdout.readline() == f"{signal.Signals(number).name}\n"
    process.send_signal(number)
    assert process.wait(timeout=120) == -number


def test_repeated_signal_within_half_a_second_counts_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signals, "SAME_WITHIN_S", 60.0)
    with stop_on_signals() as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.reason == "SIGTERM"


def test_repeated_sighup_requests_one_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signals, "SAME_WITHIN_S", 0.0)
    with stop_on_signals() as stop:
        for _ in range(3):
            os.kill(os.getpid(), signal.SIGHUP)
        assert stop.reason == "SIGHUP"


def test_signal_handlers_are_restored() -> None:
    def mine(number: int, frame: object) -> None: ...

    signal.signal(signal.SIGTERM, mine)
    signal.signal(signal.SIGUSR1, signal.SIG_IGN)
    with stop_on_signals():
        assert signal.getsignal(signal.SIGTERM) is not mine
        assert signal.getsignal(signal.SIGUSR1) is signal.SIG_IGN, "the process was started to ignore it"
    assert signal.getsignal(signal.SIGTERM) is mine
    assert signal.getsignal(signal.SIGINT) is signal.SIG_DFL


def test_signal_handlers_are_unchanged_outside_the_main_thread() -> None:
    before = signal.getsignal(signal.SIGTERM)
    observed = []

    def run() -> None:
        with stop_on_signals() as stop:
            observed.extend([stop.reason, signal.getsignal(signal.SIGTERM)])

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert observed == [None, before]


def test_signal_while_data_is_unreachable_stops_before_the_step(
    make_config, reporter, tmp_path, whole_run, monkeypatch
) -> None:
    """The resumed run equals an uninterrupted one: micro-batches of the unfinished step are discarded."""

    def stalling(run):
        for number, batch in enumerate(iterate_batches(run)):
            if number == 5:  # the second of two micro-batches of step 3
                os.kill(os.getpid(), signal.SIGTERM)
                raise UnreachableError(where="data", found="no batch arrived after SIGTERM")
            yield batch

    config = make_config(run_dir=str(tmp_path / "stopped"), checkpoint__keep_best=False)
    with monkeypatch.context() as patch:
        patch.setattr("vjepa2_ac.training.loop.iterate_batches", stalling)
        with pytest.raises(StoppedError, match="SIGTERM: stopped after step 2"):
            train(config, type(reporter)())
    assert read_state(newest_checkpoint(tmp_path / "stopped/checkpoints")).step == 2
    train(config, reporter)
    assert reporter.steps[0] == 3
    assert_same_run(whole_run, tmp_path / "stopped")
