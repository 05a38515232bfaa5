"""The labs study: does adapting help in a new lab, and does the advice of `evaluate` and `keep_best` select well?

A lab is a target domain that is drawn at random: camera, light, textures, mounting and lag of the arm. In a third of
the labs adapting may be useless or harmful: low-diversity demonstrations, few demonstrations, or no domain shift.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from methods import IN_OUT, PLANNING, TRAINING
from prepare import BUILTIN, base_data, cache_latents, data_a, exclude_episodes, prepare_base_data
from results import as_file_name
from work import Work

from vjepa2_ac.config import AdapterConfig, Config, DataConfig, ModelConfig, ValidationConfig
from vjepa2_ac.config.section import Component
from vjepa2_ac.config.training import CheckpointConfig
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.evaluation.evaluate_run import evaluate_subject
from vjepa2_ac.evaluation.request import EvaluationOptions, ProbeOptions
from vjepa2_ac.evaluation.rows import make_rows
from vjepa2_ac.evaluation.summary import summarize
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.policies.action_prior import PriorOptions, train_prior
from vjepa2_ac.reporter import SILENT
from vjepa2_ac.runs.checkpoint import NEWEST, SELECTED, select_checkpoint
from vjepa2_ac.runs.metrics_log import read_metrics_log
from vjepa2_ac.runs.subject import load_subject
from vjepa2_ac.simulation.benchmark import BenchmarkOptions, Planning, run_task
from vjepa2_ac.simulation.domains import Domain, DomainRanges, sample_domain
from vjepa2_ac.simulation.motion import MotionRecipe
from vjepa2_ac.simulation.policies import Oracle, RandomActions, ZeroActions
from vjepa2_ac.simulation.record import RecordingSpec, record_dataset
from vjepa2_ac.simulation.rollout import Action, Image, Observation, Policy, Trial
from vjepa2_ac.spaces import POSES
from vjepa2_ac.training.loop import train
from vjepa2_ac.training.step import prediction_losses

LABS, TUNING_LABS = 12, 6  # labs 1 to 6 may be used to change the rules of the summary; labs 7 to 12 only report
SEED, GOALS_SEED = 2_026, 90_000
EPISODES, GOALS_STEP = 60, 100  # recorded episodes, of which half are held out; distance between seeds of goals
NEW_CAMERAS = DomainRanges(azimuth_deg=(80.0, 130.0), base_yaw_deg=(-45.0, 45.0), lag_s=(0.06, 0.14), textures=True)
NO_SHIFT = DomainRanges()  # the ranges of the base model's training data
DIVERSE = MotionRecipe()
LOW_DIVERSITY = MotionRecipe(drift_m=(0.01, 0.0, 0.0), turn_rad=0.0, gripper_share=0.0)
RANKS, STEPS, EVERY = (4, 32), 400, 100
PRIOR, PRETRAINED_PRIOR = "action prior", "action prior, pre-trained"
METHODS = (
    "base model",
    "test-time adaptation",
    "LoRA, rank 4",
    "LoRA, rank 32",
    "full fine-tuning",
    PRIOR,
    PRETRAINED_PRIOR,
)
"""Both priors act without a search, so they are goal-conditioned behaviour cloning. The pre-trained prior starts from
the weights of a prior that was trained on the training data of the base model, as LoRA starts from the base model."""

BASE_PRIOR = PriorOptions(steps=8_000)
SCRATCH, FINE_TUNING = PriorOptions(learning_rate=1e-2), PriorOptions(steps=500, learning_rate=1e-2)
"""Training of a prior on the base model's data; in a lab from random weights; and in a lab from the prior of the base
model's data. `python evidence --study rates` selected the options in a lab, on labs that are not part of this study."""


@dataclass(frozen=True)
class Lab:
    """A target domain and its demonstrations."""

    number: int  # from 1
    condition: str
    domain: Domain
    demonstrations: int = 20
    recipe: MotionRecipe = DIVERSE

    @property
    def name(self) -> str:
        """Name for messages."""
        return f"lab {self.number}"


def get_lab(number: int) -> Lab:
    """Return a lab; its number determines everything."""
    rng = np.random.default_rng([SEED, number])
    drawn = Lab(number, "new camera", replace(sample_domain(rng, NEW_CAMERAS), name=f"lab-{number}"))
    if number == 3:
        return replace(drawn, condition="low-diversity demonstrations", recipe=LOW_DIVERSITY)
    if number == 9:
        return replace(drawn, condition="5 low-diversity demonstrations", recipe=LOW_DIVERSITY, demonstrations=5)
    if number in {6, 12}:
        domain = replace(sample_domain(rng, NO_SHIFT), name=f"lab-{number}")
        return replace(drawn, condition="no domain shift", domain=domain)
    return drawn


@dataclass(frozen=True)
class Cell:
    """One method in one lab."""

    lab: int
    method: str

    @property
    def name(self) -> str:
        """Name of its file."""
        return f"lab-{self.lab:02d}-{as_file_name(self.method)}"


