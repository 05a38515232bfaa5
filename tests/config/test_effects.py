"""Each config key is annotated with what it affects: changing the key invalidates this, and nothing else."""

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

# Values that cannot be derived from the type of a key, or must exist in the data set.
SECTIONS = {
    "model.encoder": EncoderConfig(path="encoder.pt")
}  # sections that are null by default and have required keys
OTHER_VALUES = {
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
ONLY_REMOTE = {"data.outcome"}  # keys that are read only if reading the episodes is expensive
INDEX_KEYS = {"camera", "states", "actions", "pose_frame"}
NON_INDEX_KEYS = {"fields.language", "fields.joint_velocity", "fields.control_rate_hz"}


class LookedUp(Exception):  # noqa: N818 - it carries a value and is not an error
    """Raised instead of a look-up of an index or of idle ranges; carries the key."""


def literal_values(annotation: Any) -> list[Any]:
    if get_origin(annotation) is Literal:
        return list(get_args(annotation))
    return [value for inner in get_args(annotation) for value in literal_values(inner)]


def other_value(value: Any, annotation: Any) -> Any:
    """Return another value of the same type."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int | float):
        return value + 1 if isinstance(value, int) else value / 2 or 0.5
    options = [option for option in literal_values(annotation) if option != value]
    if isinstance(value, tuple) and value and isinstance(value[0], float):
        return (value[0] / 2, *value[1:])
    if isinstance(value, tuple):
        return value[:-1] or tuple(options[:1]) or ("else",)
    if isinstance(value, dict):
        return {**value, "else": 3}
    if any(int in (inner, *get_args(inner)) for inner in get_args(annotation)):
        return 5
    return options[-1] if options else "else"


def default_section(annotation: Any) -> Any:
    """Return a section with default values for a key that is null."""
    return next(kind for kind in get_args(annotation) if kind)()


def with_other_value(section: BaseModel, key: str, full_key: str, source: str) -> BaseModel:
    """Return a section in which one key has another value; the result is not validated."""
    name, _, rest = key.partition(".")
    value, field = getattr(section, name), type(section).model_fields[name]
    if rest and not isinstance(value, tuple):
        inner = (
            value
            if value is not None
            else SECTIONS.get(full_key.rpartition(".")[0]) or default_section(field.annotation)
        )
        return section.model_copy(update={name: with_other_value(inner, rest, full_key, source)})
    changed = OTHER_VALUES.get(full_key.removesuffix(f".{rest}"), other_value(value, field.annotation))
    return section.model_copy(update={name: changed[source] if full_key == "data.camera" else changed})


@pytest.fixture(scope="module")
def data_sets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("sets")
    return {name: write(root / name, [0, 1]) for name, write in WRITERS.items()}


def vector_options(source: str) -> dict[str, Any]:
    """Return the options for state vectors and recorded actions."""
    action = {"lerobot": {"action": ["action.joint_velocity"]}} if source == "lerobot" else {}
    return {"states": "vector", "actions": "recorded", "join_actions": "last", **action}


def config_of(source: str, path: str | Path, run_dir: Path, **data: Any) -> Config:
    data = {"source": source, "path": str(path), "frames": 3, "workers": 0, "idle": {"rule": "none"}, **data}
    return parse_config({"run_dir": str(run_dir), "data": data, "model": {"base": "base"}}, where="")


def config_keys(config: Config) -> set[str]:
    """Return the keys of a config with its data format."""
    other_formats = set(DataConfig.kinds.values()) - {type(config.data)}
    names = (
        "replay.",
        *(f"data.{name}." for kind in other_formats for name in kind.format_sections()),
    )  # see test_replay.py
    return {key for key in collect_effects(Config) if not key.startswith(names)}


@cache
def world_model() -> WorldModel:
    return WorldModel.random(ModelSizes.model_validate(TINY), seed=0)


@pytest.fixture
def keys_of(monkeypatch: pytest.MonkeyPatch) -> Callable[[Config], dict[str, str | None]]:
    """Return the lookup keys of index, idle ranges and latents for a config; None if the config is rejected."""

    def stop(_: Any, keys: Any, *__: Any, **___: Any) -> None:
        raise LookedUp(keys)

    for source in WRITERS:
        monkeypatch.setattr(f"vjepa2_ac.data.sources.{source}.get_or_build_index", stop)
    monkeypatch.setattr(idle_ranges, "get_or_build", stop)

    def key_of_lookup(action: Callable[[], Any]) -> Any:
        with pytest.raises(LookedUp) as caught:
            action()
        return caught.value.args[0]

    def keys(config: Config) -> dict[str, str | None]:
        try:
            index: str = key_of_lookup(lambda: open_source(config.data).infos())
        except InputError:
            return dict.fromkeys(("index", "idle", "latents"))
        table = replace(EpisodeTable.from_infos([EpisodeInfo("one", 9, None)]), texts={"index": index})
        ranges = key_of_lookup(lambda: idle_ranges.find_ranges(open_source(config.data), table, config.data, None))
        latents = build_cache_key(config.data, index, get_encoding(world_model(), config))
        return {"index": index, "idle": ranges, "latents": latents.digest}

    return keys


def test_config_key_without_affects_annotation_raises() -> None:
    class Unannotated(Section):
        batch: Annotated[int, Affects.RUN] = 1
        workers: int = 1

    with pytest.raises(TypeError, match=r"workers: not annotated with what it affects"):
        values_that_affect(Affects.RUN, Unannotated())


def test_options_of_a_plugin_data_format_change_the_cache_key(monkeypatch: pytest.MonkeyPatch) -> None:
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
    source: str,
    states: str,
    data_sets: dict[str, Path],
    keys_of: Callable[[Config], dict[str, str | None]],
    tmp_path: Path,
) -> None:
    if (source, states) == ("droid_raw", "vector"):
        pytest.skip("raw DROID has poses")
    config = config_of(source, data_sets[source], tmp_path, **(vector_options(source) if states == "vector" else {}))
    old, format_keys = keys_of(config), tuple(f"data.{name}." for name in config.data.format_sections())
    assert None not in old.values()
    changed: dict[str, set[str]] = {}
    for key in config_keys(config) - {"data.source", "data.path"} - ONLY_REMOTE:
        new = keys_of(with_other_value(config, key, key, source))
        if None not in new.values():  # no value was rejected
            changed[key] = {name for name in old if new[name] != old[name]}
    for key, names in changed.items():
        name, is_latents = key.removeprefix("data."), Affects.LATENTS in collect_effects(Config)[key]
        is_index = name in INDEX_KEYS or (key.startswith(format_keys) and name not in NON_INDEX_KEYS)
        assert names <= {"latents"} or is_latents, key
        assert "latents" in names or not is_latents, key
        assert "index" not in names or is_index, key
        assert ("idle" in names) == ("index" in names or key.startswith((*format_keys, "data.idle."))), key
    assert {key for key, names in changed.items() if "index" in names}
    assert len(changed) > 50


@pytest.mark.parametrize("source", WRITERS)
def test_moved_data_set_keeps_its_keys_and_a_changed_one_does_not(
    source: str, data_sets: dict[str, Path], keys_of: Callable[[Config], dict[str, str | None]], tmp_path: Path
) -> None:
    shutil.copytree(data_sets[source], tmp_path / "moved", copy_function=shutil.copy2)
    original, moved = (config_of(source, path, tmp_path) for path in (data_sets[source], tmp_path / "moved"))
    assert keys_of(moved) == keys_of(original)
    largest = max((tmp_path / "moved").rglob("*.*"), key=lambda path: path.stat().st_size)
    largest.touch()
    assert keys_of(moved)["index"] != keys_of(original)["index"]


def with_encoder(config: Config) -> Config:
    """Return a config whose base model has no encoder, so that two paths can be changed."""
    model = config.model.model_copy(update={"encoder": SECTIONS["model.encoder"]})
    return config.model_copy(update={"model": model})


def test_changed_keys_without_effect_on_the_run_are_saved_and_recorded_at_resume(tmp_path: Path) -> None:
    config = with_encoder(config_of("rlds", tmp_path, tmp_path / "run"))
    open_run_folder(config, "name")
    file, saved, num_changes = tmp_path / "run/config.yaml", config_as_yaml(config), 0
    keys = [
        key
        for key in config_keys(config) - {"run_dir", "data.source"}
        if Affects.RUN not in collect_effects(Config)[key]
    ]
    for section in {key.partition(".")[0] for key in keys}:
        start = config
        for key in keys:
            start = with_other_value(start, key, key, "rlds") if key.startswith(section) else start
        file.write_text(saved)
        open_run_folder(start, "name")
        assert yaml.safe_load(file.read_text()) == config_as_dict(start)
        changes = json.loads((tmp_path / "run/environment.json").read_text())[-1]["config_changes"]
        assert len(changes) == len(changed_keys(config, start)), "every changed key must be recorded"
        num_changes += len(changes)
    assert num_changes > 50


def test_run_resumes_only_if_no_key_that_affects_it_has_changed(tmp_path: Path) -> None:
    config = with_encoder(config_of("rlds", tmp_path, tmp_path / "run"))
    (tmp_path / "run").mkdir()
    (tmp_path / "run/config.yaml").write_text(config_as_yaml(config))
    check_run_folder(config)
    for key in config_keys(config):
        other = with_other_value(config, key, key, "rlds")
        if key in {"run_dir", "data.source"} or not changed_keys(config, other):
            continue
        if Affects.RUN in collect_effects(Config)[key]:
            with pytest.raises(InputError, match=f"differs in .*{key.partition('.')[0]}"):
                check_run_folder(other)
        else:
            check_run_folder(other)


def test_planning_accepts_only_keys_that_affect_a_decision_and_lists_them() -> None:
    for key, effect in collect_effects(Config).items():
        prefixes = tuple(used.removesuffix("…") for used in USED_KEYS if used.endswith("…"))
        is_listed = key in USED_KEYS or key.startswith(prefixes)
        assert (Affects.PLAN in effect) == is_listed, key
        if Affects.PLAN not in effect:
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


def test_values_that_affect_planning_are_returned_by_section(tmp_path: Path) -> None:
    config = config_of("rlds", tmp_path, tmp_path)
    values = values_that_affect(Affects.PLAN, config)
    assert sorted(values) == ["data", "model", "planning", "seed", "training"]
    assert values["training"] == {"device": "auto"}
    assert values["data"] == {"stride": 4, "crop": "released"}
