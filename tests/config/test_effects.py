"""Each knob says what it affects; when it changes, that becomes another one, and nothing else does."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, get_args, get_origin

import pytest
import yaml
from pydantic import BaseModel

from copied_sets import WRITERS
from run_fixtures import TINY
from vjepa2_ac.config import Config, DataConfig, EncoderConfig, ModelSizes
from vjepa2_ac.config.loading import changed_keys, config_as_dict, config_as_yaml, parse_config
from vjepa2_ac.config.section import Affects, Component, Section, collect_effects, get_effect, values_that_affect
from vjepa2_ac.data import idle as idle_ranges
from vjepa2_ac.data.index import EpisodeInfo, EpisodeTable
from vjepa2_ac.data.sources.indexed_source import open_source
from vjepa2_ac.data.sources.latents import build_cache_key
from vjepa2_ac.encoding.batch import get_encoding
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.settings import USED_KEYS, load_planning_config
from vjepa2_ac.runs.folder import check_run_folder, open_run_folder

# What cannot be guessed from a knob's type, or must exist in the data set.
SECTIONS = {"model.encoder": EncoderConfig(path="encoder.pt")}  # of knobs that are null: those without a default
OTHERS = {
    "planning.limits.workspace": ((0.3, -0.3, 0.1), (0.6, 0.3, 0.5)),
    "data.camera": {"npz": "pixels", "rlds": "wrist_left", "lerobot": "wrist_left", "droid_raw": "right"},
    "data.path": "elsewhere",
    "data.transforms": (Component("noise"),),
    "planning.budget_s": 1.0,
    "planning.limits.l1": 0.1,
    "planning.planner": Component("icem"),
    "planning.energy.distance": Component("l2"),
    "training.loss": Component("l2"),
    "tracking.others": {"a tracker": {}},
    "planning.limits.axes": (0.1,),
    "data.idle.ranges": "ranges.json",
    "data.fields.cameras": {"exterior_1_left": "steps/observation/exterior_image_2_left"},
    "data.lerobot.state": ("observation.state.gripper_position", "observation.state.cartesian_position"),
    "data.lerobot.action": ("observation.state.gripper_position",),
    "data.fields.action": ("steps/action_dict/joint_velocity",),
    "data.lerobot.cameras": {
        "exterior_1_left": "observation.images.exterior_1_left", "wrist": "observation.images.exterior_1_left"
    },
    "data.lerobot.select": (6, 5, 4, 3, 2, 1, 0),
    "data.fields.select": (6, 5, 4, 3, 2, 1, 0),
}  # fmt: skip
ONLY_REMOTE = {"data.outcome"}  # where reading the episodes costs something
OF_THE_INDEX = {"camera", "states", "actions", "pose_frame"}
NOT_OF_THE_INDEX = {"fields.language", "fields.joint_velocity", "fields.control_rate_hz"}


class Found(Exception):  # noqa: N818 - it carries what was asked for
    """A key, found where it is about to be used."""


def literals(annotation: Any) -> list[Any]:
    if get_origin(annotation) is Literal:
        return list(get_args(annotation))
    return [one for inner in get_args(annotation) for one in literals(inner)]


def another(value: Any, annotation: Any) -> Any:
    """Return another value of the kind of this one."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int | float):
        return value + 1 if isinstance(value, int) else value / 2 or 0.5
    options = [one for one in literals(annotation) if one != value]
    if isinstance(value, tuple) and value and isinstance(value[0], float):
        return (value[0] / 2, *value[1:])
    if isinstance(value, tuple):
        return value[:-1] or tuple(options[:1]) or ("else",)
    if isinstance(value, dict):
        return {**value, "else": 3}
    if any(int in (inner, *get_args(inner)) for inner in get_args(annotation)):
        return 5
    return options[-1] if options else "else"


def absent(annotation: Any) -> Any:
    """Return the section of a knob that is null."""
    return next(one for one in get_args(annotation) if one)()


def with_other(section: BaseModel, key: str, whole: str, source: str) -> BaseModel:
    """Return a section in which one knob has another value; what does not fit to it stays."""
    name, _, rest = key.partition(".")
    value, field = getattr(section, name), type(section).model_fields[name]
    if rest and not isinstance(value, tuple):
        inner = value if value is not None else SECTIONS.get(whole.rpartition(".")[0]) or absent(field.annotation)
        return section.model_copy(update={name: with_other(inner, rest, whole, source)})
    given = OTHERS.get(whole.removesuffix(f".{rest}"), another(value, field.annotation))
    return section.model_copy(update={name: given[source] if whole == "data.camera" else given})


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("sets")
    return {name: write(root / name, [0, 1]) for name, write in WRITERS.items()}


