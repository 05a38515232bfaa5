"""All data formats: the same recordings give the same clips in the same order."""

import errno
import itertools
import os
import shutil
import tempfile
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gcs import Gcs
from lerobot_sets import STATE, Recorded, write_v21, write_v30
from recordings import write_raw_droid
from synthetic import draw_frame, measured_states, synthetic_episode
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data import files
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.loader import training_loader
from vjepa2_ac.episode import Batch
from vjepa2_ac.errors import UnreachableError
from vjepa2_ac.inspection.excerpts import read_excerpts
from vjepa2_ac.inspection.statistics import inspect_dataset
from vjepa2_ac.simulation.droid_writer import write_droid_rlds
from vjepa2_ac.storage import retries

LENGTHS = (14, 17, 15, 12)
SIZE = (36, 64)
FORMATS = ("rlds", "droid_raw", "lerobot_v3.0", "lerobot_v2.1", "npz")
COMMANDS = {
    "rule": "commands", "velocity_change_rad_s": 0.004, "shortest_idle_steps": 1, "shortest_kept_steps": 3,
    "cut_last_steps": 0,
}  # fmt: skip
MOTION = {
    "rule": "motion", "translation_m": 0.02, "rotation_rad": 0.03, "gripper": 0.03, "shortest_idle_steps": 2,
    "shortest_kept_steps": 3, "cut_last_steps": 1,
}  # fmt: skip


@pytest.fixture(scope="module")
def data_sets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the same four episodes in every format; their identities differ, but not their order."""
    root = tmp_path_factory.mktemp("forms")
    episodes = [synthetic_episode(number, steps=steps, size=SIZE) for number, steps in enumerate(LENGTHS)]
    write_droid_rlds(root / "rlds" / "1.0.0", episodes, shards=2)
    recorded = []
    for number, episode in enumerate(episodes):
        states = measured_states(episode).astype(np.float32)
        velocities = np.asarray(episode.arrays["action_dict/joint_velocity"], np.float32)
        frames = [draw_frame(state, size=SIZE) for state in states]
        recorded.append(
            Recorded(
                {STATE[0]: states[:, :6], STATE[1]: states[:, 6:], "action.joint_velocity": velocities},
                {"observation.images.exterior_1_left": frames},
            )
        )
        write_raw_droid(
            root / f"droid_raw/LAB/success/2023-07-07/Fri_Jul__7_09:4{number}:00_2023",
            states.astype(np.float64), frames_by_serial={"23404442": frames}, joint_velocities=velocities, gop=4,
        )  # fmt: skip
        (root / "npz").mkdir(exist_ok=True)
        np.savez(root / f"npz/{number}.npz", states=states, frames=np.stack(frames), fps_hz=15.0)
    write_v30(root / "lerobot_v3.0", recorded)
    write_v21(root / "lerobot_v2.1", recorded)
    return root


def data_config(data_format: str, path: str, **values: Any) -> DataConfig:
    chosen = {"frames": 3, "stride": 2, "workers": 0, "validation_share": 0.0, "test_share": 0.0} | values
    return DataConfig(source=data_format.split("_v", maxsplit=1)[0], path=path, **chosen)


def open_format(data_sets: Path, data_format: str, **values: Any) -> Dataset:
    return open_dataset(
        data_config(data_format, str(data_sets / data_format / ("1.0.0" if data_format == "rlds" else "")), **values)
    )


def clips(dataset: Dataset, count: int) -> tuple[list[tuple[int, int]], list[Batch]]:
    """Return (episode, start) of the first clips, episodes by their index in alphabetical order, and the batches."""
    batches = list(itertools.islice(training_loader(dataset, seed=5, batch_size=3), count))
    ranks = {info.id: int(rank) for info, rank in zip(dataset.table, dataset.table.id_rank, strict=True)}
    return [(ranks[n], s) for b in batches for n, s in zip(b.episode_ids, b.starts, strict=True)], batches


@pytest.mark.parametrize("data_format", FORMATS[1:])
def test_all_formats_give_the_same_clips_in_the_same_order(data_sets: Path, data_format: str) -> None:
    expected_order, expected = clips(open_format(data_sets, "rlds"), 16)
    order, batches = clips(open_format(data_sets, data_format), 16)
    assert order == expected_order
    for batch, expected_batch in zip(batches, expected, strict=True):
        np.testing.assert_array_equal(batch.states, expected_batch.states)
        np.testing.assert_array_equal(batch.actions, expected_batch.actions)
        assert batch.frames.shape == expected_batch.frames.shape
        assert abs(batch.frames.int() - expected_batch.frames.int()).float().mean() < 8, "more than the loss of a codec"


@pytest.mark.parametrize("data_format", FORMATS[1:])
def test_idle_filter_selects_the_same_steps_in_all_formats(data_sets: Path, data_format: str) -> None:
    rules = [MOTION] if data_format == "npz" else [MOTION, COMMANDS]  # .npz has no commanded velocities
    for rule in rules:
        expected, dataset = open_format(data_sets, "rlds", idle=rule), open_format(data_sets, data_format, idle=rule)
        assert 0 < expected.selected_steps.num_steps < sum(LENGTHS)
        by_rank = [
            [opened.selected_steps.ranges_of(episode) for episode in np.argsort(opened.table.id_rank).tolist()]
            for opened in (expected, dataset)
        ]
        assert by_rank[0] == by_rank[1]


@pytest.mark.parametrize("data_format", FORMATS)
def test_data_set_is_indexed_once_for_equivalent_paths(
    data_sets: Path, data_format: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "link").symlink_to(data_sets)
    monkeypatch.chdir(data_sets)
    tables = [
        open_format(root, data_format, disk_cache={"dir": str(tmp_path / "cache")}).table
        for root in (data_sets, Path(), tmp_path / "link")
    ]
    assert [list(table) for table in tables] == [list(tables[0])] * 3
    assert len(list((tmp_path / "cache/index").glob("*.index"))) == 1


@contextmanager
def without_permission(folder: Path) -> Iterator[None]:
    """Remove the read permission of all files in a folder."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    is_root = os.geteuid() == 0
    try:
        for path in files:
            path.chmod(0)
        if is_root:  # root may read all files
            os.seteuid(65534)
        yield
    finally:
        if is_root:
            os.seteuid(0)
        for path in files:
            path.chmod(0o644)


