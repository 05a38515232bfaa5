"""Config loading: every knob once, all errors at once."""

import os
import re
import textwrap
import threading
from operator import attrgetter
from pathlib import Path

import pytest
import yaml

from paths import ROOT
from vjepa2_ac.config import AdapterConfig, CheckpointConfig, Config, DataConfig, IdleConfig
from vjepa2_ac.config.diagnostics import all_keys
from vjepa2_ac.config.loading import (
    changed_keys,
    config_as_dict,
    config_as_yaml,
    config_schema,
    gone_in_use,
    load_config,
    load_config_of_run,
    parse_config,
)
from vjepa2_ac.errors import InputError

MINIMAL = {"run_dir": "runs/x", "data": {"path": "d"}, "model": {"base": "b.pt"}}


def write(folder: Path, text: str) -> Path:
    path = folder / "config.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("path", sorted((ROOT / "configs").glob("*.yaml")), ids=lambda p: p.name)
def test_every_config_of_the_project_loads(path: Path) -> None:
    load_config(path)


def test_default_config_holds_the_mission() -> None:
    config = load_config(ROOT / "configs/default.yaml")
    assert (config.adapter.rank, config.adapter.alpha, config.adapter.rslora) == (16, 32, True)
    assert (config.training.batch_size, config.training.accumulation, config.training.steps) == (4, 8, 100_000)
    assert (config.training.learning_rate, config.training.precision) == (1e-4, "bf16")
    assert (config.data.frames, config.model.sizes.image_size) == (16, 256)
    assert (config.checkpoint.every, config.checkpoint.keep) == (1_000, 5)


@pytest.mark.parametrize(
    ("knobs", "warned"),
    [
        ({"rank": 64, "alpha": 128}, True),
        ({"rank": 32, "alpha": 64}, True),
        ({"rank": 64, "alpha": 32}, False),
        ({"rank": 4, "alpha": 32}, False),
        ({"rank": 4, "alpha": 8}, False),
        ({"rank": 64, "alpha": 128, "rslora": False}, False),
        ({"kind": "none", "alpha": 128}, False),
    ],
)
def test_an_alpha_that_grows_with_the_rank_under_rslora_is_out_of_line(knobs: dict[str, object], warned: bool) -> None:
    found = AdapterConfig.model_validate(knobs).out_of_line
    assert (found is not None) == warned
    if found is not None:
        assert f"a scale of {knobs['alpha'] / knobs['rank'] ** 0.5:.3g}, alpha 32 one of" in found
        assert "Take adapter.alpha=32" in found


def test_no_config_of_the_project_is_out_of_line() -> None:
    for path in (ROOT / "configs").glob("*.yaml"):
        assert load_config(path).adapter.out_of_line is None, path


def test_the_config_for_a_few_demonstrations_holds_its_recipe(tmp_path: Path) -> None:
    config = load_config(ROOT / "configs/own_robot.yaml")
    adapter, training = config.adapter, config.training
    assert (adapter.rank, adapter.alpha, adapter.rslora) == (32, 32, True)
    assert set(adapter.modules_to_save) == {"predictor_embed", "predictor_proj", "action_encoder", "state_encoder"}
    assert training.steps * training.batch_size * training.accumulation == 16_000
    assert config.validation.every * 10 == training.steps
    assert (config.data.cache, config.checkpoint.keep_best) == ("auto", CheckpointConfig().keep_best)
    text = (ROOT / "configs/own_robot.yaml").read_text()
    offered = re.sub(r"^( *)# (?=replay:|  share|  data)", r"\1", text, flags=re.MULTILINE)
    asked = load_config(write(tmp_path, offered))  # with what it offers in comments
    assert asked.replay.share == 0.25


