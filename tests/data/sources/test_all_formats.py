"""All data formats: one trajectory gives the same clips in the same order."""

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
from vjepa2_ac.inspection.excerpts import excerpts_of
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
def forms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the same four episodes in every format; their identities differ, but not their order."""
    root = tmp_path_factory.mktemp("forms")
    drawn = [synthetic_episode(number, steps=steps, size=SIZE) for number, steps in enumerate(LENGTHS)]
    write_droid_rlds(root / "rlds" / "1.0.0", drawn, shards=2)
    recorded = []
    for number, episode in enumerate(drawn):
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
            states.astype(np.float64), pictures={"23404442": frames}, joint_velocities=velocities, gop=4,
        )  # fmt: skip
        (root / "npz").mkdir(exist_ok=True)
        np.savez(root / f"npz/{number}.npz", states=states, frames=np.stack(frames), fps_hz=15.0)
    write_v30(root / "lerobot_v3.0", recorded)
    write_v21(root / "lerobot_v2.1", recorded)
    return root


def data_config(form: str, path: str, **values: Any) -> DataConfig:
    chosen = {"frames": 3, "stride": 2, "workers": 0, "validation_share": 0.0, "test_share": 0.0} | values
    return DataConfig(source=form.split("_v", maxsplit=1)[0], path=path, **chosen)


def open_format(forms: Path, form: str, **values: Any) -> Dataset:
    return open_dataset(data_config(form, str(forms / form / ("1.0.0" if form == "rlds" else "")), **values))


def clips(dataset: Dataset, count: int) -> tuple[list[tuple[int, int]], list[Batch]]:
    """Return (episode, start) of the first clips, episodes by their index in alphabetical order, and the batches."""
    batches = list(itertools.islice(training_loader(dataset, seed=5, batch_size=3), count))
    ranks = {info.id: int(rank) for info, rank in zip(dataset.table, dataset.table.id_rank, strict=True)}
    return [(ranks[n], s) for b in batches for n, s in zip(b.episode_ids, b.starts, strict=True)], batches


@pytest.mark.parametrize("form", FORMATS[1:])
def test_all_formats_give_the_same_clips_in_the_same_order(forms: Path, form: str) -> None:
    expected_order, expected = clips(open_format(forms, "rlds"), 16)
    order, found = clips(open_format(forms, form), 16)
    assert order == expected_order
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.states, other.states)
        np.testing.assert_array_equal(one.actions, other.actions)
        assert one.frames.shape == other.frames.shape
        assert abs(one.frames.int() - other.frames.int()).float().mean() < 8, "more than a codec loses"


@pytest.mark.parametrize("form", FORMATS[1:])
def test_idle_filter_selects_the_same_steps_in_all_formats(forms: Path, form: str) -> None:
    rules = [MOTION] if form == "npz" else [MOTION, COMMANDS]  # .npz has no commanded velocities
    for rule in rules:
        expected, found = open_format(forms, "rlds", idle=rule), open_format(forms, form, idle=rule)
        assert 0 < expected.selected_steps.num_steps < sum(LENGTHS)
        by_rank = [
            [dataset.selected_steps.ranges_of(episode) for episode in np.argsort(dataset.table.id_rank).tolist()]
            for dataset in (expected, found)
        ]
        assert by_rank[0] == by_rank[1]


@pytest.mark.parametrize("form", FORMATS)
def test_data_set_is_indexed_once_for_equivalent_paths(
    forms: Path, form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "link").symlink_to(forms)
    monkeypatch.chdir(forms)
    tables = [
        open_format(root, form, disk_cache={"dir": str(tmp_path / "cache")}).table
        for root in (forms, Path(), tmp_path / "link")
    ]
    assert [list(table) for table in tables] == [list(tables[0])] * 3
    assert len(list((tmp_path / "cache/index").glob("*.index"))) == 1


@contextmanager
def without_permission(folder: Path) -> Iterator[None]:
    """Remove the read permission of all files in a folder."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    root = os.geteuid() == 0
    try:
        for path in files:
            path.chmod(0)
        if root:  # root may read all files
            os.seteuid(65534)
        yield
    finally:
        if root:
            os.seteuid(0)
        for path in files:
            path.chmod(0o644)


@pytest.mark.parametrize("form", FORMATS)
def test_file_without_permission_raises_unreachable_error(forms: Path, form: str, tmp_path: Path) -> None:
    shutil.copytree(forms / form, tmp_path / form)
    for folder in (tmp_path, *tmp_path.parents):  # a test that is run by root switches to an unprivileged user
        if folder.owner() == forms.owner() and folder.is_relative_to(tempfile.gettempdir()):
            folder.chmod(0o755)
    (tmp_path / "new").mkdir()
    (tmp_path / "new").chmod(0o777)
    before, new = ({"dir": str(tmp_path / name), "limit_gb": 0.0} for name in ("before", "new"))
    source = open_format(tmp_path, form, disk_cache=before).source
    frames = source.read(0).read_frames
    with without_permission(tmp_path / form):
        for action in (
            lambda: source.read(0),
            lambda: frames([0]),
            lambda: open_format(tmp_path, form, disk_cache=new),
        ):
            with pytest.raises(UnreachableError, match=f"{os.strerror(errno.EACCES)}.*permissions"):
                action()
    assert len(open_format(tmp_path, form, disk_cache=new).table) == len(LENGTHS)


CallSite = tuple[str, ...]


def find_call_site() -> CallSite:
    """Return the functions of the package on the call stack, outermost first, without storage.remote."""
    calls = [frame.f_code for frame, _ in traceback.walk_stack(None) if "/vjepa2_ac/" in frame.f_code.co_filename]
    return tuple(call.co_name for call in calls if "/storage/remote/" not in call.co_filename)[::-1]


def run_all_readers(dataset: Dataset) -> None:
    """Read clips, sample episodes and measure them, as training, `data check` and `data inspect` do."""
    clips(dataset, 2)
    assert list(excerpts_of(dataset))
    inspect_dataset(dataset)


@pytest.mark.parametrize("form", [form for form in FORMATS if form != "lerobot_v2.1"])
def test_unreachable_storage_raises_from_every_call_site(
    forms: Path, form: str, gcs: Gcs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A network failure at any call site raises UnreachableError and marks no episode as broken."""
    gcs.upload(forms / form, f"robots/{form}")
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
        path = f"gs://robots/{form}{'/1.0.0' if form == 'rlds' else ''}"
        run_all_readers(open_dataset(data_config(form, path, disk_cache=cache, **values)))

    use(0)
    assert len(call_sites) > 3
    for number, failing[0] in enumerate(list(call_sites), start=1):
        with pytest.raises(UnreachableError, match=r"^gs://robots.*gone"):
            use(number)
