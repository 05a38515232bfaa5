"""Every supported format is recognised; errors for other files name the supported formats and a converter."""

import json
from pathlib import Path
from typing import Any

import pytest

from copied_sets import WRITERS, write_lerobot
from rlds_sets import write_rlds_set
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.errors import InputError
from vjepa2_ac.init.dataset_properties import pick_camera
from vjepa2_ac.init.draft import Machine, choose_model, make_draft
from vjepa2_ac.init.draft_values import list_guesses, plain_values
from vjepa2_ac.init.recognize import add_episode_lengths, read_properties
from vjepa2_ac.storage.paths import SIMULATION_FILE

LAPTOP = Machine(None, 24 * 10**9, has_bf16=False, cores=2, free_bytes=10**11)
STATES = ["x", "y", "z", "roll", "pitch", "yaw", "gripper"]


def rename_dataset(folder: Path, name: str) -> Path:
    """Change the name of an RLDS data set in its description and its file names."""
    info = json.loads((folder / "dataset_info.json").read_text())
    for shard in folder.glob("*.tfrecord-*"):
        shard.rename(folder / shard.name.replace(info["name"], name))
    (folder / "dataset_info.json").write_text(json.dumps({**info, "name": name}))
    return folder


def make_draft_of(path: Path) -> tuple[dict[str, Any], dict[str, str], str]:
    """Return the section `data`, all guesses and the text of the drafted config for a data set."""
    properties = read_properties(str(path))
    draft = make_draft(properties, LAPTOP, choose_model("builtin:sim-tiny"), run_dir="run")
    return (
        plain_values(draft.config_values)["data"],
        list_guesses(draft.config_values),
        draft.to_yaml(properties, LAPTOP),
    )


@pytest.mark.parametrize("form", WRITERS)
def test_drafted_config_opens_the_data_set(form: str, tmp_path: Path) -> None:
    folder = WRITERS[form](tmp_path / "set", range(8))
    properties = add_episode_lengths(read_properties(str(folder)))
    assert (properties.source, properties.episodes, properties.steps, properties.median_steps) == (form, 8, 8 * 14, 14)
    config = make_draft(properties, LAPTOP, choose_model("builtin:sim-tiny"), run_dir="run").config
    dataset = open_dataset(config.data)
    assert len(dataset.windows("train")) > 0
    assert len(dataset.windows("validation")) > 0
    assert config.data.stride == 4


def test_newest_version_is_chosen_and_all_versions_are_listed(tmp_path: Path) -> None:
    for version in ("1.9.0", "1.10.0", "1.2.0"):
        WRITERS["rlds"](tmp_path / "my_robot" / version, range(3))
    for path in (tmp_path, tmp_path / "my_robot"):
        properties = read_properties(str(path))
        assert properties.path == str(tmp_path / "my_robot/1.10.0")
        assert properties.descriptions[-1] == "version 1.10.0, the newest of 1.2.0, 1.9.0, 1.10.0"
    chosen = read_properties(str(tmp_path / "my_robot/1.9.0"))
    assert (chosen.path, len(chosen.descriptions)) == (str(tmp_path / "my_robot/1.9.0"), 1)


@pytest.mark.parametrize(("first", "second"), [("lerobot", "lerobot"), ("rlds", "lerobot")])
def test_several_data_sets_in_a_folder_raise_and_are_listed(first: str, second: str, tmp_path: Path) -> None:
    WRITERS[first](tmp_path / "pick" / "1.0.0", range(2))
    WRITERS[second](tmp_path / "place", range(2))
    with pytest.raises(InputError, match=f"2 data sets: {tmp_path}/pick, {tmp_path}/place.*vjepa2-ac init {tmp_path}"):
        read_properties(str(tmp_path))


def test_states_without_a_pose_become_a_vector(tmp_path: Path) -> None:
    folder = write_lerobot(tmp_path / "set", range(3))
    info = json.loads((folder / "meta/info.json").read_text())
    joints = {"dtype": "float32", "shape": [6], "names": [f"joint_{number}" for number in range(6)]}
    cameras = {name: feature for name, feature in info["features"].items() if feature["dtype"] == "video"}
    info["features"] = cameras | {"observation.state": joints}
    (folder / "meta/info.json").write_text(json.dumps(info))
    properties = read_properties(str(folder))
    assert properties.states == "vector"
    assert plain_values(properties.config_values)["lerobot"]["state"] == ["observation.state"]
    assert "data.lerobot.state" in list_guesses({"data": properties.config_values})