@pytest.mark.parametrize("adapter", [{"modules_to_save": ["state_encoder"]}, {"targets": ["q", "state_encoder"]}])
def test_an_adapter_on_the_states_of_a_model_without_states_is_refused(adapter: dict[str, object]) -> None:
    model = {"base": "b.pt", "sizes": {"predictor": {"use_states": False}}}
    with pytest.raises(
        InputError, match=rf"adapter\.{next(iter(adapter))}: no state_encoder where predictor.use_states"
    ):
        parse_config({**MINIMAL, "model": model, "adapter": adapter}, where="here")
    parse_config({**MINIMAL, "model": model, "adapter": {"modules_to_save": ["action_encoder"]}}, where="here")
    parse_config({**MINIMAL, "adapter": adapter}, where="here")


def test_a_resolved_config_reads_back_equal(tmp_path: Path) -> None:
    config = parse_config(MINIMAL, where="here")
    assert load_config(write(tmp_path, config_as_yaml(config))) == config


def test_all_errors_are_reported_at_once_with_their_paths() -> None:
    wrong = {
        "data": {"path": "d", "strid": 4, "frames": 1},
        "model": {"base": "b"},
        "training": {"learning_rate": "fast", "rank": 8},
    }
    with pytest.raises(InputError) as caught:
        parse_config(wrong, where="my.yaml")
    message = str(caught.value)
    assert "my.yaml" in message
    assert "5 values are wrong" in message
    assert "run_dir: missing" in message
    assert "data.strid: unknown key; did you mean stride?" in message
    assert "data.frames" in message
    assert "greater than or equal to 2" in message
    assert "training.learning_rate" in message
    assert "training.rank: unknown key; did you mean adapter.rank?" in message


@pytest.mark.parametrize(
    ("override", "complaint"),
    [
        ("training.steps=0", "greater than or equal to 1"),
        ("training.steps=many", "valid integer"),
        ("training.steps=1.5", "valid integer"),
        ("adapter.dropout=1.0", "less than 1"),
        ("data.camera=third_eye", "exterior_1_left"),
        ("data.stride_candidates=[]", "at least 1 item"),
        ("training.rollout_steps=16", "data.frames of at least 17"),
        ("training.warmup_steps=200000", "exceed steps"),
        ("training.decay_steps=5", "warmup_stable_decay"),
        ("model.base=null", "either base"),
        ("model.sizes.patch_size=15", "multiple of patch_size"),
        ("data.validation_share=0.97", "nothing to train on"),
        ("training.learning_rate=.nan", "finite"),
        ("steps=3", "did you mean training.steps?"),
        ("seed.x=3", "valid integer"),
        ("training", "key=value, such as training"),
    ],
)
def test_a_wrong_override_is_explained(tmp_path: Path, override: str, complaint: str) -> None:
    path = write(tmp_path, yaml.safe_dump(MINIMAL))
    with pytest.raises(InputError, match=complaint):
        load_config(path, [override])


def test_overrides_reach_nested_keys_and_read_numbers_as_people_write_them(tmp_path: Path) -> None:
    path = write(tmp_path, yaml.safe_dump(MINIMAL))
    config = load_config(
        path, ["training.learning_rate=3e-4", "adapter.targets=[q, v]", "data.fields.gripper=openness"]
    )
    assert config.training.learning_rate == 3e-4
    assert config.adapter.targets == ("q", "v")
    assert config.data.fields.gripper == "openness"


@pytest.mark.parametrize("written", ["22008760", '"22008760"'])
def test_the_serial_number_of_a_camera_needs_no_quotes(tmp_path: Path, written: str) -> None:
    path = write(tmp_path, yaml.safe_dump(MINIMAL))
    for camera in (f"data.camera={written}", f"data.camera=[{written}]"):
        assert load_config(path, ["data.source=droid_raw", camera]).data.cameras == ("22008760",)


