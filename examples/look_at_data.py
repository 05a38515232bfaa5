"""Inspect a data set: print its size and the contents of clips, and draw a contact sheet.

    python examples/look_at_data.py [DATA]

DATA is a folder in DROID's RLDS format. Without it, a few episodes of the simulated arm are recorded first.
"""

import sys
from pathlib import Path

from vjepa2_ac import UserError, open_dataset, read_clips
from vjepa2_ac.inspection.sheet import plot_dataset
from vjepa2_ac.inspection.statistics import inspect_dataset
from vjepa2_ac.simulation.record import RecordingSpec, record_dataset

RECORDED, SHEET = Path("demo/examples/data"), Path("demo/examples/contact_sheet.png")


def main(data: str | None = None) -> None:
    """Print the size of a data set and the contents of four clips, and draw a contact sheet."""
    if data is None and not RECORDED.exists():
        print("Recording 12 episodes of the simulated arm ...")
        record_dataset(RECORDED, RecordingSpec("B", steps=33, seed=4), episodes=12)
    dataset = open_dataset(data or RECORDED, frames=4, stride=4, validation_share=0.2, test_share=0.3)
    print(f"{len(dataset.table)} episodes, {len(dataset.windows('train'))} training clips")

    batch = next(read_clips(dataset, "train", clips=4))
    if batch.frames is not None:  # a latent cache has no frames
        print(f"frames   {tuple(batch.frames.shape)}: clips, time, height, width, RGB")
    print(f"states   {tuple(batch.states.shape)}: x, y, z (m), roll, pitch, yaw (rad), gripper (0 open, 1 closed)")
    print(f"actions  {tuple(batch.actions.shape)}: the change from each state to the next")
    for clip, start in enumerate(batch.starts):
        steps = ", ".join(f"{100 * float(action[:3].norm()):.1f}" for action in batch.actions[clip])
        print(f"  clip {clip}, from control step {start}: the hand moves by {steps} cm")

    inspection = inspect_dataset(dataset)
    SHEET.parent.mkdir(parents=True, exist_ok=True)
    x, y, z, *_ = inspection.ranges
    print(f"Hand positions: x {x[0]:.2f} to {x[1]:.2f}, y {y[0]:.2f} to {y[1]:.2f}, z {z[0]:.2f} to {z[1]:.2f} m.")
    print(f"Contact sheet: {plot_dataset(inspection, SHEET, rows=4)}")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:2])
    except UserError as error:
        sys.exit(f"error: {error}")
