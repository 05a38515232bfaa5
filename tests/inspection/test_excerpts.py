"""Faults of frames and states are found without a model, and give no warning if there are none."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from clips import dataset_in_memory
from latent_sets import write_cache
from memory_source import MemorySource
from moving_arms import STEPS, spot_excerpt, spot_frames, spot_states, write_spots
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.index import StepSelection
from vjepa2_ac.inspection.check import check_data
from vjepa2_ac.inspection.excerpts import excerpt_findings, read_excerpts
from vjepa2_ac.inspection.findings import Finding
from vjepa2_ac.spaces import POSE, StateSpace, make_vector_states

Pair = tuple[np.ndarray, np.ndarray]
Fault = Callable[[list[Pair]], list[Pair]]

EPISODES = 12


def recorded(seed: int = 0, episodes: int = EPISODES, steps: int = STEPS) -> list[Pair]:
    motions = [spot_states(1000 * seed + number, steps) for number in range(episodes)]
    return [(states, spot_frames(states)) for states in motions]


def change_all(fault: Callable[[np.ndarray, np.ndarray], Pair]) -> Fault:
    return lambda pairs: [fault(states, frames) for states, frames in pairs]


def stale(states: np.ndarray) -> np.ndarray:
    states = states.copy()
    states[4::5] = states[3::5][: len(states[4::5])]
    return states


def noise_like(frames: np.ndarray) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, frames.shape).astype(np.uint8)


def twice(values: np.ndarray) -> np.ndarray:
    return np.repeat(values, 2, axis=0)[: len(values)]


FAULTS: dict[str, Fault] = {
    "unchanged": change_all(lambda s, f: (s, f)),
    "a step late": change_all(lambda s, f: (s[1:], f[:-1])),
    "late": change_all(lambda s, f: (s[8:], f[:-8])),
    "early": change_all(lambda s, f: (s[:-2], f[2:])),
    "reversed": change_all(lambda s, f: (s, f[::-1])),
    "half reversed": lambda pairs: [(s, f[::-1] if n % 2 else f) for n, (s, f) in enumerate(pairs)],
    "foreign": lambda pairs: [(s, pairs[(n + 1) % len(pairs)][1]) for n, (s, _) in enumerate(pairs)],
    "stale poses": change_all(lambda s, f: (stale(s), f)),
    "held poses": change_all(lambda s, f: (s[np.arange(len(s)) // 5 * 5], f)),
    "deltas": change_all(lambda s, f: (np.diff(s, axis=0, append=s[-1:]), f)),
    "noise": change_all(lambda s, f: (s, noise_like(f))),
    "each step twice": change_all(lambda s, f: (twice(s), twice(f))),
    "each frame twice": change_all(lambda s, f: (s, f[np.arange(len(f)) // 2 * 2])),
    "one frame": change_all(lambda s, f: (s, f[np.zeros(len(f), int)])),
    "near the base": change_all(lambda s, f: (s - np.append(s[0, :3], [0, 0, 0, 0]) * [1, 1, 1, 0, 0, 0, 0], f)),
}


def found_in(pairs: list[Pair], *, stride: int = 4, space: StateSpace = POSE) -> list[Finding]:
    excerpts = [spot_excerpt(number, *pair) for number, pair in enumerate(pairs)]
    return list(excerpt_findings(excerpts, space, stride, 15.0))


def warnings_in(pairs: list[Pair], **about: object) -> list[Finding]:
    findings = found_in(pairs, **about)  # type: ignore[arg-type]
    return [finding for finding in findings if finding.level in {"error", "warning"}]


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("space", [POSE, make_vector_states(7)], ids=["poses", "vectors"])
def test_matching_frames_and_states_have_only_ok_findings(seed: int, space: StateSpace) -> None:
    findings = found_in(recorded(seed), space=space)
    assert not [finding for finding in findings if finding.level != "ok"]
    assert findings[-1].text.startswith("frames change when the robot moves (rank correlation")


@pytest.mark.parametrize(
    ("fault", "level", "about", "words"),
    [
        ("late", "error", "agreement", "frames are 8 steps late (0.53 s)"),
        ("early", "warning", "agreement", "frames are 2 steps early (0.13 s)"),
        ("reversed", "error", "agreement", "opposite orders in time"),
        ("half reversed", "warning", "agreement", "6 of 12 episodes fit better with the frames in opposite order"),
        ("foreign", "warning", "agreement", "do not change when the robot moves"),
        ("stale poses", "warning", "stale poses", "while the frame changes"),
        ("held poses", "error", "stale poses", "while the frame changes"),
        ("deltas", "error", "position", "differences, not poses"),
        ("noise", "error", "frames", "out of order"),
        ("each step twice", "warning", "repeated", "recorded at a lower rate"),
        ("each frame twice", "warning", "repeated", "the camera has a lower rate"),
        ("one frame", "error", "repeated", "100 % of the frames repeat the previous frame"),
    ],
)
def test_each_fault_gives_exactly_one_finding_with_its_cause(fault: str, level: str, about: str, words: str) -> None:
    (finding,) = warnings_in(FAULTS[fault](recorded()))
    assert (finding.level, finding.about, words in finding.text) == (level, about, True), finding


@pytest.mark.parametrize("fault", ["unchanged", "foreign", "reversed"])
def test_agreement_of_few_short_or_still_episodes_is_skipped(fault: str) -> None:
    for pairs in (recorded(episodes=5), recorded(steps=5), [(s[:1].repeat(STEPS, 0), f) for s, f in recorded()]):
        findings = found_in(FAULTS[fault](pairs))
        assert [finding.level for finding in findings if finding.about == "agreement"] == ["skipped"]
        assert "needs at least 8 moving episodes of 8 or more steps" in findings[-1].text
    (finding,) = found_in([(s[:1], f[:1]) for s, f in recorded()])
    assert (finding.level, finding.text.split(", ")[1]) == ("skipped", "found 0 (median 0 steps)")


def config_of(path: Path, tmp_path: Path, **changes: object) -> DataConfig:
    values = {
        "source": "npz", "path": str(path), "frames": 3, "stride": 4, "workers": 0, "validation_share": 0.4,
        "test_share": 0.0, "disk_cache": {"dir": str(tmp_path / "cache")},
    }  # fmt: skip
    return DataConfig.model_validate(values | changes)


def test_check_reports_shifted_frames_and_skips_agreement_for_a_latent_cache(tmp_path: Path) -> None:
    config = config_of(write_spots(tmp_path / "late", FAULTS["late"](recorded())), tmp_path)
    findings = {finding.about: finding for finding in check_data(config, clips=2)}
    assert (findings["agreement"].level, "8 steps" in findings["agreement"].text) == ("error", True)
    cached = config_of(write_cache(open_dataset(config)), tmp_path, source="latents")
    findings = {finding.about: finding for finding in check_data(cached, clips=2)}
    assert (findings["agreement"].level, "latent cache" in findings["agreement"].text) == ("skipped", True)


def in_memory(lengths: list[int], **changes: object) -> Dataset:
    return dataset_in_memory(MemorySource(lengths, unreadable=frozenset({3})), **changes)


def test_excerpt_is_the_middle_of_the_longest_selected_range() -> None:
    dataset = in_memory([300] * 4 + [20], exclude=())
    ranges = StepSelection(*(np.array(column, np.int32) for column in ([4, 4], [0, 8], [5, 20])))
    dataset = Dataset(dataset.config, dataset.source, dataset.table, ranges, dataset.broken)
    (excerpt,) = read_excerpts(dataset, steps=6)
    assert excerpt.name == "episode 4"
    np.testing.assert_array_equal(excerpt.states, dataset.source.read(4).states[11:17])
    source = dataset.source
    assert isinstance(source, MemorySource)
    assert source.decoded == [(4, step) for step in range(11, 17)]
