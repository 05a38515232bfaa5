"""What test_processes.py starts twice: one process of a pair, which checks what both make together."""

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from clips import some_clips
from run_fixtures import set_up
from vjepa2_ac.config.loading import load_config
from vjepa2_ac.data.loader import training_loader
from vjepa2_ac.distributed import (
    all_gather_object,
    all_reduce,
    broadcast_object,
    make_accelerator,
    require_same,
    run_first_per_machine,
    run_on_first,
)
from vjepa2_ac.episode import Batch
from vjepa2_ac.errors import InputError
from vjepa2_ac.reporter import SILENT
from vjepa2_ac.training.resume import save_checkpoint
from vjepa2_ac.training.step import Run, compute_gradients, training_step


def batches(run: Run, read: list[list[int]]) -> Iterator[Batch]:
    loader = training_loader(run.dataset, seed=0, batch_size=2)
    return iter([some_clips(next(loader), chosen) for chosen in read])


def gradient_of(run: Run, read: list[list[int]]) -> tuple[object, list[torch.Tensor]]:
    run.optimizer.zero_grad(set_to_none=True)
    micro_step = compute_gradients(run, batches(run, read))
    return micro_step, [p.grad for p in run.world_model.parameters() if p.grad is not None]


def main() -> None:
    torch.set_num_threads(1)
    config = load_config(sys.argv[1])
    accelerator = make_accelerator(config)
    rank = accelerator.process_index
    assert accelerator.num_processes == 2
    assert all_reduce(accelerator, [1.5, rank], "sum") == [3.0, 1.0]
    assert all_reduce(accelerator, [rank * 15, 1 - rank], "max") == [15, 1]
    assert broadcast_object(accelerator, {"rank": rank}) == {"rank": 0}
    assert all_gather_object(accelerator, f"rank {rank}") == ["rank 0", "rank 1"]
    require_same(accelerator, "one", what="it", fix="none")
    with pytest.raises(InputError, match="in process 1 than in process 0"):
        require_same(accelerator, rank, what="it", fix="none")

    index = Path(config.run_dir).parent / "index"
    assert run_first_per_machine(accelerator, lambda: index.exists() or bool(index.write_text("made"))) or rank == 0
    assert run_on_first(accelerator, lambda: "done") == (None if rank else "done")

    run = set_up(config, SILENT, accelerator=accelerator)
    weights = run.world_model.predictor.state_dict()
    assert all(
        all(torch.equal(gathered, weight) for gathered in all_gather_object(accelerator, weight))
        for weight in weights.values()
    )
    # The second process cannot read its last micro-batch: the mean is over the five clips that came.
    pair_step, pair_gradients = gradient_of(run, [[0, 1], [0]] if rank == 0 else [[0, 1], []])
    assert pair_step.clips == 5
    pair_gradients = [gradient.clone() for gradient in pair_gradients]
    # Both read what the pair read: each clip counts twice, in the sum and in the number.
    first_step, first_gradients = gradient_of(run, [[0, 1], [0]])
    second_step, second_gradients = gradient_of(run, [[0, 1], []])
    for pair, first, second in zip(pair_gradients, first_gradients, second_gradients, strict=True):
        torch.testing.assert_close(pair, (first * 3 + second * 2) / 5, rtol=1e-4, atol=1e-7)
    expected = (first_step.forced_loss * 3 + second_step.forced_loss * 2) / 5
    assert abs(pair_step.forced_loss - expected) < 1e-6
    empty_step, empty_gradients = gradient_of(run, [[], []])
    assert empty_step.clips == 0
    assert empty_gradients == []
    uneven_step, _ = gradient_of(run, [[0, 1], [0, 1]] if rank == 0 else [[], []])
    assert uneven_step.clips == 4

    # All processes resume from a checkpoint that only the first process has on its disk.
    run.optimizer.zero_grad(set_to_none=True)
    training_step(run, batches(run, [[0, 1], [0, 1]]), step=1)
    run.state = replace(run.state, step=1, clips_done=8)
    save_checkpoint(run, Path(config.run_dir))
    own_disk = config.model_copy(update={"run_dir": config.run_dir if rank == 0 else f"{config.run_dir}-elsewhere"})
    resumed = set_up(own_disk, SILENT, accelerator=accelerator)
    assert (resumed.state.step, resumed.state.clips_done, resumed.state.run_id) == (1, 8, run.state.run_id)
    for before, after in zip(run.world_model.parameters(), resumed.world_model.parameters(), strict=True):
        assert torch.equal(before, after)
    optimizer_state, expected_state = resumed.optimizer.state_dict()["state"], run.optimizer.state_dict()["state"]
    assert optimizer_state.keys() == expected_state.keys() != set()
    assert all(
        torch.equal(value, optimizer_state[key][name])
        for key, expected_values in expected_state.items()
        for name, value in expected_values.items()
    )
    assert not Path(f"{config.run_dir}-elsewhere").exists()
    accelerator.end_training()


if __name__ == "__main__":
    main()
