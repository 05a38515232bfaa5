"""What a page is told: pictures and numbers of a place, energies and plans; and what is no request."""

import json
from typing import Any

import numpy as np
import pytest
import torch

from vjepa2_ac.episode import no_progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.explore.explorer import Place
from vjepa2_ac.explore.views import GoalFrame, PageRequest, Views, read_request
from vjepa2_ac.media.images import decode_image
from vjepa2_ac.planning.energy import Goal, Scene, WorldModelCost
from vjepa2_ac.planning.planner import SearchCancelledError

STILL = [0.0] * 7
UP = [0.0, 0.0, 0.02, 0.0, 0.0, 0.0, 0.0]
GOAL = GoalFrame(0, 6)


def unpacked(message: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    size = int.from_bytes(message[:4], "big")
    header, rest, images = json.loads(message[4 : 4 + size]), message[4 + size :], {}
    for one in header["images"]:
        images[one["name"]], rest = decode_image(rest[: one["bytes"]], one["name"]), rest[one["bytes"] :]
    assert not rest
    return header, images


def asked(views: Views, **values: Any) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    return unpacked(views.answer(PageRequest(seq=7, **values), no_progress, lambda: False))


def test_hello_says_what_can_be_done(live: Views) -> None:
    told, images = unpacked(live.hello())
    assert not images
    assert [one["id"] for one in told["tellers"]] == ["base", "adapter"]
    assert told["truth"] == "simulated"
    assert len(told["episodes"]) == len(live.explorer.episodes)
    assert [one["name"] for one in told["action"]] == ["dx", "dy", "dz", "droll", "dpitch", "dyaw", "dgripper"]
    assert all(0 < one["step"] < one["most"] for one in told["action"])
    assert {"left", "up", "close", "still"} <= {one["id"] for one in told["moves"]}
    live.explorer.require(Place(told["place"]["episode"], told["place"]["start"]))


def test_a_strip_shows_the_frames_it_names(recorded: Views) -> None:
    told, images = asked(recorded, kind="episode", episode=1)
    assert [f"frame-{number}" for number in range(len(told["steps"]))] == list(images)
    for number, step in enumerate(told["steps"]):
        off = np.abs(images[f"frame-{number}"].astype(int) - recorded.explorer.moment(1, step).pixels)
        assert off.mean() < 3  # JPEG


def test_a_look_has_pictures_and_numbers_of_all_who_tell(live: Views) -> None:
    told, images = asked(live, kind="look", start=4, actions=[UP, UP], goal=GOAL)
    assert {"given", "truth", "goal", "imagined-base", "imagined-adapter", "error-base", "error-adapter"} == set(images)
    assert told["truth"] == "simulated"
    assert told["actions"] == [UP, UP]
    assert len(told["path"]) == 3
    for one in told["tellers"]:
        assert min(one["error"], one["spread"], one["energy"]) > 0
    assert told["copying"] > 0


def test_without_a_simulator_only_the_recorded_way_has_a_truth(recorded: Views) -> None:
    start, _ = asked(recorded, kind="look")
    there, images = asked(recorded, kind="look", actions=[start["next_recorded"]])
    assert there["truth"] == "recorded"
    assert "error-adapter" in images
    elsewhere, images = asked(recorded, kind="look", actions=[UP])
    assert elsewhere["truth"] is None
    assert elsewhere["copying"] is None
    assert "truth" not in images
    assert "error-adapter" not in images


def test_a_map_has_the_energy_of_each_action(recorded: Views) -> None:
    told, _ = asked(recorded, kind="energy", actions=[UP], goal=GOAL, teller="adapter", action=STILL)
    explorer, one = recorded.explorer, told["maps"][0]
    place = Place(0, 0, (tuple(UP),))
    state = torch.tensor(explorer.states(place)[-1], dtype=torch.float32)
    scene = Scene(explorer.imagined(1, place), state)
    goal = Goal(explorer.moment(0, GOAL.step).latents[None])
    cost = WorldModelCost(explorer.model(1), scene, goal, recorded.search.config.energy)
    action = torch.zeros(1, 1, 7)
    action[0, 0, one["across"]], action[0, 0, one["up"]] = one["across_values"][5], one["up_values"][2]
    with torch.no_grad():
        assert one["energy"][2][5] == pytest.approx(float(cost(action)[0]), rel=1e-5)
    assert len(told["maps"]) == 3


def test_a_plan_is_within_the_limits_and_its_end_was_seen(recorded: Views) -> None:
    told, images = asked(recorded, kind="plan", goal=GOAL, teller="base", steps=3)
    assert np.abs(np.array(told["actions"])[:, :3]).max() <= recorded.search.config.limits.xyz_m[0]
    assert len(told["actions"]) == 3
    assert list(images) == [f"best-{number}" for number in range(len(told["iterations"]))]
    assert told["energy_plan"] == pytest.approx(min(one["lowest"] for one in told["iterations"]), rel=0.2)
    assert told == asked(recorded, kind="plan", goal=GOAL, teller="base", steps=3)[0]


def test_a_search_that_nobody_waits_for_ends(recorded: Views) -> None:
    for kind in ("plan", "energy"):
        with pytest.raises(SearchCancelledError):
            recorded.answer(PageRequest(1, kind, goal=GOAL, teller="base"), no_progress, lambda: True)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "text",
    [
        "", "[]", "{}", "[" * 100_000, '{"seq": 1, "kind": "shell"}', '{"seq": 1, "kind": "look", "actions": [[NaN]]}',
        '{"seq": 1, "kind": "look", "start": -1}', '{"seq": 1, "kind": "look", "actions": "up"}',
        '{"seq": 1, "kind": "plan", "steps": 10000000}', '{"seq": 1, "kind": "look", "more": 1}',
        json.dumps({"seq": 1, "kind": "look", "actions": [[0.0] * 7] * 17}),
    ],
)  # fmt: skip
def test_what_is_no_request_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="request"):
        read_request(text)


@pytest.mark.parametrize("goal", [GoalFrame(50, 0), GoalFrame(0, 5000), None])
def test_a_search_needs_a_goal_that_is_there(recorded: Views, goal: GoalFrame | None) -> None:
    with pytest.raises(InputError):
        asked(recorded, kind="plan", goal=goal, teller="base")
    with pytest.raises(InputError):
        asked(recorded, kind="plan", goal=GOAL, teller="nobody")


def test_a_simulated_look_that_is_cancelled_ends_before_the_next_action(live: Views) -> None:
    actions = [UP, STILL, [-one for one in UP], UP]
    asked_times, request = [], PageRequest(seq=7, kind="look", start=2, actions=actions)

    def cancelled() -> bool:
        asked_times.append(1)
        return len(asked_times) == 3

    with pytest.raises(SearchCancelledError):
        live.answer(request, no_progress, cancelled)
    assert len(asked_times) == 3
    again, images = unpacked(live.answer(request, no_progress, lambda: False))
    other, expected = asked(live, kind="look", start=2, actions=actions)
    assert again["truth_state"] == other["truth_state"]
    np.testing.assert_array_equal(images["truth"], expected["truth"])
