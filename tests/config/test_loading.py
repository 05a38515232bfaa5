"""Config loading: files, overrides, packaged configs and options of components."""

import re
from operator import attrgetter
from pathlib import Path

import pytest
import yaml
from pydantic import BaseModel

from paths import ROOT
from vjepa2_ac.config import AdapterConfig
from vjepa2_ac.config.loading import (
    all_keys,
    config_as_yaml,
    config_path,
    config_schema,
    load_config,
    load_config_of_run,
    packaged_configs,
    parse_config,
)
from vjepa2_ac.errors import InputError
from vjepa2_ac.registry import ENERGIES, LOSSES, PLANNERS, TRACKERS, TRANSFORMS, Registry

MINIMAL = {"run_dir": "runs/x", "data": {"path": "d"}, "model": {"base": "b.pt"}}


def write(folder: Path, text: str) -> Path:
    path = folder / "config.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("path", sorted((ROOT / "configs").glob("*.yaml")), ids=lambda p: p.name)
def test_every_packaged_config_loads_without_an_alpha_warning(path: Path) -> None:
    assert load_config(path).adapter.alpha_warning is None


def test_large_alpha_with_rslora_gives_a_warning() -> None:
    warning = AdapterConfig(rank=64, alpha=128).alpha_warning
    assert "a scale of 16; alpha 32 gives 4" in warning
    assert "Set adapter.alpha=32" in warning
    for values in (
        {"rank": 64},
        {"rank": 4, "alpha": 8},
        {"alpha": 128, "rslora": False},
        {"kind": "none", "alpha": 128},
    ):
        assert AdapterConfig.model_validate(values).alpha_warning is None


@pytest.mark.parametrize("adapter", [{"modules_to_save": ["state_encoder"]}, {"targets": ["q", "state_encoder"]}])
def test_adapter_on_the_state_encoder_of_a_model_without_states_raises(adapter: dict[str, object]) -> None:
    model = {"base": "b.pt", "sizes": {"predictor": {"use_states": False}}}
    with pytest.raises(
        InputError, match=rf"adapter\.{next(iter(adapter))}: with predictor.use_states: false there is no state_encoder"
    ):
        parse_config({**MINIMAL, "model": model, "adapter": adapter}, where="here")
    parse_config({**MINIMAL, "model": model, "adapter": {"modules_to_save": ["action_encoder"]}}, where="here")
    parse_config({**MINIMAL, "adapter": adapter}, where="here")


def test_resolved_config_loads_as_an_equal_config(tmp_path: Path) -> None:
    config = parse_config(MINIMAL, where="here")
    assert load_config(write(tmp_path, config_as_yaml(config))) == config


def test_overrides_set_nested_keys_and_accept_scientific_notation(tmp_path: Path) -> None:
    path = write(tmp_path, yaml.safe_dump(MINIMAL))
    config = load_config(
        path, ["training.learning_rate=3e-4", "adapter.targets=[q, v]", "data.fields.gripper_open=0.5"]
    )
    assert config.training.learning_rate == 3e-4
    assert config.adapter.targets == ("q", "v")
    assert config.data.fields.gripper_open == 0.5


@pytest.mark.parametrize("literal", ["22008760", '"22008760"'])
def test_camera_serial_number_is_read_as_text_with_and_without_quotes(tmp_path: Path, literal: str) -> None:
    path = write(tmp_path, yaml.safe_dump(MINIMAL))
    for camera in (f"data.camera={literal}", f"data.camera=[{literal}]"):
        assert load_config(path, ["data.source=droid_raw", camera]).data.cameras == ("22008760",)


def test_option_names_that_yaml_reads_as_booleans_stay_text(tmp_path: Path) -> None:
    path, sections = write(tmp_path, yaml.safe_dump(MINIMAL)), config_schema()["$defs"]
    checked_keys = []
    for key in all_keys():
        outer, _, name = key.rpartition(".")
        properties = (section.get("properties", {}) for section in sections.values())
        schema = next((schemas[name] for schemas in properties if name in schemas), {})
        for word in schema.get("enum", ()):
            if outer and yaml.safe_load(str(word)) != word:
                required = ["replay.data.path=d"] * key.startswith("replay.")
                assert attrgetter(key)(load_config(path, [f"{key}={word}", *required])) == word
                checked_keys.append(key)
    assert {"data.cache", "training.compile", "planning.compile"} <= set(checked_keys)


@pytest.mark.parametrize("text", ["", "- a list", "{unclosed", "run_dir: a\nrun_dir: b"])
def test_invalid_or_missing_config_file_raises_with_its_path(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError, match=r"config\.yaml"):
        load_config(write(tmp_path, text))
    with pytest.raises(InputError, match=r"nowhere\.yaml"):
        load_config(tmp_path / "nowhere.yaml")


def test_override_of_data_source_removes_options_of_the_former_format(tmp_path: Path) -> None:
    resolved = config_as_yaml(parse_config(MINIMAL, where=""))
    assert "fields:" in resolved
    cached = load_config(write(tmp_path, resolved), ["data.source=latents", "data.path=cache"])
    assert (cached.data.source, cached.data.is_cache) == ("latents", True)
    ported = load_config(write(tmp_path, resolved), ["data.lerobot.gripper_open=2", "data.source=lerobot"])
    assert ported.data.lerobot.gripper_open == 2
    with pytest.raises(InputError, match=r"data\.lerobot: only for source lerobot, and this is source rlds"):
        load_config(write(tmp_path, resolved), ["data.lerobot.gripper_open=2"])


