"""Data sets of several formats in which a recording occurs several times, under different names."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lerobot_sets import recorded, write_v30
from recordings import write_raw_droid
from synthetic import draw_frame, synthetic_episode, synthetic_states
from vjepa2_ac.simulation.droid_writer import write_droid_rlds

STEPS = 14
SIZE = (24, 32)


def write_npz(folder: Path, recordings: Sequence[int], **texts: Callable[[int], str]) -> Path:
    """Write episodes NNN.npz. Equal numbers give equal recordings; `texts` are functions of the episode's index."""
    folder.mkdir(parents=True, exist_ok=True)
    for index, number in enumerate(recordings):
        states = synthetic_states(STEPS, seed=number)
        frames = np.stack([draw_frame(state, size=SIZE) for state in states])
        text_arrays = {name: np.array(text(index)) for name, text in texts.items()}
        np.savez(folder / f"{index:03d}.npz", states=states, frames=frames, fps_hz=15.0, **text_arrays)
    return folder


def write_rlds(folder: Path, recordings: Sequence[int]) -> Path:
    """Write a data set in DROID's RLDS format. The names from the fifth episode on are longer than 127 bytes."""

    def episodes() -> list:  # type: ignore[type-arg]  # of DroidEpisode
        episodes_with_paths = []
        for index, number in enumerate(recordings):
            drawn = synthetic_episode(number, steps=STEPS, size=SIZE)
            name = f"/data/LAB{index % 2}/success/2023-01-{index + 1:02d}/{'again_' * 12 * (index > 3)}{index:04d}"
            episodes_with_paths.append(
                replace(drawn, file_path=f"{name}/trajectory.h5", recording_folderpath=f"{name}/recordings")
            )
        return episodes_with_paths

    return write_droid_rlds(folder, iter(episodes()), shards=2)


def write_lerobot(folder: Path, recordings: Sequence[int]) -> Path:
    """Write a data set in LeRobot's format v3.0."""
    return write_v30(folder, [recorded(number, STEPS, size=SIZE) for number in recordings], episodes_per_video=1)


def write_raw(folder: Path, recordings: Sequence[int]) -> Path:
    """Write a data set in DROID's raw format."""
    for index, number in enumerate(recordings):
        states = synthetic_states(STEPS, seed=number)
        frames = {"1234": [draw_frame(state, size=SIZE) for state in states]}
        write_raw_droid(folder / f"LAB/success/2023-07-{index + 1:02d}/{index:04d}", states, frames_by_serial=frames)
    return folder


WRITERS = {"npz": write_npz, "rlds": write_rlds, "lerobot": write_lerobot, "droid_raw": write_raw}
