"""The methods study: every change of the scene, base, method and learning rate that is compared.

A cell is one training and its measurement. To add a method, add a row to `METHODS` and yield its cells in `all_cells`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

from environments import TASKS

from vjepa2_ac.config import AdapterConfig, TrainingConfig
from vjepa2_ac.config.planning import LimitsConfig, PlanningConfig
from vjepa2_ac.config.section import Component
from vjepa2_ac.simulation.domains import DOMAIN_A, DOMAIN_B, Domain, DomainRanges

Base = Literal["one camera", "many cameras", "none"]

_LOOK = replace(DOMAIN_B, name="look", base_yaw_deg=DOMAIN_A.base_yaw_deg, lag_s=DOMAIN_A.lag_s)
_MOTION = replace(DOMAIN_A, name="motion", base_yaw_deg=60.0, lag_s=DOMAIN_B.lag_s)
SHIFTS: dict[str, Domain | DomainRanges] = {
    "look": _LOOK,
    "motion": _MOTION,
    "randomized": DomainRanges(azimuth_deg=(80.0, 130.0), textures=True, moving=3),
}
"""look: camera turned by 43 degrees, other colours, light, table and objects. motion: the robot is mounted turned by 60
degrees. randomized: in every episode another camera, light and textures, and three objects that circle on the table.
Tasks of third-party environments (`environments.TASKS`) are changes, too."""

SEEDS, MORE_SEEDS = 3, 5  # number of seeds: for domain shifts of the simulated arm, and for fully randomised scenes

BASES: tuple[Base, ...] = ("one camera", "many cameras")
"""one camera: trained on domain A only. many cameras: builtin:sim-tiny, trained on 800 scenes."""

IN_OUT: Any = ("predictor_embed", "predictor_proj", "action_encoder", "state_encoder")
AXES = "zero-shot, calibrated axes"
BEST = "LoRA r32 + in/out"
LONGER = f"{BEST}, 3x steps"
BEFORE = "zero-shot, before the change"
FROM_PRIOR = f"{BEST}, from a prior"
PAST = (AXES, f"{BEST}, rollout of 1", f"{BEST}, rollout of 3", "in/out only", "DoRA r16")
"""Methods whose measurements of commit 0d046757 remain in the tables, and which are not run again."""

STEPS = 400
TRAINING = TrainingConfig(
    steps=STEPS,
    batch_size=6,
    accumulation=1,
    rollout_steps=2,
    warmup_steps=20,
    precision="fp32",
    device="cpu",
    log_every=50,
)
PLANNING = PlanningConfig(
    samples=64,
    iterations=4,
    planner=Component("cem", {"start_std": 0.67}),
    limits=LimitsConfig(xyz=(0.075, 0.075, 0.075), gripper_mode="held"),
)


@dataclass(frozen=True)
class Method:
    """How the weights change."""

    name: str
    kind: Literal["zero-shot", "LoRA", "full", "scratch", "cloned", "past"]  # past: of commit 0d046757, not run again
    rank: int = 0
    in_out: bool = False  # whether the input and output projections are trained in addition to the adapter
    times: int = 1  # factor of the number of steps
    prior: bool = False  # whether the search starts from an action prior, trained on the same demonstrations
    learning_rate: float = 1e-3

    @property
    def has_base(self) -> bool:
        """Whether training starts from a base model."""
        return not self.name.startswith("scratch") and self.kind != "cloned"

    @property
    def adapter(self) -> AdapterConfig:
        """The config section `adapter`."""
        if self.kind != "LoRA":
            return AdapterConfig(kind="none")
        whole = IN_OUT if self.in_out else ()
        return AdapterConfig(rank=self.rank, alpha=2.0 * self.rank, dropout=0.0, modules_to_save=whole)

    @property
    def training(self) -> TrainingConfig:
        """The config section `training`."""
        changes = {"steps": STEPS * self.times, "learning_rate": self.learning_rate, "allow_weak_base": True}
        return TRAINING.model_copy(update=changes)


METHODS = {
    method.name: method
    for method in (
        Method("zero-shot", "zero-shot"),
        Method(BEFORE, "zero-shot"),
        Method(AXES, "past"),
        *(
            Method(f"LoRA r{rank}{' + in/out' * both}", "LoRA", rank, both, learning_rate=3e-3 if rank > 16 else 5e-3)
            for both in (False, True)
            for rank in (4, 8, 16, 32)
        ),
        Method(LONGER, "LoRA", 32, in_out=True, times=3, learning_rate=3e-3),
        Method(FROM_PRIOR, "LoRA", 32, in_out=True, prior=True, learning_rate=3e-3),
        *(Method(name, "past") for name in PAST[1:]),
        Method("full", "full", learning_rate=8e-3),
        Method("scratch", "scratch", learning_rate=1.2e-2),
        Method("scratch, features of block 3 of 4", "past"),
        Method("scratch, 3x steps", "scratch", times=3, learning_rate=1.2e-2),
        Method("behaviour cloning", "cloned"),  # an action prior, as `vjepa2-ac prior` trains it
    )
}

CHOSEN = {
    "randomized": {
        **dict.fromkeys((BEST, LONGER), 3e-4),
        **dict.fromkeys(("LoRA r4 + in/out", "LoRA r16"), 5e-4),
        **dict.fromkeys(("full", "scratch", "scratch, 3x steps"), 1e-3),
    },
    "Lift": {"scratch": 3e-3, "scratch, 3x steps": 6e-3},
}
"""Learning rates by domain shift and method, if another rate was the best on validation goals (commit 0d046757)."""


def get_method(name: str, shift: str = "look") -> Method:
    """Return a method by its name, with its learning rate for a domain shift."""
    chosen = CHOSEN.get(shift if shift in SHIFTS else "Lift", {})
    return replace(METHODS[name], learning_rate=chosen.get(name, METHODS[name].learning_rate))


@dataclass(frozen=True)
class Cell:
    """One training and its measurement."""

    shift: str  # a key of SHIFTS or of environments.TASKS
    base: Base
    method: str
    episodes: int  # demonstrations of the shifted domain
    seed: int  # determines demonstrations, initial weights, order of clips, and goals

    @property
    def name(self) -> str:
        """Name of its files."""
        words = f"{self.shift}-{self.base}-{self.method}-k{self.episodes}-s{self.seed}"
        for long, short in ((" + in/out", "-io"), ("in/out", "io"), (", 3x steps", "-3x"), (",", ""), (" ", "-")):
            words = words.replace(long, short)
        return words


def all_cells() -> Iterator[Cell]:
    """Yield every cell, the most important first."""
    main = ("zero-shot", BEST, "full", "scratch")
    elsewhere = {BEFORE, LONGER, FROM_PRIOR, *main}
    others = tuple(
        name for name, method in METHODS.items() if method.kind not in {"cloned", "past"} and name not in elsewhere
    )
    for seed in range(SEEDS):
        yield from _list_cells("look", main, 20, seed)
    for seed in range(SEEDS):
        yield from _list_cells("look", others, 20, seed)
    for seed in range(SEEDS):
        yield from _list_cells("motion", (*main, LONGER, "scratch, 3x steps"), 20, seed)
    for seed in range(MORE_SEEDS):
        yield from _list_cells("randomized", ("zero-shot", BEST, "full", "scratch", "scratch, 3x steps"), 20, seed)
        yield Cell("randomized", "many cameras", LONGER, 20, seed)
    for seed in range(SEEDS):
        for episodes in (10, 40):
            yield from _list_cells("look", (BEST, "full", "scratch"), episodes, seed)
        yield Cell("look", "none", "scratch, 3x steps", 10, seed)  # does a base model save steps or demonstrations?
    yield from environment_cells()


def environment_cells() -> Iterator[Cell]:
    """Yield the cells of third-party environments."""
    for seed in range(MORE_SEEDS):
        for name, task in TASKS.items():
            if seed == 0:
                yield Cell(name, "one camera", BEFORE, 0, seed)
            if seed < task.seeds:
                yield from _list_cells(name, IN_EVERY_ENVIRONMENT, 20, seed)
                yield Cell(name, "one camera", FROM_PRIOR, 20, seed)
    for episodes in (5, 80):
        yield from _list_cells("Lift", IN_EVERY_ENVIRONMENT[1:], episodes, 0)


IN_EVERY_ENVIRONMENT = ("zero-shot", BEST, "full", "scratch, 3x steps", "behaviour cloning")


def _list_cells(shift: str, methods: tuple[str, ...], episodes: int, seed: int) -> Iterator[Cell]:
    for name in methods:
        bases: tuple[Base, ...] = BASES if shift in SHIFTS else BASES[:1]
        if not METHODS[name].has_base:
            bases = ("none",)
        for base in bases:
            yield Cell(shift, base, name, 0 if METHODS[name].kind == "zero-shot" else episodes, seed)