def test_words_that_yaml_takes_for_truth_values_are_words(tmp_path: Path) -> None:
    path, sections = write(tmp_path, yaml.safe_dump(MINIMAL)), config_schema()["$defs"]
    found = []
    for key in all_keys():
        section, _, name = key.rpartition(".")
        knob = next((one["properties"][name] for one in sections.values() if name in one.get("properties", {})), {})
        for word in knob.get("enum", ()):
            if section and yaml.safe_load(str(word)) != word:
                needed = ["replay.data.path=d"] * key.startswith("replay.")
                assert attrgetter(key)(load_config(path, [f"{key}={word}", *needed])) == word
                found.append(key)
    assert {"data.cache", "training.compile", "planning.compile"} <= set(found)


def test_a_key_given_twice_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="given twice"):
        load_config(write(tmp_path, "run_dir: a\nrun_dir: b\n"))


@pytest.mark.parametrize("text", ["", "- a list", "{unclosed", "run_dir: !!python/object:os.system x"])
def test_what_is_not_a_config_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError):
        load_config(write(tmp_path, text))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.yaml"):
        load_config(tmp_path / "nowhere.yaml")


def test_changed_keys_names_the_dotted_keys() -> None:
    old = parse_config(MINIMAL, where="")
    new = parse_config({**MINIMAL, "seed": 3, "training": {"steps": 50_000}}, where="")
    assert changed_keys(old, new) == ["seed", "training.steps"]


def test_config_is_frozen() -> None:
    config = parse_config(MINIMAL, where="")
    with pytest.raises(ValueError, match="frozen"):
        config.seed = 3  # type: ignore[misc]


def test_schema_documents_every_knob() -> None:
    definitions = config_schema()["$defs"]
    for name, section in {**definitions, "Config": config_schema()}.items():
        for key, knob in section.get("properties", {}).items():
            documented = knob.get("description") or "$ref" in knob  # a section is documented by its class
            assert documented, f"{name}.{key} is not documented"


def test_every_knob_is_read_somewhere() -> None:
    source = "\n".join(path.read_text() for path in (ROOT / "src").rglob("*.py"))
    read = {(owner.removeprefix("_"), name) for owner, name in re.findall(r"(\w+)(?=\.(\w+))", source)}
    for key in all_keys():
        *sections, name = key.split(".")
        owners = ["config", "sizes", "knobs", "self", *sections[-1:]]
        assert any((owner, name) in read for owner in owners), f"nobody reads {key}"


def test_plain_values_are_plain() -> None:
    assert isinstance(config_as_dict(parse_config(MINIMAL, where=""))["adapter"]["targets"], list)
    assert Config.model_config["extra"] == "forbid"


def test_a_place_of_data_may_name_the_home_and_end_in_a_slash(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/somewhere")
    given = {
        "~/data/": "/somewhere/data", "data//": "data", "/": "/", "a~b": "a~b",
        "gs://bucket/droid/": "gs://bucket/droid", "hf://datasets/a/b": "hf://datasets/a/b",
    }  # fmt: skip
    for path, meant in given.items():
        assert DataConfig(path=path).path == meant
    ranges = {"rule": "published", "ranges": "~/ranges.json"}
    assert DataConfig(path="d", idle=IdleConfig(**ranges)).idle.ranges == "/somewhere/ranges.json"
    with pytest.raises(InputError, match=r"data\.path.*empty"):
        parse_config(MINIMAL | {"data": {"path": " "}}, where="here")


def test_a_pattern_is_given_as_a_table(tmp_path: Path) -> None:
    path = write(tmp_path, yaml.safe_dump(MINIMAL))
    config = load_config(path, ["adapter.peft={rank_pattern: {fc1: 32, blocks.0.attn.q: 4}}", "adapter.targets=[all]"])
    assert config.adapter.peft["rank_pattern"] == {"fc1": 32, "blocks.0.attn.q": 4}
    assert parse_config(yaml.safe_load(config_as_yaml(config)), where="") == config
    plain = load_config(path, ["adapter.targets=[all]"])
    assert all(key.startswith("adapter.peft") for key in changed_keys(plain, config))
    assert changed_keys(plain, config)
    with pytest.raises(InputError, match=r"adapter.*peft\.r is adapter\.rank here"):
        load_config(path, ["adapter.peft={r: 4}"])


def test_sections_that_others_are_merged_into_are_read(tmp_path: Path) -> None:
    text = """
    run_dir: runs/x
    data: {path: d}
    model: {base: b.pt}
    validation: &measure
      every: 7
      clips: 9
    training:
      <<: {steps: 500, warmup_steps: 10}
      warmup_steps: 20
    """
    config = load_config(write(tmp_path, textwrap.dedent(text)))
    assert (config.training.steps, config.training.warmup_steps, config.validation.clips) == (500, 20, 9)


@pytest.mark.parametrize(
    "name", ["1e-4", "010", "1:30", "2024-01-01", "089", "on", "null", "0x1F", "1_0", "=", "é #: ü"]
)
def test_text_that_looks_like_a_number_stays_text_when_written_and_read(tmp_path: Path, name: str) -> None:
    config = parse_config(MINIMAL | {"run_dir": name, "data": {"path": "d", "exclude": [name]}}, where="")
    assert load_config(write(tmp_path, config_as_yaml(config))) == config


def test_a_template_that_was_not_filled_in_is_named_with_its_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"config\.yaml: line 2, column 11.*Fill in the template"):
        load_config(write(tmp_path, "seed: 1\nrun_dir: {{ RUN }}\n"))


