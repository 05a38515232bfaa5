"""Several cameras side by side: the energy is the mean over the views, which are predicted independently."""

from pathlib import Path

import numpy as np
import pytest
import torch

from decisions import STATE, image, make_controller
from random_decoder import write_decoder
from tiny_models import tiny_model
from vjepa2_ac.config import RldsData
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.imagined import ImageObservation, ImagineOptions, imagine_image
from vjepa2_ac.goals.make_goals import KeyFrameOptions, make_goals
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.model_setup import load_for_planning
from vjepa2_ac.runs.subject import Subject
from vjepa2_ac.simulation.benchmark import BenchmarkOptions, run_benchmark
from vjepa2_ac.simulation.camera import FRAME_SIZE
from vjepa2_ac.simulation.record import RecordingSpec, record_dataset


def decide(goal: np.ndarray, frame: np.ndarray, views: int, mask: np.ndarray | None = None) -> Controller:
    controller = make_controller(views=views, limits=LimitsConfig(rotation=0.1))
    controller.reset(goal, mask=mask)
    controller.act(frame, STATE)
    return controller


def energies(controller: Controller, actions: torch.Tensor) -> torch.Tensor:
    with torch.no_grad():
        return controller.decision.cost(actions)


def test_energy_of_two_views_is_the_mean_of_both() -> None:
    goals, frames = (image(100), image(101)), (image(1), image(2))
    actions = torch.randn(5, 2, 7, generator=torch.Generator().manual_seed(0)) * 0.05
    two_views = decide(np.hstack(goals), np.hstack(frames), 2)
    single_views = [energies(decide(goal, frame, 1), actions) for goal, frame in zip(goals, frames, strict=True)]
    torch.testing.assert_close(energies(two_views, actions), torch.stack(single_views).mean(dim=0))
    predicted, states = two_views.decision.cost.rollout(actions)
    tokens = tiny_model().num_tokens
    for number, (goal, frame) in enumerate(zip(goals, frames, strict=True)):
        single_view, single_states = decide(goal, frame, 1).decision.cost.rollout(actions)
        torch.testing.assert_close(predicted[:, :, number * tokens : (number + 1) * tokens], single_view)
        torch.testing.assert_close(states, single_states)


def test_mask_can_exclude_one_view() -> None:
    goal, frame = np.hstack([image(100), image(101)]), np.hstack([image(1), image(2)])
    mask = np.zeros(goal.shape[:2], dtype=bool)
    mask[:, : mask.shape[1] // 2] = True
    actions = torch.zeros(1, 2, 7)
    left = energies(decide(image(100), image(1), 1), actions)
    torch.testing.assert_close(energies(decide(goal, frame, 2, mask), actions), left)
    with pytest.raises(InputError, match="no pixel inside the cropped image"):
        decide(goal, frame, 2, np.zeros_like(mask))


def test_image_width_that_does_not_fit_the_views_raises() -> None:
    odd = np.zeros((64, 65, 3), dtype=np.uint8)
    with pytest.raises(InputError, match=r"65 pixels wide.* a multiple of 2"):
        decide(odd, odd, 2)


def test_goals_and_video_contain_both_cameras(tmp_path: Path) -> None:
    data = tmp_path / "data"
    record_dataset(data, RecordingSpec("A", 9, seed=0, cameras=2), episodes=2)
    config = RldsData(path=str(data), camera=("exterior_1_left", "exterior_2_left"))
    actual = [make_goals(config, "0", KeyFrameOptions(every=4, views=views)) for views in (1, 2)]
    single_view, two_views = (np.stack([plan_goals.first, plan_goals.goals[0].image]) for plan_goals in actual)
    np.testing.assert_array_equal(two_views[:, :, : two_views.shape[2] // 2], single_view)
    assert (two_views[:, :, two_views.shape[2] // 2 :] != single_view).any()
    with pytest.raises(InputError, match=r"data.camera: exterior_1_left. Expected 2 cameras"):
        make_goals(RldsData(path=str(data), camera="exterior_1_left"), "0", KeyFrameOptions(views=2))

    quick = ["planning.views=2", "planning.samples=8", "planning.iterations=1", "planning.planner.options.elites=2"]
    options = BenchmarkOptions(episodes=1, steps=2, films=1, sub_goals="demonstration")
    benchmark = run_benchmark(load_for_planning("builtin:sim-tiny", overrides=quick), options)
    assert benchmark.results[0].episodes[0].frames.shape[2] == 2 * FRAME_SIZE[1]


def test_image_of_two_views_is_predicted_by_view(tmp_path: Path) -> None:
    model, values = tiny_model(), {"run_dir": "r", "data": {"path": "d", "stride": 4}, "model": {"base": "b"}}
    decoder, images = str(write_decoder(tmp_path / "decoder", model)), [image(1), image(2)]

    def predict_frames(pixels: np.ndarray, views: int) -> np.ndarray:
        config = parse_config(values | {"planning": {"views": views}}, where="test")
        session = Subject("tiny", config, model)
        actual = imagine_image(session, ImagineOptions(decoder, ("up",), steps=2), ImageObservation(pixels, STATE))
        return np.concatenate([actual.first[None], actual.decoded_first[None], actual.rollouts[0].frames])

    two_views = predict_frames(np.hstack(images), 2)
    alone = np.concatenate([predict_frames(pixels, 1) for pixels in images], axis=2)
    assert np.abs(two_views.astype(int) - alone).max() <= 1