def recorded_by(source: str) -> dict[str, Any]:
    """Return the knobs of vectors and the commands recorded with them."""
    action = {"lerobot": {"action": ["action.joint_velocity"]}} if source == "lerobot" else {}
    return {"states": "vector", "actions": "recorded", "join_actions": "last", **action}


def config_of(source: str, path: str | Path, run_dir: Path, **data: Any) -> Config:
    data = {"source": source, "path": str(path), "frames": 3, "workers": 0, "idle": {"rule": "none"}, **data}
    return parse_config({"run_dir": str(run_dir), "data": data, "model": {"base": "base"}}, where="")


def parse_adapter_config(config: Config) -> set[str]:
    """Return the knobs that a config of its form of data has."""
    foreign = set(DataConfig.kinds.values()) - {type(config.data)}
    names = ("replay.", *(f"data.{name}." for kind in foreign for name in kind.format_sections()))  # see test_replay.py
    return {key for key in collect_effects(Config) if not key.startswith(names)}


@cache
def world_model() -> WorldModel:
    return WorldModel.random(ModelSizes.model_validate(TINY), seed=0)


@pytest.fixture
def keys_of(monkeypatch: pytest.MonkeyPatch) -> Callable[[Config], dict[str, str | None]]:
    """Return the keys by which index, idle ranges and latents of a config are looked for; None: the data refuse it."""

    def stop(_: Any, keys: Any, *__: Any, **___: Any) -> None:
        raise Found(keys)

    for source in WRITERS:
        monkeypatch.setattr(f"vjepa2_ac.data.sources.{source}.get_or_build_index", stop)
    monkeypatch.setattr(idle_ranges, "get_or_build", stop)

    def found(action: Callable[[], Any]) -> Any:
        with pytest.raises(Found) as caught:
            action()
        return caught.value.args[0]

    def keys(config: Config) -> dict[str, str | None]:
        try:
            index: str = found(lambda: open_source(config.data).infos())
        except InputError:
            return dict.fromkeys(("index", "idle", "latents"))
        table = replace(EpisodeTable.from_infos([EpisodeInfo("one", 9, None)]), texts={"index": index})
        ranges = found(lambda: idle_ranges.find_ranges(open_source(config.data), table, config.data, None))
        latents = build_cache_key(config.data, index, get_encoding(world_model(), config))
        return {"index": index, "idle": ranges, "latents": latents.digest}

    return keys


def test_config_key_without_affects_annotation_raises() -> None:
    class Forgotten(Section):
        batch: Annotated[int, Affects.RUN] = 1
        workers: int = 1

    with pytest.raises(TypeError, match=r"workers: not annotated with what it affects"):
        values_that_affect(Affects.RUN, Forgotten())


def test_the_options_of_a_plug_in_are_a_part_of_the_key_of_a_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DataConfig, "kinds", dict(DataConfig.kinds))

    class WallOptions(Section):
        size: int = 32

    class WallData(DataConfig):
        source: Literal["wall"] = "wall"
        wall: WallOptions = WallOptions()
        first_camera: ClassVar[str] = "front"

    encoding = get_encoding(world_model(), config_of("rlds", "x", Path()))
    options = (WallOptions(size=size) for size in (32, 64))
    keys = [build_cache_key(WallData(path="x", wall=wall), "its episodes", encoding) for wall in options]
    assert keys[0].digest != keys[1].digest


@pytest.mark.parametrize("states", ["pose", "vector"])
@pytest.mark.parametrize("source", WRITERS)
def test_changed_key_invalidates_exactly_what_it_affects(
    source: str, states: str, sets: dict[str, Path], keys_of: Callable[[Config], dict[str, str | None]], tmp_path: Path
) -> None:
    if (source, states) == ("droid_raw", "vector"):
        pytest.skip("raw DROID has poses")
    config = config_of(source, sets[source], tmp_path, **(recorded_by(source) if states == "vector" else {}))
    usual, own = keys_of(config), tuple(f"data.{name}." for name in config.data.format_sections())
    assert None not in usual.values()
    changed: dict[str, set[str]] = {}
    for key in parse_adapter_config(config) - {"data.source", "data.path"} - ONLY_REMOTE:
        found = keys_of(with_other(config, key, key, source))
        if None not in found.values():  # else refused, not mistaken
            changed[key] = {name for name in usual if found[name] != usual[name]}
    for key, names in changed.items():
        name, is_latents = key.removeprefix("data."), Affects.LATENTS in collect_effects(Config)[key]
        is_index = name in OF_THE_INDEX or (key.startswith(own) and name not in NOT_OF_THE_INDEX)
        assert names <= {"latents"} or is_latents, key
        assert "latents" in names or not is_latents, key
        assert "index" not in names or is_index, key
        assert ("idle" in names) == ("index" in names or key.startswith((*own, "data.idle."))), key
    assert {key for key, names in changed.items() if "index" in names}
    assert len(changed) > 50


