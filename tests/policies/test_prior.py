"""The action prior starts searches, plans without a search, and learns to use the goal."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from decisions import QUICK, STATE, image
from run_fixtures import MakeConfig, SilentReporter
from tiny_models import tiny_model
from vjepa2_ac.cli import main
from vjepa2_ac.config.planning import LimitsConfig, PlanningConfig
from vjepa2_ac.config.section import Component
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.planner import Planner
from vjepa2_ac.policies.action_prior import (
    CARD,
    WEIGHTS,
    ActionPrior,
    PriorCard,
    PriorOptions,
    PriorSizes,
    load_prior,
    save_prior,
    train_prior,
)

SIZES = PriorSizes(grid=3, dim=24, state=7, action=7, ahead=3)
MEAN = (0.03, -0.02, 0.01, 0.0, 0.0, 0.0, 0.3)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return the folder of a prior for the tiny model's encoder that always proposes the same action."""
    model, prior = tiny_model(), ActionPrior(SIZES)
    with torch.no_grad():
        prior.outer.weight.zero_()
        prior.outer.bias.copy_(torch.tensor([*MEAN, *[-3.0] * 7]))
    card = PriorCard("vjepa2-ac prior 1", SIZES, model.encoder_fingerprint(), "released", "nowhere", 0)
    save_prior(tmp_path / "prior", card, prior)
    return tmp_path / "prior"


def make_controller(folder: Path | None, **changes: object) -> Controller:
    """Return a controller after its first decision."""
    config = QUICK.model_copy(update={"prior": folder and str(folder), **changes})
    controller = Controller(tiny_model(), config)
    controller.reset(image(100))
    controller.act(image(0), STATE)
    return controller


def test_prior_planner_acts_within_the_limits_without_search(folder: Path) -> None:
    controller = make_controller(folder, planner=Component("prior"), limits=LimitsConfig(xyz=(0.05, 0.01, 0.05)))
    np.testing.assert_allclose(controller.decision.action, [0.03, -0.01, 0.01, 0, 0, 0, 0.3], atol=1e-6)
    assert controller.decision.plan.evaluations == 1
    assert controller.decision.why == "planned"


@pytest.mark.parametrize("planner", ["cem", "icem", "mppi", "gradient"])
def test_search_starts_from_the_mean_and_std_of_the_prior(folder: Path, planner: str) -> None:
    controller = make_controller(folder, planner=Component(planner), iterations=1, horizon=1, samples=400)
    first = controller.decision.plan.iterations[0]
    spread = np.sqrt(2) * np.exp(-3.0)
    distance = (first.elites[:, 0, :3] - torch.tensor(MEAN[:3])).abs().max()
    assert distance <= 5 * spread
    if planner in {"cem", "icem"}:
        assert not torch.allclose(
            first.mean, make_controller(None, planner=Component(planner), iterations=1, horizon=1).space.lower
        )
    repeated = make_controller(folder, planner=Component(planner), iterations=1, horizon=1, samples=400)
    np.testing.assert_array_equal(controller.decision.action, repeated.decision.action)


def test_prior_of_several_steps_uses_predicted_frames(tmp_path: Path) -> None:
    torch.manual_seed(0)
    prior, model = ActionPrior(SIZES).eval().requires_grad_(False), tiny_model()
    card = PriorCard("vjepa2-ac prior 1", SIZES, model.encoder_fingerprint(), "released", "nowhere", 0)
    save_prior(tmp_path / "prior", card, prior)
    controller = make_controller(
        tmp_path / "prior",
        planner=Component("prior"),
        horizon=3,
        limits=LimitsConfig(xyz=(1.0,) * 3, rotation=3.0, gripper=1.0),
    )
    cost, goal = controller.decision.cost, controller.encode(image(100))
    frame, state = cost.current
    for step, action in enumerate(controller.decision.plan.actions):
        remaining = torch.tensor([max(1, 3 - step)])
        mean, _ = prior(frame[None], goal[None], remaining, state[None])
        np.testing.assert_allclose(action, controller.space.clip(mean.expand(3, -1))[0], atol=1e-5)
        predicted, states = cost.rollout(controller.decision.plan.actions[None, : step + 1])
        frame, state = predicted[0, -1], states[0, -1]


def test_prior_of_another_encoder_or_with_damaged_files_raises(folder: Path) -> None:
    card = json.loads((folder / CARD).read_text())
    (folder / CARD).write_text(json.dumps(card | {"encoder": "0" * 64}))
    with pytest.raises(InputError, match=r"a prior for encoder"):
        make_controller(folder)
    (folder / CARD).write_text(json.dumps(card | {"sizes": {**card["sizes"], "dim": -1}}))
    with pytest.raises(InputError, match="dim"):
        load_prior(folder, where="planning.prior")
    (folder / CARD).write_text(json.dumps(card))
    (folder / WEIGHTS).write_bytes(b"no tensors")
    with pytest.raises(InputError, match=WEIGHTS):
        load_prior(folder, where="planning.prior")


