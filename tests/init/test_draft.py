"""Batch, cache, frames and steps follow from machine and data."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.init import draft
from vjepa2_ac.init.draft import choose_model, make_draft
from vjepa2_ac.init.found import FoundData
from vjepa2_ac.init.knob import Knob, plain
from vjepa2_ac.init.machine import Machine
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


def of(found: FoundData = FOUND, machine: Machine = MACHINE, kind: str = "released") -> draft.Draft:
    return make_draft(found, machine, choose_model(kind, None), run_dir="runs/mine")


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
    assert (training.batch_size, training.gradient_checkpointing, made.fits) == (batch, checkpointing, fits)
    assert training.batch_size * training.accumulation == 32


def test_the_text_is_the_config() -> None:
    for kind in ("released", "scratch"):
        made = of(kind=kind)
        assert parse_config(parse_yaml(made.text(FOUND, MACHINE), where="here"), where="here") == made.config


def test_without_a_gpu_the_batch_is_of_a_usual_one_and_no_hours_are_promised() -> None:
    made = of(machine=replace(MACHINE, gpu=None))
    assert made.config.training.batch_size == 4
    assert made.hours is None
    assert any("not known without the GPU" in line for line in made.costs(replace(MACHINE, gpu=None)))


def test_hours_follow_from_the_card() -> None:
    slow, fast = of(), of(machine=replace(MACHINE, gpu="NVIDIA GeForce RTX 4090"))
    assert slow.hours is not None
    assert fast.hours == pytest.approx(slow.hours * 71 / 165)
    assert of(machine=replace(MACHINE, gpu="Something else")).hours is None


def test_a_card_without_bf16_computes_in_fp16() -> None:
    config = of(machine=replace(MACHINE, has_bf16=False)).config
    assert (config.training.precision, config.model.dtype) == ("fp16", "float32")


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
    assert small.config.data.test_share == 0.15
    assert large.config.data.test_share == 0.02
    assert plain(small.knobs)["validation"]["every"] == 60


def test_vectors_train_fresh_heads() -> None:
    config = of(replace(FOUND, states="vector", idle=None)).config
    assert config.adapter.modules_to_save == ("state_encoder", "action_encoder")
