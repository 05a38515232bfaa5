"""Statistics of a data set: lengths, outcomes, idle time, and the motion of the robot per model step."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.idle import find_idle_by_motion, find_long_idle
from vjepa2_ac.data.windows import candidate_strides
from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.inspection.coverage import Coverage, ReadEpisode, coverage_findings, coverage_of_episodes, read_sample
from vjepa2_ac.inspection.findings import SPLITS, Duplicates, Finding, find_duplicates
from vjepa2_ac.spaces import rotation_angles

PERCENTILES = (10, 50, 90, 99)
MOVED, TURNED, CHANGED = "moved_cm", "turned_deg", "changed_percent_of_range"

RELEASED_STEP_CM = 12.9  # motion of the flange between the two frames of upstream's example (franka_example_traj.npz)


@dataclass(frozen=True, eq=False)
class Inspection:
    """The statistics of a data set. Motion is measured on a sample of the used episodes."""

    dataset: Dataset
    duplicates: Duplicates
    sample: tuple[ReadEpisode, ...]

    @property
    def has_poses(self) -> bool:
        """Whether the states contain a position."""
        return self.dataset.spaces.state.position is not None

    @cached_property
    def ranges(self) -> Float[np.ndarray, "state_dim 2"]:
        """Minimum and maximum of each number of the state in the sample."""
        states = np.concatenate([episode.states for episode in self.sample])
        return np.stack([states.min(axis=0), states.max(axis=0)], axis=1)

    @cached_property
    def coverage(self) -> Coverage | None:
        """Action coverage of the sample at the config's stride; None if no episode is longer than a step."""
        return coverage_of_episodes(self.sample, self.dataset.spaces.state, self.dataset.config.model_stride)

    @cached_property
    def steps(self) -> dict[int, dict[str, Float[np.ndarray, " pairs"]]]:
        """Motion per model step for each candidate stride: MOVED and TURNED for poses, CHANGED for vectors."""
        return {stride: self._measure_steps(stride) for stride in candidate_strides(self.dataset.control_rate_hz)}

    def _measure_steps(self, stride: int) -> dict[str, Float[np.ndarray, " pairs"]]:
        space = self.dataset.spaces.state
        pieces = [piece for episode in self.sample for piece in episode.changes(stride, space)]
        changes = np.concatenate([np.zeros((0, len(space))), *pieces])
        if not self.has_poses:
            return {CHANGED: compute_largest_changes(changes, self.ranges)}
        turned_deg = np.rad2deg(rotation_angles(changes[:, space.rotation]))
        return {MOVED: space.compute_display_size(changes), TURNED: turned_deg}

    @cached_property
    def values(self) -> dict[str, Any]:
        """All statistics as plain values, as in `inspect.json`."""
        config, table, rate = self.dataset.config, self.dataset.table, self.dataset.control_rate_hz
        outcomes, lengths = table.success[table.success >= 0], np.percentile(table.num_steps, [0, 10, 50, 90, 100])
        values: dict[str, Any] = {
            "path": config.path,
            "source": config.source,
            "cameras": list(config.offered_cameras),
            "control_rate_hz": rate,
            "episodes": len(table),
            "broken_episodes": len(table.problems),
            "steps": int(table.num_steps.sum()),
            "hours": float(table.num_steps.sum() / rate / 3600),
            "length_percentiles_0_10_50_90_100": lengths.astype(int).tolist(),
            "success_share": float(outcomes.mean()) if len(outcomes) else None,
            "success_known_of": len(outcomes),
            "splits": {split: self._count(split) for split in SPLITS},
            "duplicates": self.duplicates.as_dict(),
            "sampled_episodes": len(self.sample),
            "ranges": self.ranges.tolist(),
            "percentiles": list(PERCENTILES),
            "per_model_step": [
                {
                    "stride": stride,
                    "seconds": stride / rate,
                    **{name: _percentiles(size) for name, size in sizes.items()},
                }
                for stride, sizes in self.steps.items()
            ],
            "coverage": None if self.coverage is None else dict(self.coverage.metrics),
        }
        if self.has_poses:
            values["still_share"] = float(
                np.concatenate([find_idle_steps(episode.states, config) for episode in self.sample]).mean()
            )
        return values

    def _count(self, split: Split) -> dict[str, int]:
        try:
            windows = len(self.dataset.windows(split))
        except InputError:  # an empty split is a statistic here, not an error
            windows = 0
        return {"episodes": int(self.dataset.split_mask(split).sum()), "windows": windows}

    @cached_property
    def summary(self) -> dict[str, str]:
        """The statistics as lines of text, by name."""
        config, values = self.dataset.config, self.values
        hours, success = values["hours"], values["success_share"]
        duplicates = _with_status(Finding(self.duplicates.level, "duplicates", str(self.duplicates)))
        copies = ". inspect.json lists the copies" if self.duplicates.copies else ""
        duration = f"{hours:,.1f} hours" if hours >= 1 else f"{hours * 60:.1f} minutes"
        shortest, short, median, long, longest = values["length_percentiles_0_10_50_90_100"]
        splits = ", ".join(
            f"{name} {counted(size['windows'], 'clip')} in {counted(size['episodes'], 'episode')}"
            for name, size in values["splits"].items()
        )
        removals = [removal for removal in self.dataset.removed if removal.episodes or removal.steps]
        num_known = counted(values["success_known_of"], "episode")
        ranges = [f"{low:.2f} to {high:.2f}" for low, high in self.ranges]
        if self.has_poses:
            state_lines = {
                "idle": f"{100 * values['still_share']:.1f} % of the steps, by the measured motion",
                "position": f"{', '.join(f'{axis} {limits}' for axis, limits in zip('xyz', ranges, strict=False))} m",
                "gripper": f"{ranges[-1]} (0 open, 1 closed)",
            }
        else:
            widths, joined = self.dataset.widths, f", joined by {config.join_actions}" if config.join_actions else ""
            state_lines = {
                "states": f"{widths.state} numbers: {', '.join(ranges)}",
                "actions": f"{widths.action} numbers, {config.actions}{joined}",
            }
        return {
            "data set": f"{config.path} ({config.source})",
            "episodes": f"{values['episodes']:,} ({values['broken_episodes']:,} broken)",
            "steps": f"{values['steps']:,} at {values['control_rate_hz']:g} Hz ({duration})",
            "length": f"{shortest} to {longest} steps (percentiles: 10 % {short}, 50 % {median}, 90 % {long})",
            "cameras": f"{', '.join(values['cameras'])}; used: {', '.join(config.cameras)}",
            "success": "not recorded"
            if success is None
            else f"{100 * success:.1f} % of {num_known} with a recorded outcome",
            "filters": ", ".join(f"{removal.name} removes {removal}" for removal in removals) or "remove nothing",
            "splits": f"{splits}; clips of {config.frames} frames at stride {config.model_stride}",
            "duplicates": f"{duplicates}{copies}",
            "sample": f"{counted(len(self.sample), 'episode')}; the following lines are measured on this sample",
            **state_lines,
            **{finding.about: _with_status(finding) for finding in coverage_findings(self.coverage)},
        }


