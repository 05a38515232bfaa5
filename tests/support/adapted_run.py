"""The folder of a run with two checkpoints, as if a tiny model had been trained."""

from pathlib import Path

import torch

from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.episode import Widths
from vjepa2_ac.model.adapter_folder import save_trained
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.lora import add_adapter
from vjepa2_ac.model.world_model import replace_input_projections
from vjepa2_ac.runs.checkpoint import ADAPTER, RunState, write_checkpoint
from vjepa2_ac.runs.folder import CONFIG


def write_adapted_run(
    config: Config, steps: tuple[int, ...] = (10, 20), best: int = 10, *, change: float = 0.3,
    rank: float | None = None, widths: Widths | None = None,
) -> Path:  # fmt: skip
    """Write a run whose adapters change more at each checkpoint (not at all with a change of 0); return its folder."""
    folder = Path(config.run_dir)
    folder.mkdir(parents=True)
    (folder / CONFIG).write_text(config_as_yaml(config))
    model = load_base(config.model, seed=config.seed)
    if widths is not None:
        replace_input_projections(model, widths, seed=1)
    add_adapter(model, config.adapter, seed=0)
    generator = torch.Generator().manual_seed(2)
    for step in steps:
        with torch.no_grad():
            for value in model.parameters():
                if value.requires_grad:
                    value.add_(change * torch.randn(value.shape, generator=generator))
        state = RunState(step, best_step=best, best_error=0.5, best_ranking_error=rank)
        write_checkpoint(folder / "checkpoints", state, lambda path: save_trained(model, path / ADAPTER), keep=9)
    return folder
