"""The folder of a run with two checkpoints, as if a tiny model had been trained."""

from collections.abc import Callable
from pathlib import Path

import torch

from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.model.adapter_folder import save_trained
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.lora import add_adapter
from vjepa2_ac.runs.checkpoint import ADAPTER, RunState, write_checkpoint
from vjepa2_ac.runs.folder import CONFIG


def write_adapted_run(config: Config, steps: tuple[int, ...] = (10, 20), best: int = 10) -> Path:
    """Write a run whose adapters do more at every checkpoint; return its folder."""
    folder = Path(config.run_dir)
    folder.mkdir(parents=True)
    (folder / CONFIG).write_text(config_as_yaml(config))
    model = load_base(config.model, seed=config.seed)
    add_adapter(model, config.adapter, seed=0)
    generator = torch.Generator().manual_seed(2)
    for step in steps:
        with torch.no_grad():
            for value in model.parameters():
                if value.requires_grad:
                    value.add_(0.3 * torch.randn(value.shape, generator=generator))
        state = RunState(step, best_step=best, best_error=0.5)
        write_checkpoint(folder / "checkpoints", state, _saved(model), keep=9)
    return folder


def _saved(model: torch.nn.Module) -> Callable[[Path], None]:
    return lambda folder: save_trained(model, folder / ADAPTER)  # type: ignore[arg-type]