@pytest.mark.parametrize("data_format", FORMATS)
def test_file_without_permission_raises_unreachable_error(data_sets: Path, data_format: str, tmp_path: Path) -> None:
    shutil.copytree(data_sets / data_format, tmp_path / data_format)
    for folder in (tmp_path, *tmp_path.parents):  # if root runs the test, it switches to an unprivileged user
        if folder.owner() == data_sets.owner() and folder.is_relative_to(tempfile.gettempdir()):
            folder.chmod(0o755)
    (tmp_path / "new").mkdir()
    (tmp_path / "new").chmod(0o777)
    before, new = ({"dir": str(tmp_path / name), "limit_gb": 0.0} for name in ("before", "new"))
    source = open_format(tmp_path, data_format, disk_cache=before).source
    frames = source.read(0).read_frames
    with without_permission(tmp_path / data_format):
        for action in (
            lambda: source.read(0),
            lambda: frames([0]),
            lambda: open_format(tmp_path, data_format, disk_cache=new),
        ):
            with pytest.raises(UnreachableError, match=f"{os.strerror(errno.EACCES)}.*permissions"):
                action()
    assert len(open_format(tmp_path, data_format, disk_cache=new).table) == len(LENGTHS)


CallSite = tuple[str, ...]


def find_call_site() -> CallSite:
    """Return the functions of the package on the call stack, outermost first, without storage.remote."""
    calls = [frame.f_code for frame, _ in traceback.walk_stack(None) if "/vjepa2_ac/" in frame.f_code.co_filename]
    return tuple(call.co_name for call in calls if "/storage/remote/" not in call.co_filename)[::-1]


def run_all_readers(dataset: Dataset) -> None:
    """Read clips, sample episodes and measure them, as training, `data check` and `data inspect` do."""
    clips(dataset, 2)
    assert list(read_excerpts(dataset))
    inspect_dataset(dataset)


@pytest.mark.parametrize("data_format", [data_format for data_format in FORMATS if data_format != "lerobot_v2.1"])
def test_unreachable_storage_raises_from_every_call_site(
    data_sets: Path, data_format: str, gcs: Gcs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A network failure at any call site raises UnreachableError and marks no episode as broken."""
    gcs.upload(data_sets / data_format, f"robots/{data_format}")
    original, call_sites, failing = retries.call_with_retries, dict.fromkeys(()), [None]

    def call_or_fail(where: str, *args: Any, **kwargs: Any) -> Any:
        call_site = find_call_site()
        if call_site == failing[0]:
            raise UnreachableError(where=where, found="gone")
        call_sites.setdefault(call_site)
        return original(where, *args, **kwargs)

    monkeypatch.setattr(retries, "call_with_retries", call_or_fail)
    values = {"idle": MOTION, "broken_episodes": "skip"}
    monkeypatch.setattr(files, "CONNECTIONS", 2)

    def use(number: int) -> None:
        cache = {"dir": str(tmp_path / f"cache{number}"), "limit_gb": 0.0}
        path = f"gs://robots/{data_format}{'/1.0.0' if data_format == 'rlds' else ''}"
        run_all_readers(open_dataset(data_config(data_format, path, disk_cache=cache, **values)))

    use(0)
    assert len(call_sites) > 3
    for number, failing[0] in enumerate(list(call_sites), start=1):
        with pytest.raises(UnreachableError, match=r"^gs://robots.*gone"):
            use(number)
