"""Encode clips, predict their future, and compare with persistence (a copy of the last input frame).

    python examples/predict.py [DATA [MODEL]]

DATA is a folder in DROID's RLDS format. Without it, a few episodes of the simulated arm are recorded first.
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
    """Print the errors of one step and of a rollout, and those of persistence."""
    if data is None and not RECORDED.exists():
        print("Recording 12 episodes of the simulated arm ...")
        record_dataset(RECORDED, RecordingSpec("B", steps=33, seed=4), episodes=12)
    dataset = open_dataset(data or RECORDED, frames=4, stride=4)
    world_model = load_model(model)
    seconds = dataset.config.model_stride / dataset.control_rate_hz

    rows = []
    for batch in read_clips(dataset, clips=32, batch_size=8):
        encoded = encode(world_model, batch)  # latents: clips x time x tokens x dim
        first, true, states = encoded.latents[:, :1], encoded.latents[:, 1:], encoded.states[:, :-1]
        teacher_forced = world_model.predict(encoded.latents[:, :-1], encoded.actions, states)  # from the true frames
        rollout = world_model.rollout(first, encoded.actions, states)  # from the first frame, predictions fed back
        predictions = (teacher_forced, encoded.latents[:, :-1], rollout, first.expand_as(true))
        rows.append(torch.stack([error(predicted, true) for predicted in predictions]))

    print("L1 error       one step  copy last    |  rollout  copy first  ratio")
    for step, (step_error, copy_last_error, rollout_error, copy_first_error) in enumerate(
        torch.stack(rows).mean(dim=0).T.tolist(), start=1
    ):
        print(f"{step * seconds:.2f} s ahead   {step_error:.4f}   {copy_last_error:.4f}       |  ", end="")
        print(f"{rollout_error:.4f}   {copy_first_error:.4f}      {rollout_error / copy_first_error:.3f}")
    print("A ratio below 1 is better than copying the first frame.")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:3])
    except UserError as exception:
        sys.exit(f"error: {exception}")