def test_every_config_key_is_read() -> None:
    source = "\n".join(path.read_text() for path in (ROOT / "src").rglob("*.py"))
    read = {(owner.removeprefix("_"), name) for owner, name in re.findall(r"(\w+)(?=\.(\w+))", source)}
    for key in set(all_keys()) - {"plugins"}:  # plug-ins are read before the config is validated
        *sections, name = key.split(".")
        owners = ["config", "sizes", "self", "fields", *sections[-1:]]
        assert any((owner, name) in read for owner in owners), f"{key} is not read by any module"


@pytest.mark.parametrize(
    "name", ["1e-4", "010", "1:30", "2024-01-01", "089", "on", "null", "0x1F", "1_0", "=", "é #: ü"]
)
def test_text_that_looks_like_a_number_stays_text_in_yaml(tmp_path: Path, name: str) -> None:
    config = parse_config(MINIMAL | {"run_dir": name, "data": {"path": "d", "exclude": [name]}}, where="")
    assert load_config(write(tmp_path, config_as_yaml(config))) == config


# ---- configs of the package ----


def test_packaged_configs_equal_the_configs_folder() -> None:
    assert list(packaged_configs()) == sorted(path.stem for path in (ROOT / "configs").glob("*.yaml"))
    assert load_config("builtin:demo") == load_config(ROOT / "configs/demo.yaml")
    assert all(packaged_configs().values())


@pytest.mark.parametrize("name", ["nothing", "", "../sim-tiny/config", "demo.yaml", "/etc/passwd"])
def test_unknown_packaged_config_raises_with_the_available_names(name: str) -> None:
    with pytest.raises(
        InputError, match=r"the package has no config of this name.*builtin:demo, .*builtin:scratch_vitl"
    ):
        config_path(f"builtin:{name}")


@pytest.mark.parametrize(("older", "values"), [("closedness", (0.0, 1.0)), ("openness", (1.0, 0.0))])
def test_gripper_key_of_an_older_run_is_read(older: str, values: tuple[float, float]) -> None:
    data = {"source": "rlds", "path": "x", "fields": {"gripper": older, "control_rate_hz": 5.0}}
    config = parse_config({"run_dir": "none", "data": data, "model": {"base": "builtin:sim-tiny"}}, where="x").data
    assert (config.fields.gripper_open, config.fields.gripper_closed) == values
    assert config.fields.control_rate_hz == 5.0


class AlphaOptions(BaseModel, extra="forbid"):
    alpha: float


class WithAlpha:
    Config = AlphaOptions


WRONG_OPTION = {"name": "mine", "options": {"alphaa": 1}}


@pytest.mark.parametrize(
    ("registry", "section", "values"),
    [
        (LOSSES, "training.loss.options", {"loss": WRONG_OPTION}),
        (PLANNERS, "planning.planner.options", {"planner": WRONG_OPTION}),
        (ENERGIES, "planning.energy.distance.options", {"energy": {"distance": WRONG_OPTION}}),
        (TRACKERS, "tracking.others.mine", {"others": {"mine": {"alphaa": 1}}}),
        (TRANSFORMS, "data.transforms.0.options", {"transforms": [WRONG_OPTION]}),
    ],
)
def test_wrong_option_error_has_the_dotted_key(
    monkeypatch: pytest.MonkeyPatch, registry: Registry, section: str, values: dict
) -> None:
    monkeypatch.setitem(registry._things, "mine", WithAlpha)
    name = section.partition(".")[0]
    with pytest.raises(InputError) as caught:
        parse_config(MINIMAL | {name: {**MINIMAL.get(name, {}), **values}}, where="x.yaml")
    lines = str(caught.value).splitlines()
    assert f"  {section}.alphaa: unknown key; did you mean alpha?" in lines
    assert f"  {section}.alpha: missing; it has no default" in lines


def test_missing_required_options_raise_without_any_options(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(LOSSES._things, "mine", WithAlpha)
    with pytest.raises(InputError, match=r"training\.loss\.options\.alpha: missing"):
        parse_config(MINIMAL | {"training": {"loss": "mine"}}, where="x.yaml")
    with pytest.raises(InputError, match=r"training\.loss: loss 'l1' has no options of its own"):
        parse_config(MINIMAL | {"training": {"loss": {"options": {"a": 1}}}}, where="x.yaml")


def test_config_larger_than_a_megabyte_raises_before_parsing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vjepa2_ac.config.loading.parse_yaml", lambda *_, **__: pytest.fail("parsed"))
    path = tmp_path / "config.yaml"
    path.write_text("#" * 1_000_001)
    for read in (load_config, load_config_of_run):
        with pytest.raises(InputError, match=r"too large.*at most 1,000,000 bytes"):
            read(path)


def test_preset_sets_the_size_of_the_search_at_its_position_among_the_overrides() -> None:
    def sizes(*overrides: str) -> tuple[int, int]:
        planning = parse_config(MINIMAL, overrides, where="here").planning
        return planning.samples, planning.iterations

    assert sizes("planning.preset=paper") == (800, 10)
    assert sizes("planning.preset=fast") == (64, 4)
    assert sizes("planning.preset=fast", "planning.iterations=2") == (64, 2)
    assert sizes("planning.iterations=2", "planning.preset=fast") == (64, 4)
    with pytest.raises(InputError, match=r"planning.preset=quick.*no preset.*one of fast, paper"):
        sizes("planning.preset=quick")