@pytest.mark.parametrize("source", WRITERS)
def test_a_data_set_that_was_moved_is_the_same_and_one_that_changed_is_another(
    source: str, sets: dict[str, Path], keys_of: Callable[[Config], dict[str, str | None]], tmp_path: Path
) -> None:
    shutil.copytree(sets[source], tmp_path / "moved", copy_function=shutil.copy2)
    here, there = (config_of(source, path, tmp_path) for path in (sets[source], tmp_path / "moved"))
    assert keys_of(there) == keys_of(here)
    largest = max((tmp_path / "moved").rglob("*.*"), key=lambda path: path.stat().st_size)
    largest.touch()
    assert keys_of(there)["index"] != keys_of(here)["index"]


def with_encoder(config: Config) -> Config:
    """Return a config whose base comes without an encoder: both of its paths may be moved."""
    model = config.model.model_copy(update={"encoder": SECTIONS["model.encoder"]})
    return config.model_copy(update={"model": model})


def test_settings_of_a_later_start_are_kept_in_the_run_unless_they_decide_it(tmp_path: Path) -> None:
    config = with_encoder(config_of("rlds", tmp_path, tmp_path / "run"))
    open_run_folder(config, "name")
    file, written, kept = tmp_path / "run/config.yaml", config_as_yaml(config), 0
    keys = [
        key
        for key in parse_adapter_config(config) - {"run_dir", "data.source"}
        if Affects.RUN not in collect_effects(Config)[key]
    ]
    for section in {key.partition(".")[0] for key in keys}:
        start = config
        for key in keys:
            start = with_other(start, key, key, "rlds") if key.startswith(section) else start
        file.write_text(written)
        open_run_folder(start, "name")
        assert yaml.safe_load(file.read_text()) == config_as_dict(start)
        changes = json.loads((tmp_path / "run/environment.json").read_text())[-1]["config_changes"]
        assert len(changes) == len(changed_keys(config, start)), "what held before is recorded"
        kept += len(changes)
    assert kept > 50


def test_run_resumes_only_if_no_key_that_affects_it_has_changed(tmp_path: Path) -> None:
    config = with_encoder(config_of("rlds", tmp_path, tmp_path / "run"))
    (tmp_path / "run").mkdir()
    (tmp_path / "run/config.yaml").write_text(config_as_yaml(config))
    check_run_folder(config)
    for key in parse_adapter_config(config):
        other = with_other(config, key, key, "rlds")
        if key in {"run_dir", "data.source"} or not changed_keys(config, other):
            continue
        if Affects.RUN in collect_effects(Config)[key]:
            with pytest.raises(InputError, match=f"differs in .*{key.partition('.')[0]}"):
                check_run_folder(other)
        else:
            check_run_folder(other)


def test_planning_takes_the_values_that_affect_a_decision_and_names_them() -> None:
    for key, mark in collect_effects(Config).items():
        named = key in USED_KEYS or key.startswith(
            tuple(one.removesuffix("…") for one in USED_KEYS if one.endswith("…"))
        )
        assert (Affects.PLAN in mark) == named, key
        if Affects.PLAN not in mark:
            with pytest.raises(InputError, match=r"planning does not use.*model\.sizes\.…, model\.dtype"):
                load_planning_config("model.pt", overrides=[f"{key}=1"])


def test_annotation_of_a_section_applies_to_its_keys_and_their_values() -> None:
    assert get_effect("tracking.wandb", Config) == Affects.NOTHING
    assert get_effect("data.fields.cameras.left", Config) == get_effect("data.fields.cameras", Config) == Affects.CLIPS
    assert get_effect("replay.data.frames", Config) == get_effect("replay.data", Config) == Affects.RUN
    assert get_effect("replay.data.path", Config) == Affects.NOTHING
    assert get_effect("training", Config) == Affects.RUN | Affects.LATENTS | Affects.PLAN
    with pytest.raises(KeyError):
        get_effect("nothing.of.the.kind", Config)


def test_the_values_that_affect_something_are_given_with_their_values(tmp_path: Path) -> None:
    config = config_of("rlds", tmp_path, tmp_path)
    found = values_that_affect(Affects.PLAN, config)
    assert sorted(found) == ["data", "model", "planning", "seed", "training"]
    assert found["training"] == {"device": "auto"}
    assert found["data"] == {"stride": 4, "crop": "released"}