def test_a_config_is_of_bounded_size_and_may_come_through_a_pipe(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="more than 4,194,304 bytes"):
        load_config(write(tmp_path, "#" * (5 << 20)))
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    writer = threading.Thread(target=pipe.write_text, args=(yaml.safe_dump(MINIMAL),))
    writer.start()
    assert load_config(pipe) == parse_config(MINIMAL, where="")
    writer.join()


def test_values_of_the_command_line_that_lie_too_deep_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="too deep"):
        load_config(write(tmp_path, yaml.safe_dump(MINIMAL)), [".".join("a" * 5_000) + "=1"])


# ---- knobs that are gone ----


def with_contrast(value: object) -> dict[str, object]:
    return {**MINIMAL, "training": {"steps": 2_000, "action_contrast": value}}


@pytest.mark.parametrize("off", [None, {}, {"weight": 0.0, "margin": 0.1}], ids=str)
def test_a_config_of_before_loads_where_a_knob_that_is_gone_was_off(tmp_path: Path, off: object) -> None:
    values = with_contrast(off)
    path = write(tmp_path, yaml.safe_dump(values))
    expected = parse_config({**MINIMAL, "training": {"steps": 2_000}}, where="here")
    assert load_config(path) == load_config(values) == load_config_of_run(path) == expected
    assert not gone_in_use(path)
    assert values == with_contrast(off)


def test_where_it_was_on_the_config_is_refused_beside_all_other_errors_and_only_a_run_that_was_made_loads(
    tmp_path: Path,
) -> None:
    on = {"weight": 1.0, "margin": 0.3}
    path = write(tmp_path, yaml.safe_dump(with_contrast(on)))
    with pytest.raises(InputError, match=r"training\.action_contrast: a loss term that .* is gone") as caught:
        load_config(path, ["training.step=3"])
    assert "training.step: unknown key; did you mean steps?" in str(caught.value)
    assert load_config_of_run(path).training.steps == 2_000
    assert gone_in_use(path) == {"training.action_contrast": on}
    with pytest.raises(InputError, match="is gone"):
        load_config_of_run(path, ["training.action_contrast.weight=1"])


@pytest.mark.parametrize(("steps", "warmup"), [(100_000, 1_000), (10_000, 1_000), (100, 10), (3, 0)])
def test_a_short_run_warms_up_for_a_tenth_of_its_steps(steps: int, warmup: int) -> None:
    training = load_config(ROOT / "configs/default.yaml", [f"training.steps={steps}"]).training
    assert training.warmup_steps == warmup