def all_cells() -> Iterator[Cell]:
    """Yield all cells, lab by lab."""
    for number in range(1, LABS + 1):
        for method in METHODS:
            yield Cell(number, method)


def prepare(cells: Sequence[Cell], work: Work) -> int:
    """Make the data of the cells' labs; return the number of labs that failed."""
    if any(cell.method == PRETRAINED_PRIOR for cell in cells):
        prepare_base_prior(work.folder, work.workers)
    numbers = dict.fromkeys(cell.lab for cell in cells)
    return work.run(prepare_lab, [(get_lab(number), work.folder) for number in numbers])


def prepare_lab(lab: Lab, folder: Path) -> None:
    """Record the demonstrations and the held-out episodes of a lab, and encode them."""
    data = make_data_config(lab, folder)
    if not Path(data.path).exists():
        spec = RecordingSpec(lab.domain, seed=SEED + lab.number, recipe=lab.recipe)
        record_dataset(data.path, spec, episodes=EPISODES)
    cache_latents(data, BUILTIN)


def prepare_base_prior(folder: Path, workers: int = 1) -> None:
    """Record and encode the training data of the base model, and train an action prior on them, if missing."""
    prepare_base_data(folder, workers)
    if not _base_prior(folder).exists():
        train_prior(make_base_config(folder), _base_prior(folder), BASE_PRIOR)


def make_base_config(folder: Path) -> Config:
    """Return a config of the base model's training data, to train an action prior on them."""
    model = ModelConfig(base=BUILTIN, dtype="float32")
    return Config(run_dir="none", data=base_data(folder), model=model, training=TRAINING)


def _base_prior(folder: Path) -> Path:
    return folder / "base-prior"


def make_prior_options(method: str, folder: Path) -> PriorOptions:
    """Return the options of the training of a prior in a lab."""
    return replace(FINE_TUNING, pretrained=_base_prior(folder)) if method == PRETRAINED_PRIOR else SCRATCH


def make_data_config(lab: Lab, folder: Path) -> DataConfig:
    """Return the data of a lab; one half of the episodes is for training, the other half is held out."""
    update = {"path": str(folder / f"data-{lab.number}"), "validation_share": 0.2, "test_share": 0.3}
    return data_a(folder).model_copy(update=update)


def make_config(cell: Cell, folder: Path) -> Config:
    """Return the config of a cell. Every 100 steps and before the first step the model is validated."""
    lab = get_lab(cell.lab)
    data = make_data_config(lab, folder)
    excluded = exclude_episodes(data, lab.demonstrations, cell.lab)
    rank = int(cell.method.rpartition(" ")[2]) if cell.method.startswith("LoRA") else 0
    rate = 3e-3 if rank else 4e-3
    adapter = AdapterConfig(kind="none")
    if rank:
        adapter = AdapterConfig(rank=rank, alpha=2.0 * rank, dropout=0.0, modules_to_save=IN_OUT)
    return Config(
        run_dir=str(folder / "lab-runs" / cell.name),
        seed=cell.lab,
        data=data.model_copy(update={"exclude": excluded}),
        model=ModelConfig(base=BUILTIN, dtype="float32"),
        adapter=adapter,
        training=TRAINING.model_copy(update={"steps": STEPS, "learning_rate": rate, "allow_weak_base": True}),
        validation=ValidationConfig(every=EVERY, clips=40, batch_size=20, ranking_clips=20, ranking_samples=16),
        checkpoint=CheckpointConfig(every=EVERY, keep=STEPS),
    )


def measure(cell: Cell, folder: Path, goals: int) -> dict[str, Any]:
    """Train and measure a cell on one thread."""
    config, reach = make_config(cell, folder), closed_loop(cell, goals)
    result: dict[str, Any] = {"condition": get_lab(cell.lab).condition}
    base = load_base(config.model, seed=config.seed).eval()
    if cell.method == "base model":
        policies = (ZeroActions(), RandomActions(PLANNING.limits, cell.lab), Oracle(PLANNING.limits))
        result["closed_loop"] = {policy.name: reach(policy) for policy in policies}
        result["closed_loop"]["newest"] = reach(Planning(Controller(base, PLANNING)))
    elif cell.method == "test-time adaptation":
        result["closed_loop"] = {"newest": reach(AdaptingPlanner(base))}
    elif cell.method in {PRIOR, PRETRAINED_PRIOR}:
        prior = folder / "lab-runs" / cell.name
        result["held_out"] = dict(train_prior(config, prior, make_prior_options(cell.method, folder)).held_out)
        planning = PLANNING.model_copy(update={"planner": Component("prior"), "prior": str(prior)})
        result["closed_loop"] = {"newest": reach(Planning(Controller(base, planning)))}
    else:
        run = train(config, SILENT)
        selected, newest = (select_checkpoint(run, name).path.name for name in (SELECTED, NEWEST))
        result |= {"selected": selected, "newest": newest, "evaluation": {}, "closed_loop": {}}
        result["validations"] = list_validations(run)
        for name in dict.fromkeys((NEWEST, SELECTED)):
            if name == SELECTED and selected == newest:
                continue
            result["evaluation"][name] = evaluate(run, name)
            model = load_subject(run, name).world_model
            result["closed_loop"][name] = reach(Planning(Controller(model, PLANNING)))
    return result


