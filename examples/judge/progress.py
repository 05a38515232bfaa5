"""Measure the progress of each frame of the demonstrations: a column for a LeRobot set, and whether to trust it.

    python examples/judge/progress.py RUN progress.parquet [EVERY]

Progress is 1 - distance now over distance at the start, in latents, to the last frame: 0 at the start of an episode and
1 at its end. The table has a row for every EVERY-th frame (default 1) and the last. episode_index and frame_index are
LeRobot's; for other forms of data, episode_index is the position in the index of the set. Spearman's correlation with
time on held-out episodes measures how steadily progress grows.
"""

import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet
from scipy.stats import spearmanr

from vjepa2_ac import load_run
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.encoding.batch import encode_frames
from vjepa2_ac.intervals import estimate_mean
from vjepa2_ac.planning.energy import distance

AT_ONCE = 64  # frames


def main(run: str, out: str, every: str = "1") -> None:
    """Write the column, and print its monotony."""
    trained = load_run(run)
    model, config = trained.world_model, trained.config
    dataset = open_dataset(config.data)
    held_out = dataset.split_mask("validation") | dataset.split_mask("test")
    episode_index = dataset.table.locators.get("index", np.arange(len(dataset.table)))  # LeRobot's, if it has one
    rows: list[dict[str, object]] = []
    monotony: dict[str, float] = {}
    for index in np.flatnonzero(dataset.is_selected).tolist():
        name, episode = dataset.table.identity(index), dataset.source.read(index)
        last = len(episode.states) - 1
        steps = np.unique([*range(0, last, int(every)), last]).tolist()
        goal = encode_frames(model, episode.read_frames([last]), config.data.crop)[0]
        far = []
        for first in range(0, len(steps), AT_ONCE):
            frames = episode.read_frames(steps[first : first + AT_ONCE])
            far += distance(encode_frames(model, frames, config.data.crop), goal, config.planning.energy).tolist()
        progress = 1.0 - np.array(far) / max(far[0], 1e-12)
        rows += [
            {"episode_index": int(episode_index[index]), "frame_index": step, "episode": name, "progress": one}
            for step, one in zip(steps, progress.tolist(), strict=True)
        ]
        if held_out[index] and np.ptp(progress):
            monotony[name] = spearmanr(steps, progress).statistic
    pyarrow.parquet.write_table(pa.Table.from_pylist(rows), out)
    if monotony:
        found = estimate_mean(np.array(list(monotony.values())), list(monotony))
        print(f"It grows with time by Spearman's {found} on {len(monotony)} held-out episodes (1: always).")


if __name__ == "__main__":
    main(*sys.argv[1:])
