"""Cells count by the side to which the hand moves; differences of the gripper to `none` count by their sign."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the extra `sim` is not installed")

from benches import imported
from paths import ROOT
from vjepa2_ac.config.loading import load_config
from vjepa2_ac.decoding.decoder_folder import DecoderCard, save_decoder
from vjepa2_ac.decoding.network import Decoder, DecoderShape
from vjepa2_ac.evaluation.request import EvaluationOptions
from vjepa2_ac.model.checkpoints.loading import load_base
from vjepa2_ac.simulation.recording.record import RecordingSpec, record_dataset


@pytest.fixture
def probes(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    yield from imported("counterfactual_probes", monkeypatch)


def asked_of_tiny(probes: Any, tmp_path: Path, path: Path) -> Any:
    """Return a request for one start and two steps, with a decoder that has learned nothing."""
    settings = [
        f"data.path={path}", "data.frames=3", "data.stride=4", "data.workers=0", "data.test_share=0.3",
        "data.validation_share=0.2", "planning.limits.xyz=[0.05,0.05,0.05]",
    ]  # fmt: skip
    config = load_config(ROOT / "configs/demo.yaml", settings)
    model = load_base(config.model, seed=0)
    shape = DecoderShape("linear", model.latent_dim, 6, 16)
    encoder = model.encoder_fingerprint()
    card = DecoderCard("vjepa2-ac decoder 1", shape, encoder, "released", "fp32", "data", ("camera",), 3, 30, 100)
    weights = Decoder(shape).state_dict()
    save_decoder(tmp_path / "decoder", card, weights, weights)
    evaluation = EvaluationOptions(data=config, out=tmp_path / "out")
    return probes.SidesOptions(str(tmp_path / "decoder"), starts=1, steps=2, evaluation=evaluation)


def test_a_cell_is_right_if_the_hand_moves_along_the_true_displacement(probes: Any) -> None:
    cells = (("up", 5.0, 1.0), ("down", 5.0, -1.0), ("up", 5.0, 0.0), ("left", 9.0, 3.0), ("left", 1.9, 3.0))
    made = tuple(probes.Cell("e", 0, name, np.array([true]), {"m": np.array([along])}) for name, true, along in cells)
    found = probes.Sides(made, ("m",), 96, (10, 2))
    up, left = found.of("m", "z"), found.of("m", "y")
    assert (up.right, up.cells, up.left_out) == (1, 3, 0)
    assert (left.right, left.cells, left.left_out) == (1, 1, 1)


def test_every_start_has_a_cell_for_each_direction_and_the_gripper_of_the_simulator_opens_and_closes(
    probes: Any, tmp_path: Path
) -> None:
    data = record_dataset(tmp_path / "data", RecordingSpec("A", 13, seed=4, task="pick"), episodes=8)
    asked = asked_of_tiny(probes, tmp_path, data)
    found = probes.measure_sides("builtin:sim-tiny", asked)
    assert sorted(cell.name for cell in found.cells) == sorted(name for pair in probes.AXES.values() for name in pair)
    assert found.sources == ("decoded_truth", "model")
    gripper = probes.measure_gripper("builtin:sim-tiny", asked)
    opened, closed = (cell.true for cell in gripper.cells)
    assert (closed - opened > 0.25).all(), "the whole way, or to the block"
