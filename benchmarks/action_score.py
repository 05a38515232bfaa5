"""Compute the Action Score of JEPA-WMs: how close do plans of three steps end to the demonstrations?

    python benchmarks/action_score.py checkpoints/vjepa2-ac-vitg.pt franka.yaml --clips 64

In each clip, the model plans from one frame towards the frame three steps later. The error is the absolute difference
between the total displacement of the plan and of the demonstration, summed over x, y and z. The score is
max(0, 800 (0.1 - error in metres)). It is compared with the score of the zero action.

Source: facebookresearch/jepa-wms @ 6eafb14, configs/evals/simu_env_planning/droid/vj2ac,
evals/simu_env_planning/planning (planner.py: CEMPlanner; objectives.py: ReprTargetDistMPCObjective; plan_evaluator.py:
PlanEvaluator.eval, end_distance_xyz), app/vjepa_wm/modelcustom/simu_env_planning/vit_enc_preds.py: EncPredWM.unroll,
app/plan_common/plot/logs_plan_joint_per_design_choice.py. Differences: docs/published_figures.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.config.loading import load_config
from vjepa2_ac.config.planning import LimitsConfig, PlanningConfig
from vjepa2_ac.config.section import Component
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.loader import validation_batches
from vjepa2_ac.encoding.batch import encode_batch
from vjepa2_ac.evaluation.action_use import make_transition
from vjepa2_ac.intervals import bootstrap
from vjepa2_ac.model.distances import squared_difference
from vjepa2_ac.model.lora import merge_adapter
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.planner import Planner
from vjepa2_ac.planning.search_space import GRIPPER, make_pose_search_space
from vjepa2_ac.runs.folder import is_run
from vjepa2_ac.runs.subject import load_subject
from vjepa2_ac.spaces import integrate_changes

STEPS = 3
BATCH_SIZE = 64  # samples per call of the predictor
CONTEXT_FRAMES = 2  # maximum number of input frames of a prediction, true or predicted
PROTOCOL = PlanningConfig(
    planner=Component(
        "cem",
        {
            **dict.fromkeys(("momentum_mean", "momentum_std", "momentum_mean_gripper", "momentum_std_gripper"), 0.0),
            "try_mean": True,
        },
    ),
    horizon=STEPS,
    samples=300,
    iterations=15,
    limits=LimitsConfig(xyz=(0.1, 0.1, 0.1), rotation=0.1, gripper=0.75, gripper_mode="free"),
)
GRIPPER_START_STD = 0.1


def energies(
    model: WorldModel,
    frame: Float[Tensor, "tokens dim"],
    state: Float[Tensor, " 7"],
    goal: Float[Tensor, "tokens dim"],
    actions: Float[Tensor, "samples steps 7"],
) -> Float[Tensor, " samples"]:
    """Return the mean squared difference of the last predicted frame from the goal."""
    if len(actions) > BATCH_SIZE:
        return torch.cat([energies(model, frame, state, goal, part) for part in actions.split(BATCH_SIZE)])  # type: ignore[no-untyped-call]  # torch
    actions = actions.to(state)
    states = integrate_changes(state, actions)[:, :-1]
    first = slice(0, CONTEXT_FRAMES)
    frames = model.rollout(frame.expand(len(actions), 1, *frame.shape), actions[:, first], states[:, first])
    for end in range(CONTEXT_FRAMES + 1, STEPS + 1):
        context = slice(end - CONTEXT_FRAMES, end)
        predicted = model.predict(frames, actions[:, context], states[:, context])[:, -1:]
        frames = torch.cat([frames[:, 1:], predicted], dim=1)
    return squared_difference(frames[:, -1].float(), goal.float()).mean(dim=(1, 2)).cpu()


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure a run or a model and print the scores."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("subject", help="folder of a run, or a value of model.base")
    parser.add_argument("config", help="config of the data, with clips of four frames or more")
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="override of a config key")
    parser.add_argument("--clips", type=int, default=64)
    parser.add_argument(
        "--samples",
        type=int,
        default=PROTOCOL.samples,
        help="samples per iteration (default: %(default)s, as published)",
    )
    options = parser.parse_args(arguments)
    config = load_config(options.config, options.overrides)
    model = load_subject(options.subject, config=None if is_run(options.subject) else config).world_model
    if model.adaptation is not None:
        merge_adapter(model)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    model.to(device).eval()
    settings = PROTOCOL.model_copy(update={"samples": options.samples})
    space = make_pose_search_space(settings)
    space.std[:, GRIPPER] = GRIPPER_START_STD
    planner = Planner(settings, space)
    ids, errors = [], []
    with torch.no_grad():
        for pixels in validation_batches(open_dataset(config.data), "test", clips=options.clips, batch_size=4):
            batch = encode_batch(model, pixels, device=device)
            for row in range(len(batch.starts)):
                generator = make_transition(batch, row, 0).make_generator(config.seed)
                start = int(generator.integers(batch.latents.shape[1] - STEPS))
                demonstrated = batch.actions[row, start : start + STEPS, :3].sum(dim=0).cpu()
                cost = partial(
                    energies,
                    model,
                    batch.latents[row, start],
                    batch.states[row, start],
                    batch.latents[row, start + STEPS],
                )
                plan = planner.plan(cost, torch.Generator().manual_seed(int(generator.integers(2**62))))
                planned = plan.actions[:, :3].sum(dim=0)
                errors.append([float((planned - demonstrated).abs().sum()), float(demonstrated.abs().sum())])
                ids.append(batch.episode_ids[row])
    columns = np.stack([np.array(errors), np.ones((len(errors), 2))])
    for policy, score in zip(("plans", "zero action"), bootstrap(_compute_scores, columns, ids), strict=True):
        print(f"{policy}: Action Score {score:.1f} (best 80; 95 % interval over episodes)")
    plans_cm, zero_cm = 100 * columns[0].mean(axis=0)
    print(f"mean error of the displacement: plans {plans_cm:.1f} cm, zero action {zero_cm:.1f} cm")


def _compute_scores(sums: np.ndarray) -> np.ndarray:
    return np.asarray(np.maximum(0.0, 800 * (0.1 - sums[0] / sums[1])))


if __name__ == "__main__":
    main()
