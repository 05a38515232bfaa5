"""Each fault in the values of a data set gives one finding with the cause."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from gcs import Gcs
from vector_sets import write_vectors
from vjepa2_ac.config import DataConfig, DiskCacheConfig
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.episode import Batch
from vjepa2_ac.inspection.check import batch_findings, check_data
from vjepa2_ac.inspection.findings import Finding

ONLY_MOVES = torch.tensor([1.0, 1, 1, 0, 0, 0, 1])
TURNS_BY_2_5 = torch.tensor([0.0, 0, 0, 2.5, 0, 0, 0])
IN_METRES = torch.tensor([1.0, 1, 1, 1, 1, 1, 0.08])  # the last is a gripper's width


def good(clips: int = 4, time: int = 5) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    states = torch.rand((clips, time, 7), generator=generator) * 0.5
    states[..., 6] = torch.rand((clips, time), generator=generator)
    return {
        "frames": torch.randint(0, 256, (clips, time, 8, 8, 3), dtype=torch.uint8, generator=generator),
        "states": states,
        "actions": (states[:, 1:] - states[:, :-1]) * 0.3,
    }


def found_in(**changes: torch.Tensor) -> dict[str, Finding]:
    values = good() | changes
    ids = tuple(f"episode {number}" for number in range(len(values["states"])))
    batch = Batch(**values, extrinsics=None, episode_ids=ids, starts=(0,) * len(ids))
    return {finding.about: finding for finding in batch_findings([batch])}


def with_column(column: int, value: float) -> torch.Tensor:
    states = good()["states"].clone()
    states[..., column] = value
    return states


def test_plausible_batch_has_only_ok_findings() -> None:
    assert {finding.level for finding in found_in().values()} == {"ok"}


@pytest.mark.parametrize(
    ("about", "level", "words", "changes"),
    [
        ("pixels", "error", "all pixels are 0", {"frames": torch.zeros_like(good()["frames"])}),
        ("pixels", "warning", "nearly black", {"frames": good()["frames"] // 100}),
        ("position", "error", "never changes", {"states": torch.zeros_like(good()["states"])}),
        ("position", "warning", "beyond the reach of most arms (1.6 m)", {"states": good()["states"] * 8}),
        ("position", "warning", "within 1 cm", {"states": good()["states"] * 0.01}),
        ("rotation", "warning", "never changes", {"actions": good()["actions"] * ONLY_MOVES}),
        ("rotation", "warning", "the rotation jumps", {"actions": good()["actions"] + TURNS_BY_2_5}),
        ("gripper", "warning", "never moves in 4 clips", {"states": with_column(6, 1.0)}),
        ("gripper", "warning", "width in metres", {"states": good()["states"] * IN_METRES}),
        ("actions", "error", "all actions are zero", {"actions": torch.zeros_like(good()["actions"])}),
        ("actions", "warning", "nearly still", {"actions": good()["actions"] * 1e-3}),
        ("actions", "warning", "the steps are long", {"actions": good()["actions"] * 10}),
    ],
)  # fmt: skip
def test_implausible_values_in_a_batch_raise_the_matching_finding(
    about: str, level: str, words: str, changes: dict[str, torch.Tensor]
) -> None:
    finding = found_in(**changes)[about]
    assert (finding.level, words in finding.text) == (level, True), finding


def make_data_config(droid: Path, **changes: object) -> DataConfig:
    values = {"path": str(droid), "frames": 3, "stride": 2, "workers": 0, "validation_share": 0.3, "test_share": 0.0}
    return DataConfig.model_validate(values | changes)


def test_check_of_a_data_set_reports_index_batch_and_timing(droid: Path) -> None:
    findings = list(check_data(make_data_config(droid), batch_size=2, clips=6))
    about = {finding.about: finding for finding in findings}
    assert "6 episodes, 87 steps" in about["index"].text
    assert "frames (2, 3, 48, 65, 3) uint8" in about["batch"].text
    assert about["timing"].text.startswith("the first batch of 2 clips took ")
    assert not [finding for finding in findings if finding.level == "error"]


def test_empty_test_split_is_an_error_only_if_its_share_is_above_zero(droid: Path) -> None:
    one_group_values = {"split_by": "(episode|.)"}
    for share, level in ((0.001, "error"), (0.0, "skipped")):
        findings = check_data(
            make_data_config(droid, test_share=share, validation_share=0.0, **one_group_values), clips=2
        )
        assert {finding.about: finding.level for finding in findings}["test"] == level


def test_small_test_split_proposes_a_share_that_suffices(tmp_path: Path) -> None:
    small_set, large_set = (write_vectors(tmp_path / str(episodes), width=3, episodes=episodes) for episodes in (6, 45))
    values = {"source": "npz", "states": "vector", "validation_share": 0.1, "test_share": 0.15}
    dataset = open_dataset(make_data_config(large_set, **values))
    tested = [dataset.table.identity(index) for index in np.flatnonzero(dataset.split_mask("test")).tolist()]
    with_small_split = make_data_config(
        large_set, **values, exclude=tuple(tested[3:])
    )  # the hashes draw 3 of 38 episodes, although the share is 5.7 episodes
    texts = {}
    for config in (make_data_config(small_set, **values), with_small_split):
        (texts[config.path],) = (
            finding.text for finding in check_data(config, clips=2) if "cannot show whether" in finding.text
        )
    assert texts[str(small_set)].endswith("Record more episodes")
    proposed = float(re.search(r"data.test_share=([\d.]+)", texts[str(large_set)])[1])
    members = open_dataset(with_small_split.model_copy(update={"test_share": proposed})).split_mask("test").sum()
    assert proposed > 0.15
    assert members >= 5
    assert texts[str(large_set)].endswith(f"the split then has {members}")


def test_check_of_a_url_reports_the_bytes_fetched_per_clip(gcs: Gcs, tmp_path: Path) -> None:
    gcs.upload(write_vectors(tmp_path / "set", width=3), "bucket/set")
    config = make_data_config("gs://bucket/set", source="npz", states="vector", validation_share=0.1, test_share=0.1)
    config = config.model_copy(update={"disk_cache": DiskCacheConfig(dir=str(tmp_path / "cache"), limit_gb=0)})
    about = {finding.about: finding.text for finding in check_data(config, clips=2)}
    assert re.fullmatch(r"[\d,]+ kB fetched per clip \(mean of \d+ clips\)", about["network"])
    assert not about["network"].startswith("0 kB")