@pytest.mark.parametrize("form", ["rlds", "lerobot"])
@pytest.mark.parametrize("features", [["wrist/rgb", "front/rgb"]])
def test_camera_of_the_config_maps_to_the_chosen_feature(form: str, features: list[str], tmp_path: Path) -> None:
    keys = [f"steps/observation/{name}" for name in features]
    if form == "rlds":
        kinds = dict.fromkeys(keys, ("uint8", (24, 32, 3), "jpeg"))
        state = {"steps/observation/state": ("float32", (7,)), "episode_metadata/file_path": "text"}
        folder = write_rlds_set(tmp_path / "set", [{}], {**kinds, **state})
    else:
        keys = [f"observation.images.{name.replace('/', '.')}" for name in features]
        folder = write_lerobot(tmp_path / "set", range(2))
        info = json.loads((folder / "meta/info.json").read_text())
        video = info["features"]["observation.images.wrist_left"]
        numbers = {name: feature for name, feature in info["features"].items() if feature["dtype"] != "video"}
        info["features"] = numbers | dict.fromkeys(keys, video)
        (folder / "meta/info.json").write_text(json.dumps(info))
    data, guessed, _ = make_draft_of(folder)
    cameras = data["fields" if form == "rlds" else "lerobot"]["cameras"]
    assert cameras[data["camera"]] == pick_camera(keys)
    assert sorted(cameras.values()) == sorted(keys)
    assert "data.camera" in guessed


def test_depth_maps_are_not_offered_as_cameras(tmp_path: Path) -> None:
    folder = write_lerobot(tmp_path / "set", range(3))
    info = json.loads((folder / "meta/info.json").read_text())
    keys = [name for name, feature in info["features"].items() if feature["dtype"] == "video"]
    for number, key in enumerate(keys):
        info["features"][key]["info"] = {"is_depth_map": True}
        (folder / "meta/info.json").write_text(json.dumps(info))
        if number < len(keys) - 1:
            properties = read_properties(str(folder))
            assert key in properties.descriptions[1]
            assert key not in plain_values(properties.config_values)["lerobot"]["cameras"].values()
    with pytest.raises(InputError, match="no camera, only depth maps"):
        read_properties(str(folder))


def test_data_set_with_droids_features_is_treated_as_droid_only_with_droids_name(tmp_path: Path) -> None:
    folder = WRITERS["rlds"](tmp_path / "bridge/1.0.0", range(3))
    for name in ("r2d2_faceblur", "droid_101"):
        data, guessed, text = make_draft_of(rename_dataset(folder, name))
        assert (data["stride"], data["camera"], "fields" in data) == (4, "exterior_1_left", False)
        assert guessed == {}
        assert "RLDS (DROID), 3 episodes, 15 control steps per second" in text

    data, guessed, text = make_draft_of(rename_dataset(folder, "my_droid_like"))
    assert (data["fields"]["control_rate_hz"], data["fields"]["gripper_open"], data["stride"]) == (15.0, 0.0, 4)
    assert {"data.fields.control_rate_hz", "data.fields.gripper_open", "data.stride", "data.camera"} <= set(guessed)
    assert data["idle"]["rule"] == "commands"
    assert "the released model was trained on this camera" not in text


def test_simulated_data_set_has_a_known_rate_and_is_not_described_as_droid(tmp_path: Path) -> None:
    folder = WRITERS["rlds"](tmp_path / "set", range(3))
    (folder / SIMULATION_FILE).write_text("{}")
    data, guessed, text = make_draft_of(folder)
    assert (data["stride"], guessed) == (4, {})
    assert "RLDS (simulated arm), 3 episodes, 15 control steps per second" in text
    assert "non-idle ranges" not in text


def test_lerobot_gripper_convention_is_known_only_for_droid_conversions(tmp_path: Path) -> None:
    folder = write_lerobot(tmp_path / "droid", range(3))
    assert "data.lerobot.gripper_open" in make_draft_of(folder)[1]
    info = json.loads((folder / "meta/info.json").read_text())
    text = {"dtype": "string", "shape": [1], "names": None}
    info["features"] |= {"building": text, "collector_id": text}
    (folder / "meta/info.json").write_text(json.dumps(info))
    assert "data.lerobot.gripper_open" not in make_draft_of(folder)[1]


@pytest.mark.parametrize(
    ("files", "needed"),
    [
        (["run_0.mcap"], "ros2_bag.py"),
        (["one/two/bag_0.db3"], "ros2_bag.py"),
        (["demo.mp4", "poses.csv"], "mp4_and_csv.py"),
        (["episode_0.hdf5"], "one .npz file per episode"),
        ([], "an empty folder"),
        (["notes.txt"], "notes.txt"),
    ],
)
def test_unsupported_files_raise_with_a_fix(files: list[str], needed: str, tmp_path: Path) -> None:
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(InputError, match=needed.replace(".", r"\.")) as raised:
        read_properties(str(tmp_path))
    assert "meta/info.json" in raised.value.needed


def test_hub_name_raises_with_the_hub_url(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"hf://datasets/someone/their_set"):
        read_properties("someone/their_set")


def test_path_of_a_file_raises_with_the_command_for_its_folder(tmp_path: Path) -> None:
    (tmp_path / "a.npz").touch()
    with pytest.raises(InputError, match=f"a file.*vjepa2-ac init {tmp_path}`"):
        read_properties(str(tmp_path / "a.npz"))


def test_empty_folder_raises_without_advice_on_conversion(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="an empty folder") as raised:
        read_properties(str(tmp_path))
    assert not raised.value.fix
