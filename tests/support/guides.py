"""The commands of the guides, and options with which they take only seconds."""

import re

FEW_STEPS = (
    "training.steps=2 validation.every=1 checkpoint.every=1 validation.clips=4 validation.ranking_samples=4"
    " data.workers=0 training.batch_size=2"
    " training.accumulation=1 training.warmup_steps=0 training.allow_weak_base=true"
)
SHORTER = {  # by the first words of a command
    "train": FEW_STEPS,
    "evaluate": "--clips 4 --ranking-clips 2 --samples 8 --examples 1 --landscapes 1 --nodes 3",
    "simulate record": "--episodes 10 --steps 25",
    "plan": "planning.samples=16 planning.iterations=1",
    "data calibrate": "--limit 8",
    "simulate": "--episodes 2 --steps 2 planning.samples=16 planning.iterations=1",
}


def commands_of(text: str) -> list[str]:
    """Return the commands of a page, or of a part of a page, without comments; continued lines are joined."""
    blocks = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    shown = [re.sub(r"\s+", " ", re.sub(r"(^|\s)#\s.*", "", line)).strip() for line in lines]
    return [line for line in shown if line]


def shorter(command: str) -> list[str]:
    """Return additional options for a command, with which it takes only seconds."""
    words = command.removeprefix("vjepa2-ac ")
    return next((options.split() for start, options in SHORTER.items() if f"{words} ".startswith(f"{start} ")), [])
