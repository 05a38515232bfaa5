"""LeRobot data sets v3.0 and v2.1: states and frames, pose formats, and errors of settings and files."""

import json
import pickle
import re
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from lerobot_sets import (
    FPS,
    SIZE,
    STATE,
    Recorded,
    change_info,
    change_table,
    column_of,
    numbers_of,
    recorded,
    write_v21,
    write_v30,
)
from recordings import write_mp4
from synthetic import synthetic_states
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.sources.lerobot import LeRobotSource
from vjepa2_ac.data.sources.parquet import ParquetRows
from vjepa2_ac.episode import Episode, EpisodeSource
from vjepa2_ac.errors import InputError
from vjepa2_ac.spaces import euler_from_matrices, matrices_from_euler

LENGTHS = (12, 13, 14, 15, 16)
KEY = "observation.images.exterior_1_left"


def config_of(path: object, **changes: Any) -> DataConfig:
    return DataConfig.model_validate_json(json.dumps({"source": "lerobot", "path": str(path)} | changes))


def source_of(path: object, **changes: Any) -> LeRobotSource:
    return LeRobotSource(config_of(path, **changes))


@pytest.fixture(scope="session")
def episodes() -> list[Recorded]:
    return [recorded(number, steps) for number, steps in enumerate(LENGTHS)]


