"""Batch, cache, frames and steps follow from machine and data."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_yaml, parse_config
from vjepa2_ac.init import draft
from vjepa2_ac.init.draft import Machine, choose_model, make_draft, this_machine
from vjepa2_ac.init.found import FoundData, Knob, plain
from vjepa2_ac.storage.structured import parse_yaml

GB = 10**9
FOUND = FoundData(
    "npz", "data/mine", {"camera": Knob("frames")}, Knob(30.0), episodes=20, steps=6_000, usual_steps=300,
    short_steps=200, idle={"rule": Knob("motion")}, about=("twenty",),
)  # fmt: skip
MACHINE = Machine("NVIDIA GeForce RTX 3090", 24 * GB, has_bf16=True, cores=8, free_bytes=500 * GB)


@pytest.fixture(autouse=True)
def memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Count 4 GB and 2 GB a clip, 0.5 with checkpointing, instead of five seconds of fake tensors."""

    def estimate(config: Config, _sizes: object) -> SimpleNamespace:
        clips = config.training.batch_size
        return SimpleNamespace(total=lambda checkpointing: int((4 + clips * (0.5 if checkpointing else 2)) * GB))

    monkeypatch.setattr(draft, "estimate_memory", estimate)


def of(found: FoundData = FOUND, machine: Machine = MACHINE, is_scratch: bool = False) -> draft.Draft:
    return make_draft(found, machine, choose_model(None, is_scratch), run_dir="runs/mine")


@pytest.mark.parametrize(
    ("gigabytes", "batch", "checkpointing", "fits"),
    [
        (80, 16, False, True), (24, 8, False, True), (12, 4, False, True), (8, 4, True, True), (5, 2, True, True),
        (4, 1, True, False),
    ],
)  # fmt: skip
def test_the_batch_is_the_largest_that_fits(gigabytes: int, batch: int, checkpointing: bool, fits: bool) -> None:
    made = of(machine=replace(MACHINE, gpu_bytes=gigabytes * GB))
    training = made.config.training
    assert (training.batch_size, training.gradient_checkpointing) == (batch, checkpointing)
    assert ("fits on" in made.costs[0]) == fits
    assert training.batch_size * training.accumulation == 32


def test_the_text_is_the_config() -> None:
    for is_scratch in (False, True):
        made = of(is_scratch=is_scratch)
        assert parse_config(parse_yaml(made.text(FOUND, MACHINE), where="here"), where="here") == made.config


BREAKS = ("\n", "\r", "\x85", "\u2028", "\u2029", "\t", "\x07", "\ufffe", " #", ": ", "'", '"', "\\", "`", "- ")


@pytest.mark.parametrize("between", BREAKS)
def test_names_of_third_parties_never_become_keys(between: str) -> None:
    name = f"a{between}plugins: [evil]{between}#"
    values = {"path": name, "camera": name, "cameras": {name: name, "b": name}, "columns": [name, name]}
    knobs = {"data": {key: Knob(value, name, is_guess=True) for key, value in values.items()}}
    found = replace(FOUND, path=name, about=(name,))
    text = draft.Draft(knobs, None, [name]).text(found, replace(MACHINE, gpu=name))
    head, _, _ = text.partition("\n\n")
    assert all(line.startswith("# ") for line in head.splitlines())
    assert parse_yaml(text, where="here") == {"data": values}
    assert not any(line.lstrip().startswith("plugins") for line in text.splitlines()), "a value is on one line"
    made = of(found)
    read = parse_config(parse_yaml(made.text(found, MACHINE), where="here"), where="here")
    assert read == made.config
    assert parse_config(parse_yaml(config_as_yaml(read), where="run"), where="run") == read


def test_without_a_gpu_the_batch_is_of_a_usual_one() -> None:
    made = of(machine=replace(MACHINE, gpu=None))
    assert made.config.training.batch_size == 4
    assert any("on the machine with the GPU" in line for line in made.costs)


@pytest.mark.parametrize(("name", "width"), [("vjepa2.1-vitb-384", 768), ("vjepa2-vitl", 1024)])
def test_a_fresh_predictor_and_its_cache_are_as_wide_as_the_encoders_latents(name: str, width: int) -> None:
    model = choose_model(f"checkpoints/{name}.pt", is_scratch=True)
    made = make_draft(FOUND, MACHINE, model, run_dir="run")
    assert made.config.model.is_random
    assert made.config.model.sizes.predictor.width == width
    assert model.bytes_a_frame == 2 * 256 * width


@pytest.mark.parametrize("path", [None, "builtin:sim-tiny"], ids=["released", "tiny"])
@pytest.mark.parametrize("is_scratch", [False, True])
@pytest.mark.parametrize(
    ("gpu", "has_bf16", "precision", "why"),
    [("A100", True, "bf16", ""), ("T4", False, "fp16", "this GPU has no bf16"), (None, False, "fp32", "no GPU here")],
)
def test_precision_is_of_the_machine_and_the_type_of_the_weights_goes_with_it(
    gpu: str | None, has_bf16: bool, precision: str, why: str, is_scratch: bool, path: str | None
) -> None:
    machine = replace(MACHINE, gpu=gpu, has_bf16=has_bf16)
    made = make_draft(FOUND, machine, choose_model(path, is_scratch), run_dir="runs/mine")
    training = made.knobs["training"]
    assert isinstance(training, dict)
    dtype = "bfloat16" if precision == "bf16" and path is None else "float32"
    assert (made.config.training.precision, made.config.model.dtype) == (precision, dtype)
    assert training["precision"].why.startswith(why)
    assert ("model.dtype" in training["precision"].why) == (precision == "fp32" and path is None)


def test_latents_are_cached_where_the_disk_has_room() -> None:
    assert of().config.data.cache == "auto"
    assert of(machine=replace(MACHINE, free_bytes=6 * GB)).config.data.cache == "off"
    assert of(replace(FOUND, steps=27_600_000)).config.data.cache == "off"


def test_a_model_step_lasts_as_long_as_droids_and_a_clip_fits_into_nine_of_ten_episodes() -> None:
    data = of().config.data
    assert (data.stride, data.frames) == (8, 8)
    short = of(replace(FOUND, usual_steps=60, short_steps=40)).config.data
    assert short.clip_steps <= 40
    assert short.idle.rule == "none"  # too short to cut pauses out


def test_few_data_get_few_steps_and_larger_shares() -> None:
    small, large = of(), of(replace(FOUND, episodes=95_658, steps=27_600_000))
    assert small.config.training.steps == 600
    assert large.config.training.steps == 100_000
    assert (small.config.data.validation_share, small.config.data.test_share) == (0.15, 0.3)
    assert large.config.data.test_share == 0.02
    assert plain(small.knobs)["validation"]["every"] == 60


def test_vectors_train_fresh_heads() -> None:
    config = of(replace(FOUND, states="vector", idle=None)).config
    assert config.adapter.modules_to_save == ("state_encoder", "action_encoder")


def test_the_precision_of_a_card_follows_from_its_capability(monkeypatch: pytest.MonkeyPatch) -> None:
    card = SimpleNamespace(name="A card", total_memory=16 * 10**9)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda _device: (7, 5))
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _device: card)
    assert this_machine().precision == "fp16"
