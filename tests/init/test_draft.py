"""`init` derives batch size, cache, clip length and number of steps from the machine and the data set."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_yaml, parse_config
from vjepa2_ac.init import draft
from vjepa2_ac.init.dataset_properties import DatasetProperties
from vjepa2_ac.init.draft import Machine, choose_model, detect_machine, make_draft
from vjepa2_ac.init.draft_values import DraftValue, plain_values
from vjepa2_ac.storage.structured import parse_yaml

GB = 10**9
PROPERTIES = DatasetProperties(
    "npz", "data/mine", {"camera": DraftValue("frames")}, DraftValue(30.0), episodes=20, steps=6_000, median_steps=300,
    p10_steps=200, idle={"rule": DraftValue("motion")}, descriptions=("twenty",),
)  # fmt: skip
MACHINE = Machine("NVIDIA GeForce RTX 3090", 24 * GB, has_bf16=True, cores=8, free_bytes=500 * GB)


@pytest.fixture(autouse=True)
def memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the memory estimate, which takes 5 s: 4 GB plus 2 GB per clip, or 0.5 GB with checkpointing."""

    def estimate(config: Config, _sizes: object) -> SimpleNamespace:
        clips = config.training.batch_size
        return SimpleNamespace(total=lambda checkpointing: int((4 + clips * (0.5 if checkpointing else 2)) * GB))

    monkeypatch.setattr(draft, "estimate_memory", estimate)


def make(
    properties: DatasetProperties = PROPERTIES, machine: Machine = MACHINE, is_scratch: bool = False
) -> draft.Draft:
    return make_draft(properties, machine, choose_model(None, is_scratch), run_dir="runs/mine")


@pytest.mark.parametrize(
    ("gigabytes", "batch", "checkpointing", "fits"),
    [
        (80, 16, False, True), (24, 8, False, True), (12, 4, False, True), (8, 4, True, True), (5, 2, True, True),
        (4, 1, True, False),
    ],
)  # fmt: skip
def test_batch_size_is_the_largest_that_fits_into_memory(
    gigabytes: int, batch: int, checkpointing: bool, fits: bool
) -> None:
    proposal = make(machine=replace(MACHINE, gpu_bytes=gigabytes * GB))
    training = proposal.config.training
    assert (training.batch_size, training.gradient_checkpointing) == (batch, checkpointing)
    assert ("which fits into" in proposal.costs[0]) == fits
    assert training.batch_size * training.accumulation == 32


def test_yaml_text_parses_to_the_drafted_config() -> None:
    for is_scratch in (False, True):
        proposal = make(is_scratch=is_scratch)
        assert (
            parse_config(parse_yaml(proposal.to_yaml(PROPERTIES, MACHINE), where="here"), where="here")
            == proposal.config
        )


BREAKS = ("\n", "\r", "\x85", "\u2028", "\u2029", "\t", "\x07", "\ufffe", " #", ": ", "'", '"', "\\", "`", "- ")


@pytest.mark.parametrize("between", BREAKS)
def test_line_breaks_in_names_cannot_add_config_keys(between: str) -> None:
    name = f"a{between}plugins: [evil]{between}#"
    values = {"path": name, "camera": name, "cameras": {name: name, "b": name}, "columns": [name, name]}
    config_values = {"data": {key: DraftValue(value, name, is_guess=True) for key, value in values.items()}}
    properties = replace(PROPERTIES, path=name, descriptions=(name,))
    text = draft.Draft(config_values, None, [name]).to_yaml(properties, replace(MACHINE, gpu=name))
    head, _, _ = text.partition("\n\n")
    assert all(line.startswith("# ") for line in head.splitlines())
    assert parse_yaml(text, where="here") == {"data": values}
    assert not any(line.lstrip().startswith("plugins") for line in text.splitlines()), "a value is on one line"
    proposal = make(properties)
    read = parse_config(parse_yaml(proposal.to_yaml(properties, MACHINE), where="here"), where="here")
    assert read == proposal.config
    assert parse_config(parse_yaml(config_as_yaml(read), where="run"), where="run") == read


def test_comment_for_a_single_episode_states_the_exact_number() -> None:
    config_text = make(replace(PROPERTIES, episodes=1)).to_yaml(PROPERTIES, MACHINE)
    assert "# 1 of 1 episode, selected by a hash" in config_text


def test_batch_size_without_gpu_is_for_an_assumed_gpu() -> None:
    proposal = make(machine=replace(MACHINE, gpu=None))
    assert proposal.config.training.batch_size == 4
    assert any("on the training machine" in line for line in proposal.costs)