@pytest.fixture(scope="session")
def v30(episodes: list[Recorded], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes in a Parquet file, three in a video. Read only."""
    return write_v30(tmp_path_factory.mktemp("v30"), episodes)


@pytest.fixture(scope="session")
def v21(episodes: list[Recorded], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Parquet file and a video for each episode, three in a chunk. Read only."""
    return write_v21(tmp_path_factory.mktemp("v21"), episodes, gop=10)


@pytest.fixture(params=["v30", "v21"])
def data_set(request: pytest.FixtureRequest) -> Path:
    return request.getfixturevalue(request.param)


@pytest.fixture
def copy(data_set: Path, tmp_path: Path) -> Path:
    """Return a copy of a data set of either version, which a test may change."""
    return Path(shutil.copytree(data_set, tmp_path / "set"))


def first_rows(root: Path) -> Path:
    return sorted(root.glob("data/*/*.parquet"))[0]


def first_video(root: Path) -> Path:
    return next(path for path in sorted(root.glob("videos/**/*.mp4")) if KEY in str(path))


# --- reading -----------------------------------------------------------------------------------------------------


def test_states_equal_the_written_states_in_every_version(data_set: Path, episodes: list[Recorded]) -> None:
    source = source_of(data_set)
    assert isinstance(source, EpisodeSource)
    infos = source.infos()
    assert [info.num_steps for info in infos] == list(LENGTHS)
    assert [info.success for info in infos] == [number % 3 != 2 for number in range(5)]
    assert not infos.problems
    for number, episode in enumerate(episodes):
        read = source.read(number)
        expected_states = np.concatenate([episode.columns[name] for name in STATE], axis=1)
        np.testing.assert_array_equal(read.states, expected_states.astype(np.float64))
        assert read.joint_velocities is not None
        np.testing.assert_array_equal(read.joint_velocities, episode.columns["action.joint_velocity"])
        assert read.control_rate_hz == FPS
        assert read.metadata == {"language": episode.task}


@pytest.mark.parametrize("gop", [2, 10])
@pytest.mark.parametrize("write", [write_v30, write_v21])
def test_frames_match_their_steps(
    write: Callable[..., Path], gop: int, episodes: list[Recorded], tmp_path: Path
) -> None:
    source = source_of(write(tmp_path / "set", episodes, gop=gop))
    generator = np.random.default_rng(gop)
    for camera, name in enumerate(("exterior_1_left", "wrist_left")):
        for number in generator.permutation(len(LENGTHS)):
            steps = [int(step) for step in generator.permutation(LENGTHS[number])[:6]]
            frames = source.read(int(number), camera=name).read_frames([*steps, 0, LENGTHS[number] - 1])
            expected = [(int(number), step, camera) for step in (*steps, 0, LENGTHS[number] - 1)]
            assert [numbers_of(frame) for frame in frames] == expected


def test_reads_are_independent_of_order_threads_and_process(data_set: Path) -> None:
    def read_all(source: LeRobotSource, order: list[int]) -> dict[int, tuple[bytes, bytes]]:
        with ThreadPoolExecutor(4) as pool:
            read: list[Episode] = list(pool.map(source.read, order))
            frames = list(pool.map(lambda episode: episode.read_frames([3, 8]), read))
        return {
            number: (episode.states.tobytes(), images.tobytes())
            for number, episode, images in zip(order, read, frames, strict=True)
        }

    source = source_of(data_set)
    source.infos()
    forward = read_all(source, [0, 1, 2, 3, 4, 0, 1, 2])
    assert read_all(pickle.loads(pickle.dumps(source)), [4, 2, 0, 3, 1]) == forward  # noqa: S301 - our own bytes


@pytest.mark.parametrize("image_format", ["png", "jpeg"])
@pytest.mark.parametrize("write", [write_v30, write_v21])
def test_frames_are_read_from_image_columns(
    write: Callable[..., Path], image_format: str, episodes: list[Recorded], tmp_path: Path
) -> None:
    source = source_of(write(tmp_path / "set", episodes[:3], image_format=image_format))
    frames = source.read(1).read_frames([7, 2])
    assert [numbers_of(frame) for frame in frames] == [(1, 7, 0), (1, 2, 0)]
    if image_format == "png":
        np.testing.assert_array_equal(frames[0], episodes[1].frames[KEY][7])


def count_images(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return a list to which each read of images from a table appends the number of images."""
    counts, read_images = list[int](), ParquetRows.read_images

    def counted(self: ParquetRows, *arguments: Any) -> list[bytes]:
        counts.append(len(read := read_images(self, *arguments)))
        return read

    monkeypatch.setattr(ParquetRows, "read_images", counted)
    return counts


@pytest.mark.parametrize("write", [write_v30, write_v21])
def test_later_clip_reads_images_from_the_cache(
    write: Callable[..., Path], episodes: list[Recorded], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, cache = write(tmp_path / "set", episodes[:3], image_format="png"), {"dir": str(tmp_path / "cache")}
    from_tables = count_images(monkeypatch)
    source = source_of(root, disk_cache=cache)
    expected = source.read(1).read_frames([3, 7, 11])
    for reader in (source, source_of(root, disk_cache=cache)):
        np.testing.assert_array_equal(reader.read(1).read_frames([3, 7, 11]), expected)
    assert from_tables == [LENGTHS[1]], "the table is not read again"
    for number in (0, 2):
        assert numbers_of(source.read(number).read_frames([3])[0]) == (number, 3, 0)


# --- conventions -------------------------------------------------------------------------------------------------


def write_data_set(folder: Path, state: np.ndarray, **columns: np.ndarray) -> Path:
    frames = {"observation.images.front": [np.zeros((*SIZE, 3), np.uint8)] * len(state)}
    columns_by_key = {"observation.state": state} | {
        name.replace("__", "."): values for name, values in columns.items()
    }
    return write_v30(folder, [Recorded(columns_by_key, frames)])


OWN_FIELDS = {"state": ["observation.state"], "cameras": {"front": "observation.images.front"}}


@pytest.mark.parametrize("convention", ["quaternion_wxyz", "quaternion_xyzw"])
def test_all_rotation_formats_give_the_same_pose(convention: str, tmp_path: Path) -> None:
    states = synthetic_states(20, seed=3)
    matrices = matrices_from_euler(states[:, 3:6])
    quaternions = Rotation.from_matrix(matrices).as_quat(scalar_first=convention == "quaternion_wxyz")
    quaternions[::2] *= -1  # q and -q are the same rotation
    columns = np.concatenate([states[:, :3], quaternions, states[:, 6:]], axis=1)
    source = source_of(write_data_set(tmp_path / "set", columns), lerobot=OWN_FIELDS | {"rotation": convention})
    read = source.read(0).states
    np.testing.assert_allclose(matrices_from_euler(read[:, 3:6]), matrices, atol=1e-9)
    np.testing.assert_allclose(read[:, 3:6], euler_from_matrices(matrices), atol=1e-9)
    np.testing.assert_allclose(read[:, [0, 1, 2, 6]], states[:, [0, 1, 2, 6]], atol=1e-12)


@pytest.mark.parametrize(("opened", "closed"), [(0.08, 0.0), (0.0, 0.08), (100.0, 0.0), (-1.0, 1.0), (1.0, 0.0)])
def test_gripper_is_converted_to_closedness(opened: float, closed: float, tmp_path: Path) -> None:
    states = synthetic_states(15, seed=1)
    columns = states.copy()
    columns[:, 6] = opened + states[:, 6] * (closed - opened)
    root = write_data_set(tmp_path / "set", columns)
    source = source_of(root, lerobot=OWN_FIELDS | {"gripper_open": opened, "gripper_closed": closed})
    np.testing.assert_allclose(source.read(0).states, states, atol=1e-12)
    if abs(closed - opened) > 1.1:
        with pytest.raises(
            InputError, match=r"Expected a gripper between 0 and 1: 0 for open, 1 for closed\. Check data\.lerobot"
        ):
            source_of(root, lerobot=OWN_FIELDS).infos()


# --- invalid settings --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"lerobot": {"state": ["observation.state.cartesian_positon"]}},
            r"Expected one of observation\.state\..*Did you mean observation\.state\.cart",
        ),
        (
            {"lerobot": {"state": [STATE[0]]}},
            r"6 numbers per step from .*cartesian_position \[6\]\. .*7 numbers: x, y",
        ),
        (
            {"lerobot": {"rotation": "quaternion_wxyz"}},
            r"7 numbers per step .*8 numbers: x, y, z, a quaternion's",
        ),
        ({"lerobot": {"select": [0, 1, 2, 3, 4, 5, 7]}}, r"select: index 7, but .* has 7 numbers.*from 0 to 6"),
        ({"lerobot": {"cameras": {"left": "observation.images.left"}}}, r"no camera observation\.images\.left"),
    ],
)
def test_wrong_mapping_raises_a_config_error(changes: dict[str, Any], message: str, data_set: Path) -> None:
    with pytest.raises(InputError, match=message):
        source_of(data_set, **changes).infos()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"codebase_version": "v2.0"}, r"codebase_version 'v2\.0'.*v2\.1 or v3\.0.*convert_dataset_v20_to_v21\.py"),
        ({"codebase_version": "v3.1"}, r"codebase_version 'v3\.1'.*update vjepa2-ac"),
        ({"codebase_version": None}, "codebase_version None"),
        ({"storage_format": "lance"}, "storage_format 'lance'.*Parquet files and MP4.*data converter lance_to_files"),
    ],
)
def test_unsupported_version_or_storage_raises_with_conversion_hint(
    changes: dict[str, Any], message: str, v30: Path, tmp_path: Path
) -> None:
    root = Path(shutil.copytree(v30, tmp_path / "set"))
    change_info(root, storage_format="parquet")
    assert len(source_of(root).infos()) == len(LENGTHS)
    change_info(root, **changes)
    with pytest.raises(InputError, match=rf"meta/info\.json: {message}"):
        source_of(root).infos()


def change_feature(root: Path, name: str, **changes: object) -> None:
    features = json.loads((root / "meta/info.json").read_text())["features"]
    features[name] = features.get(name, {"shape": [1], "names": None}) | changes
    change_info(root, features=features)


@pytest.mark.parametrize(
    "flag",
    [
        {"info": {"is_depth_map": True}},
        {"info": {"video.is_depth_map": True}},
        {"video_info": {"video.is_depth_map": True}},
        {"info": {"video.pix_fmt": "gray12le"}},
    ],
    ids=["current flag", "older flag", "oldest flag", "pixel format"],
)
def test_depth_map_is_not_a_camera(flag: dict[str, object], copy: Path) -> None:
    change_feature(copy, KEY, info={"is_depth_map": False, "video.pix_fmt": "gray"})
    assert len(source_of(copy).infos()) == len(LENGTHS)
    change_feature(copy, KEY, **({"info": {}} | flag))
    with pytest.raises(InputError, match=rf"no camera {KEY} in .*Expected one of obs"):
        source_of(copy).infos()
    assert len(source_of(copy, camera="wrist_left").infos()) == len(LENGTHS)


@pytest.mark.parametrize(
    "damage_file",
    [
        lambda info: info.write_text("[1, 2]"),
        lambda info: change_info(info.parent.parent, total_episodes=6),
        lambda info: change_info(info.parent.parent, data_path="../{episode_index}"),
        lambda info: change_info(info.parent.parent, data_path="data/{episode_index.__class__}"),
        lambda info: change_info(info.parent.parent, video_path=None),
    ],
)
def test_damaged_meta_files_raise_with_path(damage_file: Callable[[Path], None], copy: Path) -> None:
    damage_file(copy / "meta/info.json")
    with pytest.raises(InputError, match=r"meta/(info\.json|episodes)"):
        source_of(copy).infos()


def test_missing_data_set_raises_with_expected_layout(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"data\.path: no meta/info\.json in .*the folder with meta, data"):
        source_of(tmp_path).infos()


# --- unusable episodes ------------------------------------------------------------------------------------------


def changed(change: Callable[[list[list[float]]], Any]) -> Callable[[Path], None]:
    """Return a function that replaces the states in the first file of a data set by `change(states)`."""

    def damage_file(root: Path) -> None:
        rows = pq.read_table(first_rows(root)).column(STATE[0]).to_pylist()
        states = change(rows)
        change_table(first_rows(root), **{STATE[0]: column_of(states) if isinstance(states, np.ndarray) else states})

    return damage_file


def with_value(step: int, value: float) -> Callable[[list[list[float]]], np.ndarray]:
    return lambda rows: np.where((np.arange(len(rows)) == step)[:, None], np.float32(value), np.float32(rows))


def select_rows(*indices: int) -> Callable[[Path], None]:
    def damage_file(root: Path) -> None:
        table = pq.read_table(first_rows(root))
        pq.write_table(table.take([*indices, *range(12, len(table))]), first_rows(root))

    return damage_file


LIST = pa.list_(pa.float32())
BROKEN: dict[str, tuple[Callable[[Path], object], str]] = {
    "no video": (lambda root: first_video(root).unlink(), f"{KEY}.*no such video.*for 12 rows in data/chunk-000/"),
    "no rows": (lambda root: first_rows(root).unlink(), "no such file"),
    "cut": (lambda root: first_rows(root).write_bytes(first_rows(root).read_bytes()[:-200]), r"\.parquet.*damaged"),
    "no column": (changed(lambda _: None), f"no column {STATE[0]}.*one of episode_index, frame_index, timestamp"),
    "no commands": (lambda root: change_table(first_rows(root), **{"action.joint_velocity": None}), "no column action"),
    "not a number": (changed(with_value(3, np.nan)), "episode_000000: step 3: the numbers"),
    "out of reach": (changed(with_value(5, 50.0)), "Expected a position within 5 m"),
    "five numbers": (changed(lambda rows: np.float32(rows)[:, :5]), r"5 numbers per row\. Expected 6, according to"),
    "uneven": (changed(lambda rows: pa.array([rows[0][:5], *rows[1:]], LIST)), "5 numbers in one row and 6 in another"),
    "missing state": (changed(lambda rows: pa.array([None, *rows[1:]], LIST)), "1 row without a value"),
    "text for numbers": (changed(lambda rows: pa.array(["a"] * len(rows))), "values of type string"),
    "lost rows": (select_rows(*range(10)), r"10 rows\. Expected 12"),
    "mixed rows": (select_rows(1, 0, *range(2, 12)), "frame_index does not count from 0 to 11"),
}  # fmt: skip


def only_problem(root: Path) -> str:
    table = source_of(root).infos()
    assert len(table) + len(table.problems) == 5
    first = table.problems[0]
    assert first.name == "episode_000000"
    return f"{first.where}: {first.found}. Expected {first.needed}. {first.fix}"


@pytest.mark.parametrize("damage", BROKEN)
def test_unusable_episode_is_a_problem_with_its_name_and_reason(damage: str, copy: Path) -> None:
    damage_file, message = BROKEN[damage]
    damage_file(copy)
    assert re.search(message, only_problem(copy))


def test_timestamps_reveal_wrong_rate(v21: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(v21, tmp_path / "set"))
    change_info(root, fps=10)
    with pytest.raises(InputError, match=r"step 2: timestamp 0\.1333 s\. Expected 0\.2 s, at the 10 rows per second"):
        source_of(root).infos()


TABLE = "meta/episodes/chunk-000/file-000.parquet"


def change_ranges(root: Path, camera: str = KEY, **changes: dict[int, float]) -> None:
    """Replace values in columns of a camera in the table of episodes: {episode number: value} for each column."""
    table = pq.read_table(root / TABLE)
    for column, values in changes.items():
        name = f"videos/{camera}/{column}"
        old = table.column(name).to_pylist()
        change_table(root / TABLE, **{name: pa.array([values.get(n, value) for n, value in enumerate(old)])})


OVERLAPS: dict[str, tuple[dict[str, dict[int, float]], dict[str, str]]] = {
    "all start at 0": (
        {"from_timestamp": dict.fromkeys(range(5), 0.0), "to_timestamp": {n: LENGTHS[n] / FPS for n in range(5)}},
        {
            "episode_000000": "episode_000000 and episode_000001 both contain 0 to 0.8 s of file-000.mp4",
            "episode_000001": "episode_000000 and episode_000001 both contain 0 to 0.8 s of file-000.mp4",
            "episode_000002": "episode_000001 and episode_000002 both contain 0 to 0.866667 s of file-000.mp4",
            "episode_000003": "episode_000003 and episode_000004 both contain 0 to 1 s of file-001.mp4",
            "episode_000004": "episode_000003 and episode_000004 both contain 0 to 1 s of file-001.mp4",
        },
    ),
    "one episode within another": (
        {"to_timestamp": {0: 39 / FPS}},
        {
            "episode_000000": "episode_000000 and episode_000001 both contain 0.8 to 1.66667 s of file-000.mp4",
            "episode_000001": "episode_000000 and episode_000001 both contain 0.8 to 1.66667 s of file-000.mp4",
            "episode_000002": "episode_000000 and episode_000002 both contain 1.66667 to 2.6 s of file-000.mp4",
        },
    ),
}  # fmt: skip


@pytest.mark.parametrize("overlap", OVERLAPS)
def test_overlapping_time_ranges_in_a_video_are_problems(overlap: str, v30: Path, tmp_path: Path) -> None:
    changes, expected = OVERLAPS[overlap]
    root = Path(shutil.copytree(v30, tmp_path / "set"))
    change_ranges(root, **changes)
    if len(expected) == len(LENGTHS):
        with pytest.raises(InputError, match=expected["episode_000000"]):
            source_of(root).infos()
        return
    table = source_of(root).infos()
    assert {problem.name: problem.found for problem in table.problems} == expected
    assert {info.id for info in table} == {f"episode_{number:06d}" for number in range(5)} - expected.keys()
    with pytest.raises(InputError, match=r"set/videos/.*\.mp4: .*both contain.*add to data\.exclude: \["):
        open_dataset(config_of(root))


def shorten(path: Path, num_frames: int, rate: int = FPS) -> None:
    with av.open(str(path)) as file:
        frames = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
    write_mp4(path, frames[:num_frames], rate=rate)


def test_indexing_a_local_data_set_detects_too_short_video(v21: Path, v30: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(v21, tmp_path / "v21"))
    shorten(first_video(root), 11)
    message = (
        r"episode_000000\.mp4: episode_000000: 11 frames at 15 frames per second, up to 0\.667 s\. "
        r"Expected a frame for each of 12 rows at 15 rows per second, up to 0\.733 s\. Copy the data set again"
    )
    assert re.search(message, only_problem(root))
    assert not source_of(root, camera="wrist_left").infos().problems
    shorten(first_video(root), 9, rate=10)
    assert "9 frames at 10 frames per second, up to 0.800 s" in only_problem(root)
    root = Path(shutil.copytree(v30, tmp_path / "v30"))
    shorten(first_video(root), 30)
    problems = source_of(root).infos().problems
    assert [problem.name for problem in problems] == ["episode_000002"]
    assert "30 frames at 15 frames per second, up to 1.933 s" in problems[0].found


def test_values_equal_those_read_by_lerobot(shared: Path) -> None:
    fields = {"state": ["observation.state"], "success": None, "cameras": {"front": "observation.images.front"}}
    source = source_of(shared / "data/lerobot_v30", camera="front", lerobot=fields)
    with np.load(shared / "data/lerobot_v30.truth.npz") as truth:
        for number, info in enumerate(source.infos()):
            episode = source.read(number)
            np.testing.assert_array_equal(episode.states, truth[f"state.{number}"])
            frames = episode.read_frames(range(info.num_steps))[:, ::24, ::32].astype(int)
            true = truth[f"front.{number}"].astype(int)
            difference = abs(frames - true).mean()  # the videos are lossy
            assert difference < 6
            assert difference < min(abs(frames[1:] - true[:-1]).mean(), abs(frames[:-1] - true[1:]).mean()) / 1.2
