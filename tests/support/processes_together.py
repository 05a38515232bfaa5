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
    whole = training_loader(run.dataset, seed=0, batch_size=2)
    return iter([some_clips(next(whole), chosen) for chosen in read])


def gradient_of(run: Run, read: list[list[int]]) -> tuple[object, list[torch.Tensor]]:
    run.optimizer.zero_grad(set_to_none=True)
    taken = compute_gradients(run, batches(run, read))
    return taken, [p.grad for p in run.world_model.parameters() if p.grad is not None]


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
    first = run.world_model.predictor.state_dict()
    assert all(
        all(torch.equal(one, other) for one in all_gather_object(accelerator, other)) for other in first.values()
    )
    # The second process cannot read its last micro-batch: the mean is over the five clips that came.
    taken, together = gradient_of(run, [[0, 1], [0]] if rank == 0 else [[0, 1], []])
    assert taken.clips == 5
    together = [gradient.clone() for gradient in together]
    # Both read what the pair read: each clip counts twice, in the sum and in the number.
    taken_alone, alone = gradient_of(run, [[0, 1], [0]])
    taken_other, other = gradient_of(run, [[0, 1], []])
    for pair, mine, theirs in zip(together, alone, other, strict=True):
        torch.testing.assert_close(pair, (mine * 3 + theirs * 2) / 5, rtol=1e-4, atol=1e-7)
    expected = (taken_alone.forced_loss * 3 + taken_other.forced_loss * 2) / 5
    assert abs(taken.forced_loss - expected) < 1e-6
    nothing, none = gradient_of(run, [[], []])
    assert nothing.clips == 0
    assert none == []
    one_has_none, _ = gradient_of(run, [[0, 1], [0, 1]] if rank == 0 else [[], []])
    assert one_has_none.clips == 4

    # What only the first process has on its disk, all go on from.
    run.optimizer.zero_grad(set_to_none=True)
    training_step(run, batches(run, [[0, 1], [0, 1]]), step=1)
    run.state = replace(run.state, step=1, clips_done=8)
    save_checkpoint(run, Path(config.run_dir))
    own_disk = config.model_copy(update={"run_dir": config.run_dir if rank == 0 else f"{config.run_dir}-elsewhere"})
    again = set_up(own_disk, SILENT, accelerator=accelerator)
    assert (again.state.step, again.state.clips_done, again.state.run_id) == (1, 8, run.state.run_id)
    for before, after in zip(run.world_model.parameters(), again.world_model.parameters(), strict=True):
        assert torch.equal(before, after)
    moments, expected_moments = again.optimizer.state_dict()["state"], run.optimizer.state_dict()["state"]
    assert moments.keys() == expected_moments.keys() != set()
    assert all(
        torch.equal(value, moments[key][name]) for key, own in expected_moments.items() for name, value in own.items()
    )
    assert not Path(f"{config.run_dir}-elsewhere").exists()
    accelerator.end_training()


if __name__ == "__main__":
    main()
