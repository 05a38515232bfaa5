"""Measure the progress of each frame of demonstrations, as a column for a LeRobot data set, and its reliability.

    python examples/judge/progress.py RUN progress.parquet [EVERY]

Progress is 1 - d / d0, where d is the latent distance of a frame to the last frame and d0 that of the first frame. It
is 0 at the start of an episode and 1 at its end. The table has a row for every EVERY-th frame (default 1) and the
last. episode_index and frame_index are LeRobot's; for other formats, episode_index is the position in the data set's
index. Spearman's correlation with time on held-out episodes measures how steadily progress grows.
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

BATCH_SIZE = 64  # frames


def main(run: str, out: str, every: str = "1") -> None:
    """Write the table, and print the correlation of progress with time."""
    trained = load_run(run)
    model, config = trained.world_model, trained.config
    dataset = open_dataset(config.data)
    is_held_out = dataset.split_mask("validation") | dataset.split_mask("test")
    episode_index = dataset.table.locators.get(
        "index", np.arange(len(dataset.table))
    )  # LeRobot's episode_index, if the data have it
    rows: list[dict[str, object]] = []
    correlations: dict[str, float] = {}
    for index in np.flatnonzero(dataset.is_selected).tolist():
        name, episode = dataset.table.identity(index), dataset.source.read(index)
        last = len(episode.states) - 1
        steps = np.unique([*range(0, last, int(every)), last]).tolist()
        goal = encode_frames(model, episode.read_frames([last]), config.data.crop)[0]
        distances = []
        for first in range(0, len(steps), BATCH_SIZE):
            frames = episode.read_frames(steps[first : first + BATCH_SIZE])
            distances += distance(encode_frames(model, frames, config.data.crop), goal, config.planning.energy).tolist()
        progress = 1.0 - np.array(distances) / max(distances[0], 1e-12)
        rows += [
            {"episode_index": int(episode_index[index]), "frame_index": step, "episode": name, "progress": value}
            for step, value in zip(steps, progress.tolist(), strict=True)
        ]
        if is_held_out[index] and np.ptp(progress):
            correlations[name] = spearmanr(steps, progress).statistic
    pyarrow.parquet.write_table(pa.Table.from_pylist(rows), out)
    if correlations:
        correlation = estimate_mean(np.array(list(correlations.values())), list(correlations))
        count = f"{len(correlations)} held-out episodes"
        print(f"Spearman correlation of progress with time: {correlation} on {count} (1 is best).")


if __name__ == "__main__":
    main(*sys.argv[1:])