def inspect_dataset(dataset: Dataset, *, episodes: int = 100, progress: Progress = no_progress) -> Inspection:
    """Compute the statistics of a data set from its table, and from the states of a sample of episodes.

    Args:
        dataset: A data set whose stride is a number.
        episodes: Maximum number of episodes to read, without frames.
        progress: Called with (episodes read, total number).

    Raises:
        InputError: Episodes of the sample cannot be read, and `data.broken_episodes` does not skip them.
    """
    return Inspection(dataset, find_duplicates(dataset), tuple(read_sample(dataset, episodes, progress)))


def _with_status(finding: Finding) -> str:
    """Return the text of a finding. If the level is not ok, the text starts with it."""
    return finding.text if finding.level == "ok" else f"{finding.level}: {finding.text}"


def _percentiles(values: Float[np.ndarray, " pairs"]) -> list[float]:
    """Return the percentiles 10, 50, 90 and 99; empty without values."""
    return np.percentile(values, list(PERCENTILES)).tolist() if len(values) else []


def find_idle_steps(states: Float[np.ndarray, "steps 7"], config: DataConfig) -> Bool[np.ndarray, " steps"]:
    """Return a mask of the steps that do not move for long enough to be removed by the idle filter."""
    return find_long_idle(find_idle_by_motion(states, config.idle), config.idle)


def compute_largest_changes(
    changes: Float[np.ndarray, "steps state_dim"], ranges: Float[np.ndarray, "state_dim 2"]
) -> Float[np.ndarray, " steps"]:
    """Return the largest change of any number at each step, in percent of the range of the number."""
    spans = ranges[:, 1] - ranges[:, 0]
    return np.asarray((abs(changes) / np.where(spans > 0, spans, np.inf)).max(axis=1) * 100)


def with_numeric_stride(dataset: Dataset) -> Dataset:
    """Return the data set itself, or with the smallest candidate stride if `data.stride` is auto."""
    if dataset.config.stride != "auto":
        return dataset
    return dataset.with_stride(min(candidate_strides(dataset.control_rate_hz)))