def list_validations(run: Path) -> list[dict[str, Any]]:
    """Return the errors of every validation of a run, as `results.select_step` needs them."""
    key = "action_ranking_error"
    return [
        {
            "step": row["step"],
            "rollout_error": row["rollout_over_persistence_last"],
            "ranking": [row[name] for name in (key, f"{key}_low", f"{key}_high")],
        }
        for row in read_metrics_log(run / "metrics.jsonl")
        if row["kind"] == "validation"
    ]


def closed_loop(cell: Cell, goals: int) -> Any:
    """Return a function that measures a policy on the goals of a lab: the final distances to the goal (cm)."""
    spec = BenchmarkOptions("reach", get_lab(cell.lab).domain, goals, GOALS_SEED + GOALS_STEP * cell.lab)

    def measure_policy(policy: Policy) -> list[float]:
        return [round(float(distances[-1]), 3) for distances in run_task(spec, policy).distance_cm]

    return measure_policy


def evaluate(run: Path, checkpoint: str) -> dict[str, Any]:
    """Return the verdicts of `evaluate` on the held-out test episodes, and its rows."""
    probes = ProbeOptions(samples=32, landscape_clips=8, nodes=7, examples=0)
    evaluation = evaluate_subject(str(run), EvaluationOptions(clips=128, checkpoint=checkpoint, probes=probes))
    rows = make_rows(evaluation)
    summary = summarize(evaluation, rows)
    verdicts = {
        verdict.name: {
            "conclusion": verdict.conclusion,
            "value": verdict.value,
            "low": verdict.low,
            "high": verdict.high,
        }
        for verdict in summary.verdicts
    }
    return {"verdicts": verdicts, "rows": {f"{row.model} {row.key}": row.value for row in rows if row.key in ROWS}}


ROWS = (
    "rollout.l1.over_persistence.3",
    "rollout.l1.gain_over_base.3",
    "ranking.rank",
    "ranking.spread",
    "one_step.true",
    "gap_of_actions.shuffled",
    "landscapes.distance",
    "landscapes.sharpness",
    "spread.3",
)


class AdaptingPlanner:
    """A planner that trains its model during the closed loop, without demonstrations.

    Before each decision the model takes one gradient step on the latest transitions observed in the lab. The idea is
    from AdaJEPA (arXiv 2606.32026). The choice of trained weights (input and output projections, last block) and the
    number of transitions are ours.
    """

    name = "test-time adaptation"

    def __init__(self, model: WorldModel, *, rate: float = 1e-3, memory: int = 16) -> None:
        self.model, self.memory = copy.deepcopy(model), memory
        predictor = self.model.base_predictor
        trained = [*(getattr(predictor, name) for name in IN_OUT), predictor.blocks[-1]]
        self.parameters = [weight.requires_grad_() for part in trained for weight in part.parameters()]
        self.optimizer = torch.optim.AdamW(self.parameters, lr=rate, weight_decay=0.0)
        self.planning = Planning(Controller(self.model, PLANNING), self.name)
        self.transitions: list[tuple[torch.Tensor, np.ndarray, np.ndarray]] = []  # latents, states, action
        self.before: tuple[torch.Tensor, np.ndarray] | None = None

    @property
    def why(self) -> str:
        """The reason for the latest action."""
        return self.planning.why

    def reset(self, trial: Trial, goal_image: Image) -> None:
        """Start an episode; the adapted weights and the observed transitions are kept."""
        self.before = None
        self.planning.reset(trial, goal_image)

    def act(self, observation: Observation) -> Action:
        """Train on the observed transitions, then plan."""
        latents = self.planning.controller.encode(observation.image)
        if self.before is not None:
            states = np.stack([self.before[1], observation.state])
            self.transitions.append(
                (torch.stack([self.before[0], latents]), states, POSES.state.compute_differences(states))
            )
            self._train()
        self.before = (latents, np.asarray(observation.state))
        return self.planning.act(observation)

    def _train(self) -> None:
        latest = self.transitions[-self.memory :]
        batch = LatentBatch(
            latents=torch.stack([pair for pair, _, _ in latest]),
            states=torch.from_numpy(np.stack([states for _, states, _ in latest])).float(),
            actions=torch.from_numpy(np.stack([action for _, _, action in latest])).float(),
            extrinsics=None,
            episode_ids=("",) * len(latest),
            starts=(0,) * len(latest),
        )
        loss, _ = prediction_losses(self.model, batch, 1)
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, 1.0)
        self.optimizer.step()
