"""Several processes: the same run as one process, with the same clips, weights up to rounding, and one stop."""

import os
import signal
from itertools import chain, islice

import pytest
from hypothesis import given
from hypothesis import strategies as st

from paths import ROOT
from ranks import Rank, finish, free_port, run_ranks, start_rank, wait_until
from run_fixtures import signalled_reporter
from same_run import assert_equal_up_to_rounding
from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.data.loader import ProcessShare, first_positions
from vjepa2_ac.errors import InputError
from vjepa2_ac.process import EXIT_STATUS, StoppedError
from vjepa2_ac.runs.checkpoint import RunState, newest_checkpoint, read_state
from vjepa2_ac.runs.metrics_log import read_metrics_log
from vjepa2_ac.training.loop import train
from vjepa2_ac.training.resume import count_micro_batches

pytestmark = pytest.mark.usefixtures("default_signals")


@pytest.fixture
def without_dropout(make_config, tmp_path):
    def make(name: str, **changes: object):
        config = make_config(run_dir=str(tmp_path / name), adapter__dropout=0.0, **changes)
        (tmp_path / f"{name}.yaml").write_text(config_as_yaml(config))
        return config

    return make


def test_two_processes_resumed_as_one_equal_a_single_process_run(without_dropout, reporter, tmp_path) -> None:
    """One rank receives a signal, both stop after the same step, and one process resumes with all clips of a step."""
    single_process_run = train(without_dropout("whole", training__steps=16, training__accumulation=4), type(reporter)())
    config = without_dropout("shared", training__steps=16, training__accumulation=2)
    port = free_port()
    ranks = [
        start_rank(["-m", "vjepa2_ac.cli", "train", str(tmp_path / "shared.yaml")], rank, 2, port) for rank in range(2)
    ]
    log = tmp_path / "shared/metrics.jsonl"
    wait_until(lambda: any(row["kind"] == "train" for row in read_metrics_log(log)), ranks)
    ranks[1].send_signal(signal.SIGUSR1)
    (out, errors), (other_out, other_errors) = finish(ranks, EXIT_STATUS)
    assert errors.startswith("SIGUSR1: stopped after step"), "the first process must report the signal"
    assert "parameters are trained" in out
    assert (other_out, other_errors) == ("", ""), "only the first process may print"
    state = read_state(newest_checkpoint(tmp_path / "shared/checkpoints"))
    assert 1 <= state.step < 16
    assert (state.num_processes, state.clips_per_step, state.clips_done) == (2, 8, 8 * state.step)
    with pytest.raises(StoppedError):
        train(config, signalled_reporter(type(reporter)(), state.step + 1, signal.SIGUSR1))
    train(config, reporter)  # resumes again with one process, and with 8 clips per step although the config now gives 4
    assert reporter.steps[0] == state.step + 2
    assert any("computes 4 micro-batches of 2" in note for note in reporter.notes)
    assert_equal_up_to_rounding(single_process_run, tmp_path / "shared")


def test_two_torchrun_nodes_equal_a_single_process_run(without_dropout, reporter, tmp_path) -> None:
    single_process_run = train(without_dropout("whole", training__accumulation=2), reporter)
    without_dropout("nodes", training__accumulation=1)
    port = free_port()
    nodes = []
    for node in range(2):
        launcher = ["--nnodes=2", f"--node-rank={node}", "--nproc-per-node=1", "--local-addr=127.0.0.1"]
        launcher += ["--rdzv-backend=c10d", f"--rdzv-endpoint=127.0.0.1:{port}", "-m", "vjepa2_ac.cli"]
        words = [str(ROOT / "tests/support/torchrun_forked.py"), *launcher, "train", str(tmp_path / "nodes.yaml")]
        nodes.append(Rank(words, {**os.environ, "OMP_NUM_THREADS": "1"}))
    finish(nodes)
    assert read_state(newest_checkpoint(tmp_path / "nodes/checkpoints")).num_processes == 2
    assert_equal_up_to_rounding(single_process_run, tmp_path / "nodes")


def test_collectives_of_a_training_step(tmp_path, without_dropout) -> None:
    """processes_together.py tests sums, gradients, broken episodes, and an empty micro-batch of one process."""
    without_dropout("pair", data__broken_episodes="skip", training__max_grad_norm=None)
    run_ranks([str(ROOT / "tests/support/processes_together.py"), str(tmp_path / "pair.yaml")])


@pytest.mark.parametrize(
    ("old_processes", "new_processes", "num_micro_batches"),
    [(1, 1, None), (1, 2, "2"), (1, 3, "1 or 2"), (2, 1, "8"), (4, 2, "8"), (2, 5, "1 or 2")],
)
def test_clips_of_a_step_do_not_depend_on_the_number_of_processes(
    make_config, reporter, old_processes: int, new_processes: int, num_micro_batches: str | None
) -> None:
    config = make_config(training__batch_size=2, training__accumulation=4)
    state = RunState(step=3, num_processes=old_processes, clips_per_step=8 * old_processes, clips_per_process=8)
    assert count_micro_batches(config, state, new_processes, reporter) * 2 == state.clips_per_step
    assert [f"computes {num_micro_batches} micro-batches of 2" in note for note in reporter.notes] == [True] * (
        num_micro_batches is not None
    )


def test_more_processes_than_micro_batches_raise(make_config, reporter) -> None:
    config = make_config(training__batch_size=2, training__accumulation=4)
    with pytest.raises(
        InputError, match=r"5 processes.*Expected at most 4 processes, because a step of this run has 8 clips"
    ):
        count_micro_batches(config, RunState(step=3, clips_per_step=8, clips_per_process=8), 5, reporter)


def test_explicit_accumulation_change_is_used(make_config, reporter) -> None:
    config = make_config(training__batch_size=2, training__accumulation=3)
    assert count_micro_batches(config, RunState(step=3, clips_per_step=8, clips_per_process=4), 2, reporter) == 6


@given(
    processes=st.integers(1, 6),
    micro_batches_per_step=st.integers(1, 9),
    batch_size=st.integers(1, 3),
    steps=st.integers(1, 3),
)
def test_every_clip_of_a_step_is_computed_by_one_process(
    processes: int, micro_batches_per_step: int, batch_size: int, steps: int
) -> None:
    """This also holds if the number of micro-batches is not a multiple of the number of processes."""
    firsts = [
        list(islice(first_positions(share, batch_size, start=5), steps * len(share.micro_batches)))
        for rank in range(processes)
        if (share := ProcessShare(rank, processes, micro_batches_per_step)).micro_batches
    ]
    assert sorted(chain(*firsts)) == list(range(5, 5 + steps * micro_batches_per_step * batch_size, batch_size))


def test_changed_clips_per_step_resume_from_clips_done(make_config, reporter) -> None:
    train(make_config(training__steps=2), reporter)
    changed = make_config(training__steps=4, training__accumulation=1)
    folder = train(changed, reporter, allow_config_change=True)
    assert read_state(newest_checkpoint(folder / "checkpoints")).clips_done == 2 * 4 + 2 * 2


def test_fp16_on_a_cpu_raises(make_config, reporter) -> None:
    with pytest.raises(InputError, match="fp16 on a CPU"):
        train(make_config(training__precision="fp16", model__dtype="bfloat16"), reporter)
