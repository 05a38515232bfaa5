"""Encode clips, predict their future, and compare with persistence: copying the last frame that was seen.

    python examples/predict.py [DATA [MODEL]]

Without DATA, a folder of DROID's RLDS form, a few episodes of the simulated arm are recorded first.
"""

import sys
from pathlib import Path

import torch

from vjepa2_ac import UserError, encode, load_model, open_dataset, read_clips
from vjepa2_ac.simulation.record import RecordingSpec, record_dataset

RECORDED = Path("demo/examples/data")


def error(predicted: torch.Tensor, true: torch.Tensor) -> torch.Tensor:
    """Return the mean L1 error at each time: clips x time x tokens x dim -> time."""
    return (predicted - true).abs().mean(dim=(0, 2, 3)).cpu()


def main(data: str | None = None, model: str = "builtin:sim-tiny") -> None:
    """Print the errors of one step and of a rollout beside those of persistence."""
    if data is None and not RECORDED.exists():
        print("Recording 12 episodes of the simulated arm ...")
        record_dataset(RECORDED, RecordingSpec("B", steps=33, seed=4), episodes=12)
    dataset = open_dataset(data or RECORDED, frames=4, stride=4)
    world_model = load_model(model)
    seconds = dataset.config.model_stride / dataset.control_rate_hz

    rows = []
    for batch in read_clips(dataset, clips=32, batch_size=8):
        seen = encode(world_model, batch)  # latents: clips x time x tokens x dim
        first, true, states = seen.latents[:, :1], seen.latents[:, 1:], seen.states[:, :-1]
        one_step = world_model.predict(seen.latents[:, :-1], seen.actions, states)  # from the true frames
        rollout = world_model.rollout(first, seen.actions, states)  # from the first frame, predictions fed back
        guesses = (one_step, seen.latents[:, :-1], rollout, first.expand_as(true))
        rows.append(torch.stack([error(guess, true) for guess in guesses]))

    print("L1 error       one step  copy before  |  rollout  copy first  ratio")
    for step, (one, before, rolled, copied) in enumerate(torch.stack(rows).mean(dim=0).T.tolist(), start=1):
        print(f"{step * seconds:.2f} s ahead   {one:.4f}   {before:.4f}       |  ", end="")
        print(f"{rolled:.4f}   {copied:.4f}      {rolled / copied:.3f}")
    print("A ratio below 1 is better than copying the first frame.")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:3])
    except UserError as wrong:
        sys.exit(f"error: {wrong}")
