"""Fine-tune a model with LoRA, and measure on held-out episodes whether it helped.

    python examples/finetune.py [DATA] [key=value ...]

DATA is a folder in DROID's RLDS format. Without it, a few episodes of the simulated arm are recorded first. Any config
key can be set, such as training.steps=400 or run_dir=demo/examples/other. Started again, the run resumes.
"""

import sys
from pathlib import Path

from vjepa2_ac import UserError, evaluate, load_config, load_run, train
from vjepa2_ac.process import StoppedError
from vjepa2_ac.simulation.record import RecordingSpec, record_dataset

RECORDED = Path("demo/examples/data")


def main(*arguments: str) -> None:
    """Train, measure, and load the result."""
    data = [argument for argument in arguments if "=" not in argument]
    if not data and not RECORDED.exists():
        print("Recording 12 episodes of the simulated arm ...")
        record_dataset(RECORDED, RecordingSpec("B", steps=33, seed=4), episodes=12)
    shares = {"validation_share": 0.2, "test_share": 0.3}
    config = load_config(
        {
            "run_dir": "demo/examples/run",
            "data": {"path": data[0] if data else RECORDED, "frames": 4, "stride": 4, "workers": 0, **shares},
            "model": {"base": "builtin:sim-tiny", "dtype": "float32"},
            "adapter": {"rank": 16, "alpha": 32},
            "training": {
                "steps": 60,
                "batch_size": 6,
                "accumulation": 1,
                "learning_rate": 3e-3,
                "warmup_steps": 5,
                "precision": "fp32",
            },
            "validation": {"every": 20, "clips": 16, "batch_size": 16},
            "tracking": {"tensorboard": False},
        },
        [argument for argument in arguments if "=" in argument],
    )
    run = train(config, note=print, on_step=lambda step, metrics: print(f"step {step}: loss {metrics['loss']:.4f}"))

    result = evaluate(run, clips=64, probes=False)  # probes=True also measures action ranking
    print("Error / persistence by horizon, with its 95 % interval over held-out episodes; below 1 is better:")
    for model, ratios in result.error_over_persistence.items():
        print(f"  {model:8}", *ratios, sep="  ")
    print(*result.files, sep="\n")

    best = load_run(run, "best")  # best.world_model predicts; Controller.of_run(best) plans
    print(f"Loaded {best.checkpoint}")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except (UserError, StoppedError) as error:  # StoppedError: Ctrl-C; a checkpoint was saved
        sys.exit(f"error: {error}")
