"""One process of the pair of test_sharding.py, which share a predictor; checks its own part."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import torch
from accelerate import Accelerator
from torch.distributed.fsdp import FSDPModule
from torch.distributed.tensor import DTensor

from run_fixtures import set_up
from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_dict, load_config, parse_config
from vjepa2_ac.console.training import TrainingConsole
from vjepa2_ac.distributed.launch import make_accelerator
from vjepa2_ac.reporter import SILENT
from vjepa2_ac.training import optim
from vjepa2_ac.training.loop import train
from vjepa2_ac.training.setup import Run, batches_from, encode
from vjepa2_ac.training.step import gradients, training_step


@contextmanager
def unshared() -> Iterator[None]:
    """Let a run begin as if nobody had asked for shards."""
    asked = os.environ.pop("ACCELERATE_USE_FSDP")
    try:
        yield
    finally:
        os.environ["ACCELERATE_USE_FSDP"] = asked


def changed(config: Config, **training: object) -> Config:
    values = config_as_dict(config)
    return parse_config({**values, "training": {**values["training"], **training}}, where="test")


def gradient_of(run: Run) -> tuple[float, float, dict[str, torch.Tensor]]:
    taken = gradients(run, batches_from(run))
    named = run.world_model.predictor.named_parameters()
    whole = {
        name: value.grad.full_tensor() if isinstance(value.grad, DTensor) else value.grad
        for name, value in named
        if value.grad is not None
    }
    return taken.forced_loss + taken.rollout_loss, taken.norm, whole


def check_gradients(config: Config, accelerator: Accelerator) -> None:
    """Loss, norm and gradients are those of processes that share clips only; so they are with a scaled loss."""
    shared = set_up(config, SILENT, accelerator=accelerator)
    with unshared():
        plain = set_up(config, SILENT, accelerator=accelerator)
    loss, norm, expected = gradient_of(plain)
    for scaler in (shared.scaler, torch.amp.GradScaler("cpu", init_scale=8.0)):
        shared.scaler = scaler
        shared.optimizer.zero_grad(set_to_none=True)
        same_loss, same_norm, together = gradient_of(shared)
        torch.testing.assert_close(same_loss, loss, rtol=1e-6, atol=0)
        torch.testing.assert_close(same_norm, norm, rtol=1e-5, atol=0)
        assert together.keys() == expected.keys()
        for name, gradient in expected.items():
            torch.testing.assert_close(together[name], gradient, rtol=1e-4, atol=1e-6, msg=name)


def check_parts(config: Config, accelerator: Accelerator) -> None:
    """Between steps a process holds half of each weight, gradient and moment, also after a look at the predictions."""
    run = set_up(config, SILENT, accelerator=accelerator)
    batches = batches_from(run)
    training_step(run, batches, 1)
    gradients(run, batches)
    with torch.no_grad():
        run.objective(encode(run, next(batches)))
    predictor = run.world_model.base_predictor
    assert all(isinstance(module, FSDPModule) for module in (predictor, *predictor.blocks))
    weights = list(predictor.parameters())
    moments = [value for state in run.optimizer.state.values() for value in state.values() if value.ndim]
    trained = [value.grad for value in weights if value.grad is not None]
    assert len(moments) == 2 * len(trained) > 0
    for value in (*weights, *trained, *moments):
        assert isinstance(value, DTensor)
        assert value.to_local().numel() * 2 == value.numel()
    assert not any(isinstance(value, DTensor) for value in run.world_model.encoder.parameters())


def check_fused(config: Config, accelerator: Accelerator) -> None:
    """AdamW as it is on CUDA moves the parts as it does on a CPU."""
    moved = []
    for fused in (False, True):
        with mock.patch.object(optim, "_are_on_cuda", lambda _, fused=fused: fused):
            run = set_up(config, SILENT, accelerator=accelerator)
        assert all(bool(group["fused"]) == fused for group in run.optimizer.param_groups)
        batches = batches_from(run)
        for step in (1, 2):
            training_step(run, batches, step)
        moved.append([weight.detach().full_tensor() for weight in run.world_model.base_predictor.parameters()])
    for plain, other in zip(*moved, strict=True):
        torch.testing.assert_close(other, plain, rtol=1e-4, atol=1e-6)


def main() -> None:
    torch.set_num_threads(1)
    folder = Path(sys.argv[1])
    config = load_config(folder / "shared.yaml")
    accelerator = make_accelerator(config)
    assert accelerator.num_processes == 2
    check_gradients(changed(config, precision="bf16"), make_accelerator(changed(config, precision="bf16")))
    check_gradients(changed(config, gradient_checkpointing=True, rollout_steps=1, max_grad_norm=None), accelerator)
    accelerator = make_accelerator(config)
    check_gradients(config, accelerator)
    check_parts(config, accelerator)
    check_fused(config, accelerator)
    leave, Accelerator.end_training = Accelerator.end_training, lambda _: None  # this process has more to do
    # Two steps, then two more: goes on from what was shared. Then from what one process alone has written.
    train(changed(config, steps=2), TrainingConsole(), allow_config_change=True)
    train(changed(config, steps=4), TrainingConsole(), allow_config_change=True)
    train(changed(load_config(folder / "handed_over.yaml"), steps=6), TrainingConsole(), allow_config_change=True)
    leave(accelerator)


if __name__ == "__main__":
    main()
