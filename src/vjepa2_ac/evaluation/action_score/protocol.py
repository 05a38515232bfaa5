"""The protocol of the Action Score. No option changes it, so that scores of different runs are comparable.

Source: facebookresearch/jepa-wms @ 6eafb14, configs/evals/simu_env_planning/droid/vj2ac,
evals/simu_env_planning/planning (planner.py: CEMPlanner; objectives.py: ReprTargetDistMPCObjective; plan_evaluator.py:
sample_traj_segment_from_dset), app/vjepa_wm/modelcustom/simu_env_planning/vit_enc_preds.py: EncPredWM.unroll.
Where it differs: docs/evaluation.md.
"""

from vjepa2_ac.config.planning import CemConfig, EnergyConfig, LimitsConfig, PlanningConfig

STEPS = 3  # of a scored plan
FRAMES = STEPS + 1  # required of a clip
FRAMES_SEEN = 2  # by the model at most, predicted ones included
BEST_SCORE = 80.0
SCORED = PlanningConfig(
    planner="cem",
    horizon=STEPS,
    samples=300,
    iterations=15,
    gripper_start_std=0.1,
    limits=LimitsConfig(xyz=(0.1, 0.1, 0.1), rotation=0.1, gripper=0.75, gripper_mode="free"),
    energy=EnergyConfig(distance="l2", steps="last"),
    cem=CemConfig(
        elites=10,
        momentum_mean=0.0,
        momentum_std=0.0,
        momentum_mean_gripper=0.0,
        momentum_std_gripper=0.0,
        try_mean=True,
    ),
)