def test_prior_training_is_deterministic_and_measures_held_out_errors(make_config: MakeConfig, tmp_path: Path) -> None:
    """The actions of the episodes are random, so only the goal determines which action leads to it."""
    config, reporter = make_config(), SilentReporter()
    first = train_prior(config, tmp_path / "a", PriorOptions(steps=60, batch_size=8), reporter)
    repeated = train_prior(config, tmp_path / "b", PriorOptions(steps=60, batch_size=8))
    assert (tmp_path / "a" / WEIGHTS).read_bytes() == (tmp_path / "b" / WEIGHTS).read_bytes()
    assert first.held_out == repeated.held_out
    assert set(first.held_out) == {"clips", "true_goals", "goals_of_others"}
    assert reporter.tasks["training the prior"][-1] == (60, 60)
    assert load_prior(tmp_path / "a", where="test")[0].sizes.ahead == config.data.frames - 1


def test_prior_starts_from_the_weights_of_a_pretrained_prior(make_config: MakeConfig, tmp_path: Path) -> None:
    config = make_config()
    first = train_prior(config, tmp_path / "first", PriorOptions(steps=3, batch_size=8))
    ahead = first.sizes.ahead - 1  # a shorter distance to the goal
    untrained = PriorOptions(steps=0, batch_size=8, ahead=ahead, pretrained=tmp_path / "first")
    card = train_prior(make_config(seed=5), tmp_path / "second", untrained)
    assert (card.pretrained, card.sizes.ahead) == (str(tmp_path / "first"), ahead)
    train_prior(config, tmp_path / "third", PriorOptions(steps=0, batch_size=8, pretrained=tmp_path / "second"))
    before, shorter, longer = (load_prior(tmp_path / name, where="test")[1] for name in ("first", "second", "third"))
    rows = [*range(ahead + 1), ahead]  # the last embedding is the start for longer distances
    for prior, embeddings in ((shorter, rows[:-1]), (longer, rows)):
        for name, weight in before.state_dict().items():
            expected = weight[embeddings] if name == "remaining.weight" else weight
            torch.testing.assert_close(prior.state_dict()[name], expected, rtol=0, atol=0)
    train_prior(config, tmp_path / "tuned", PriorOptions(steps=3, batch_size=8, pretrained=tmp_path / "first"))
    tuned = load_prior(tmp_path / "tuned", where="test")[1]
    assert not torch.equal(tuned.outer.weight, before.outer.weight)
    torch.testing.assert_close(tuned.scale, before.scale, rtol=0, atol=0)


def test_pretrained_prior_with_another_encoder_or_size_raises(
    make_config: MakeConfig, folder: Path, tmp_path: Path
) -> None:
    config, out = make_config(), tmp_path / "out"
    train_prior(config, tmp_path / "first", PriorOptions(steps=1, batch_size=8))
    card = json.loads((tmp_path / "first" / CARD).read_text())

    def train_from(pretrained: Path) -> None:
        train_prior(config, out, PriorOptions(steps=1, batch_size=8, pretrained=pretrained))

    (tmp_path / "first" / CARD).write_text(json.dumps(card | {"encoder": "0" * 64}))
    with pytest.raises(InputError, match=r"--pretrained: .*first: a prior for encoder 000"):
        train_from(tmp_path / "first")
    (tmp_path / "first" / CARD).write_text(json.dumps(card | {"crop": "none"}))
    with pytest.raises(InputError, match=r"a prior for data\.crop none"):
        train_from(tmp_path / "first")
    other = PriorSizes(**{**card["sizes"], "action": card["sizes"]["action"] + 1})
    about = PriorCard("vjepa2-ac prior 1", other, card["encoder"], card["crop"], "nowhere", 0)
    save_prior(folder, about, ActionPrior(other))
    with pytest.raises(InputError, match=r"a prior with the size action 8\. Expected action 7"):
        train_from(folder)
    with pytest.raises(InputError, match=r"missing.prior\.json: cannot be read"):
        train_from(tmp_path / "missing")
    assert not out.exists()


def test_prior_command_writes_into_the_run_and_prints_the_planning_command(
    whole_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "prior"
    assert main(["prior", str(whole_run), "--steps", "3", "--out", str(out)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "relative to the zero action" in printed
    assert "planning.prior=" in printed
    further = ["prior", str(whole_run), "--steps", "3", "--out", str(tmp_path / "further"), "--pretrained", str(out)]
    assert main([*further, "--learning-rate", "0.01"]) == 0
    card = json.loads((tmp_path / "further" / CARD).read_text())
    assert (card["pretrained"], card["learning_rate"]) == (str(out), 0.01)
    assert main(["prior", str(tmp_path)]) == 2


def test_prior_planner_without_a_prior_raises() -> None:
    config = PlanningConfig(planner="prior", prior="nowhere")
    with pytest.raises(InputError, match=r"planning\.planner: prior, but no action prior is loaded"):
        Planner(config).plan(lambda actions: actions.sum(dim=(1, 2)), torch.Generator())
