"""Messages to the page: predictions at a position, energies and plans; and invalid requests."""

import json
from typing import Any

import numpy as np
import pytest
import torch

from vjepa2_ac.episode import no_progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.explore.explorer import RolloutPosition
from vjepa2_ac.explore.views import GoalFrame, PageRequest, Views, read_request
from vjepa2_ac.media.images import decode_image
from vjepa2_ac.planning.energy import Goal, Scene, WorldModelCost
from vjepa2_ac.planning.planner import SearchCancelledError

ZERO_ACTION = [0.0] * 7
UP = [0.0, 0.0, 0.02, 0.0, 0.0, 0.0, 0.0]
GOAL = GoalFrame(0, 6)


def parse_message(message: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    size = int.from_bytes(message[:4], "big")
    header, image_bytes, images = json.loads(message[4 : 4 + size]), message[4 + size :], {}
    for image in header["images"]:
        name, size = image["name"], image["bytes"]
        images[name], image_bytes = decode_image(image_bytes[:size], name), image_bytes[size:]
    assert not image_bytes
    return header, images


def get_reply(views: Views, **values: Any) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    return parse_message(views.reply_to(PageRequest(seq=7, **values), no_progress, lambda: False))


def test_hello_lists_models_episodes_and_moves(live: Views) -> None:
    content, images = parse_message(live.make_hello())
    assert not images
    assert [model["id"] for model in content["models"]] == ["base", "adapter"]
    assert content["truth"] == "simulated"
    assert len(content["episodes"]) == len(live.explorer.episodes)
    assert [number["name"] for number in content["action"]] == ["dx", "dy", "dz", "droll", "dpitch", "dyaw", "dgripper"]
    assert all(0 < number["step"] < number["most"] for number in content["action"])
    assert {"left", "up", "close", "zero action"} <= {move["id"] for move in content["moves"]}
    live.explorer.validate(RolloutPosition(content["position"]["episode"], content["position"]["start"]))


def test_image_strip_has_the_frames_of_its_steps(recorded: Views) -> None:
    content, images = get_reply(recorded, kind="episode", episode=1)
    assert [f"frame-{number}" for number in range(len(content["steps"]))] == list(images)
    for number, step in enumerate(content["steps"]):
        error = np.abs(images[f"frame-{number}"].astype(int) - recorded.explorer.get_observation(1, step).pixels)
        assert error.mean() < 3  # images are JPEG-compressed


def test_prediction_has_images_and_metrics_of_all_models(live: Views) -> None:
    content, images = get_reply(live, kind="predict", start=4, actions=[UP, UP], goal=GOAL)
    assert {"start", "truth", "goal", "predicted-base", "predicted-adapter", "error-base", "error-adapter"} == set(
        images
    )
    assert content["truth"] == "simulated"
    assert content["actions"] == [UP, UP]
    assert len(content["path"]) == 3
    for model in content["models"]:
        assert min(model["error"], model["spread"], model["energy"]) > 0
    assert content["persistence_error"] > 0


def test_ground_truth_without_simulator_exists_only_for_recorded_actions(recorded: Views) -> None:
    start, _ = get_reply(recorded, kind="predict")
    recorded_content, images = get_reply(recorded, kind="predict", actions=[start["next_recorded"]])
    assert recorded_content["truth"] == "recorded"
    assert "error-adapter" in images
    other, images = get_reply(recorded, kind="predict", actions=[UP])
    assert other["truth"] is None
    assert other["persistence_error"] is None
    assert "truth" not in images
    assert "error-adapter" not in images


def test_energy_map_has_the_energy_of_each_action(recorded: Views) -> None:
    content, _ = get_reply(recorded, kind="energy", actions=[UP], goal=GOAL, model="adapter", action=ZERO_ACTION)
    explorer, energy_map = recorded.explorer, content["maps"][0]
    position = RolloutPosition(0, 0, (tuple(UP),))
    state = torch.tensor(explorer.integrate_states(position)[-1], dtype=torch.float32)
    scene = Scene(explorer.predict_latents(1, position), state)
    goal = Goal(explorer.get_observation(0, GOAL.step).latents[None])
    cost = WorldModelCost(explorer.get_model(1), scene, goal, recorded.search.config.energy)
    action = torch.zeros(1, 1, 7)
    action[0, 0, energy_map["across"]] = energy_map["across_values"][5]
    action[0, 0, energy_map["up"]] = energy_map["up_values"][2]
    with torch.no_grad():
        assert energy_map["energy"][2][5] == pytest.approx(float(cost(action)[0]), rel=1e-5)
    assert len(content["maps"]) == 3


def test_plan_is_within_the_limits_and_shows_each_iteration(recorded: Views) -> None:
    content, images = get_reply(recorded, kind="plan", goal=GOAL, model="base", steps=3)
    assert np.abs(np.array(content["actions"])[:, :3]).max() <= recorded.search.config.limits.xyz_m[0]
    assert len(content["actions"]) == 3
    assert list(images) == [f"best-{number}" for number in range(len(content["iterations"]))]
    assert content["energy_plan"] == pytest.approx(
        min(iteration["lowest"] for iteration in content["iterations"]), rel=0.2
    )
    assert content == get_reply(recorded, kind="plan", goal=GOAL, model="base", steps=3)[0]


def test_cancelled_search_raises(recorded: Views) -> None:
    for kind in ("plan", "energy"):
        with pytest.raises(SearchCancelledError):
            recorded.reply_to(PageRequest(1, kind, goal=GOAL, model="base"), no_progress, lambda: True)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "text",
    [
        "", "[]", "{}", "[" * 100_000, '{"seq": 1, "kind": "shell"}',
        '{"seq": 1, "kind": "predict", "actions": [[NaN]]}',
        '{"seq": 1, "kind": "predict", "start": -1}', '{"seq": 1, "kind": "predict", "actions": "up"}',
        '{"seq": 1, "kind": "plan", "steps": 10000000}', '{"seq": 1, "kind": "predict", "more": 1}',
        json.dumps({"seq": 1, "kind": "predict", "actions": [[0.0] * 7] * 17}),
    ],
)  # fmt: skip
def test_invalid_request_raises(text: str) -> None:
    with pytest.raises(InputError, match="request"):
        read_request(text)


@pytest.mark.parametrize("goal", [GoalFrame(50, 0), GoalFrame(0, 5000), None])
def test_search_with_invalid_goal_or_model_raises(recorded: Views, goal: GoalFrame | None) -> None:
    with pytest.raises(InputError):
        get_reply(recorded, kind="plan", goal=goal, model="base")
    with pytest.raises(InputError):
        get_reply(recorded, kind="plan", goal=GOAL, model="unknown")


def test_cancelled_simulation_stops_before_the_next_action(live: Views) -> None:
    actions = [UP, ZERO_ACTION, [-number for number in UP], UP]
    calls, request = [], PageRequest(seq=7, kind="predict", start=2, actions=actions)

    def cancelled() -> bool:
        calls.append(1)
        return len(calls) == 3

    with pytest.raises(SearchCancelledError):
        live.reply_to(request, no_progress, cancelled)
    assert len(calls) == 3
    content, images = parse_message(live.reply_to(request, no_progress, lambda: False))
    expected_content, expected_images = get_reply(live, kind="predict", start=2, actions=actions)
    assert content["truth_state"] == expected_content["truth_state"]
    np.testing.assert_array_equal(images["truth"], expected_images["truth"])