@pytest.mark.parametrize(("name", "width"), [("vjepa2.1-vitb-384", 768), ("vjepa2-vitl", 1024)])
def test_new_predictor_has_the_width_of_the_latents(name: str, width: int) -> None:
    model = choose_model(f"checkpoints/{name}.pt", is_scratch=True)
    proposal = make_draft(PROPERTIES, MACHINE, model, run_dir="run")
    assert proposal.config.model.is_random
    assert proposal.config.model.sizes.predictor.width == width
    assert model.bytes_per_frame == 2 * 256 * width


@pytest.mark.parametrize("path", [None, "builtin:sim-tiny"], ids=["released", "tiny"])
@pytest.mark.parametrize("is_scratch", [False, True])
@pytest.mark.parametrize(
    ("gpu", "has_bf16", "precision", "reason"),
    [
        ("A100", True, "bf16", ""),
        ("T4", False, "fp16", "this GPU does not support bf16"),
        (None, False, "fp32", "no GPU"),
    ],
)
def test_precision_and_weight_dtype_follow_from_the_gpu(
    gpu: str | None, has_bf16: bool, precision: str, reason: str, is_scratch: bool, path: str | None
) -> None:
    machine = replace(MACHINE, gpu=gpu, has_bf16=has_bf16)
    proposal = make_draft(PROPERTIES, machine, choose_model(path, is_scratch), run_dir="runs/mine")
    training = proposal.config_values["training"]
    assert isinstance(training, dict)
    dtype = "bfloat16" if precision == "bf16" and path is None else "float32"
    assert (proposal.config.training.precision, proposal.config.model.dtype) == (precision, dtype)
    assert training["precision"].reason.startswith(reason)
    assert ("model.dtype" in training["precision"].reason) == (precision == "fp32" and path is None)


def test_latents_are_cached_if_disk_space_suffices() -> None:
    assert make().config.data.cache == "auto"
    assert make(machine=replace(MACHINE, free_bytes=6 * GB)).config.data.cache == "off"
    assert make(replace(PROPERTIES, steps=27_600_000)).config.data.cache == "off"


def test_stride_gives_droids_model_step_and_clips_fit_into_most_episodes() -> None:
    data = make().config.data
    assert (data.stride, data.frames) == (8, 8)
    short = make(replace(PROPERTIES, median_steps=60, p10_steps=40)).config.data
    assert short.clip_steps <= 40
    assert short.idle.rule == "none"  # too short for the idle filter


def test_small_data_set_gets_fewer_steps_and_larger_held_out_shares() -> None:
    small, large = make(), make(replace(PROPERTIES, episodes=95_658, steps=27_600_000))
    assert small.config.training.steps == 600
    assert large.config.training.steps == 100_000
    assert (small.config.data.validation_share, small.config.data.test_share) == (0.15, 0.3)
    assert large.config.data.test_share == 0.02
    assert plain_values(small.config_values)["validation"]["every"] == 60


def test_vector_states_train_new_input_projections() -> None:
    config = make(replace(PROPERTIES, states="vector", idle=None)).config
    assert config.adapter.modules_to_save == ("state_encoder", "action_encoder")


def test_gpu_without_bf16_capability_gets_fp16(monkeypatch: pytest.MonkeyPatch) -> None:
    card = SimpleNamespace(name="A card", total_memory=16 * 10**9)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda _device: (7, 5))
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _device: card)
    assert detect_machine().precision == "fp16"


@pytest.mark.parametrize("path", [None, "builtin:sim-tiny"], ids=["released", "tiny"])
def test_wrist_camera_and_long_model_step_are_written_as_warnings(path: str | None) -> None:
    model = choose_model(path)
    camera = {"camera": DraftValue("wrist_left")}
    properties = replace(PROPERTIES, config_values=camera, rate_hz=DraftValue(0.5))
    proposal = make_draft(properties, MACHINE, model, run_dir="run")
    assert [text.partition(":")[0] for text in proposal.warnings] == ["data.camera", "data.stride"]
    header = proposal.to_yaml(properties, MACHINE).partition("\n\n")[0]
    assert header.count("# Warning: data.") == 2
    guessed = replace(properties, rate_hz=DraftValue(0.5, is_guess=True))
    assert len(make_draft(guessed, MACHINE, model, run_dir="run").warnings) == 1, "the model step is not known"
    assert make_draft(PROPERTIES, MACHINE, model, run_dir="run").warnings == []
