"""What is compared with what? Every cell of the evidence, and the settings that were chosen for it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

from other_worlds import MANY, TASKS

from vjepa2_ac.config import AdapterConfig, TrainingConfig
from vjepa2_ac.config.planning import EnergyConfig, LimitsConfig, PlanningConfig
from vjepa2_ac.simulation.domains import DOMAIN_A, DOMAIN_B, Domain, DomainRanges

Base = Literal["one camera", "many cameras", "none"]

_LOOK = replace(DOMAIN_B, name="look", base_yaw_deg=DOMAIN_A.base_yaw_deg, lag_s=DOMAIN_A.lag_s)
_MOTION = replace(DOMAIN_A, name="motion", base_yaw_deg=60.0, lag_s=DOMAIN_B.lag_s)
SHIFTS: dict[str, Domain | DomainRanges] = {
    "look": _LOOK,
    "motion": _MOTION,
    "randomized": DomainRanges(azimuth_deg=(80.0, 130.0), textures=True, moving=3),
}
"""look: camera turned by 43 degrees, other colours, light, table and things on it; the arm moves as in A. motion: looks
like A, but the robot is mounted turned by 60 degrees, so that an action moves the arm elsewhere in the picture.
randomized: in every episode another camera, from a side that no base has seen, colours, light and textures drawn anew,
and three things that circle on the table. Tasks of worlds that others made (`other_worlds.TASKS`) are shifts, too: of
that world before and after its change."""

TURNS: dict[str, float] = {
    "look": DOMAIN_A.camera.azimuth_deg - _LOOK.camera.azimuth_deg,
    "motion": _MOTION.base_yaw_deg,
}
"""By how many degrees what the robot does seems turned, to a base of domain A."""

SEEDS, MORE_SEEDS = 3, 5
"""Of our own arm: more where all is anew, since intervals of three overlap there that matter."""

BASES: tuple[Base, ...] = ("one camera", "many cameras")
"""one camera: trained on domain A alone. many cameras: on 800 worlds, each seen by another camera (the demo's base)."""

IN_OUT = ("predictor_embed", "predictor_proj", "action_encoder", "state_encoder")
AXES = "zero-shot, calibrated axes"
"""No weight changes: the base plans in axes that are fitted to the demonstrations (`data calibrate --axes`)."""
BEST = "LoRA r32 + in/out"
"""The LoRA that takes part in every comparison; not chosen by test goals (`--choose`)."""
LONGER = f"{BEST}, 3x steps"
"""Of the turned robot and where all is anew: the usual steps leave most to be done there."""
BEFORE = "zero-shot, before the change"
"""The base in the scene that it was trained on, in worlds of others alone: what is there to lose?"""
FROM_PRIOR = f"{BEST}, from a prior"
"""What both know, the model and who imitates; in worlds of others alone."""
WHERE_ALL_VARIES = ("in/out only", "LoRA r4 + in/out", "LoRA r16", "DoRA r16")
"""Other ways, where all is anew: on the base of many cameras alone."""
ROLLOUTS = {f"{BEST}, rollout of {steps}": steps for steps in (1, 3)}
"""How many steps the loss rolls out, instead of 2: on the base of many cameras alone."""

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
    start_std=0.67,
    limits=LimitsConfig(xyz=(0.075, 0.075, 0.075), gripper_mode="held"),
    energy=EnergyConfig(distance="l1"),
)
"""As the reach tasks of FACTS' prototype: 64 samples, 4 iterations, horizon 1, 7.5 cm an axis and model step. In worlds
that others made each goal on the way says what the gripper does."""


@dataclass(frozen=True)
class Method:
    """How the weights change."""

    name: str
    kind: Literal["zero-shot", "calibrated", "LoRA", "full", "scratch", "cloned"]
    rank: int = 0
    in_out: bool = False  # whether the layers before and after the blocks are trained whole, beside the adapter
    dora: bool = False
    blocks: bool = True  # False: of the blocks one layer alone, by rank 1 (PEFT asks for one)
    times: int = 1  # so many times the steps
    layer: int | None = None  # the block of the encoder after which features are taken; None: the last
    rollout: int = 2  # steps of the loss
    prior: bool = False  # whether its search starts from an action prior of the same demonstrations
    learning_rate: float = 1e-3

    @property
    def has_base(self) -> bool:
        """Whether it begins with the weights of a base."""
        return self.kind not in {"scratch", "cloned"}

    @property
    def adapter(self) -> AdapterConfig:
        """The adapter section of its config."""
        if self.kind != "LoRA":
            return AdapterConfig(kind="none")
        whole = IN_OUT if self.in_out else ()
        given = {
            "rank": self.rank,
            "alpha": 2.0 * self.rank,
            "dropout": 0.0,
            "modules_to_save": whole,
            "dora": self.dora,
        }
        return AdapterConfig.model_validate(given if self.blocks else {**given, "targets": ("blocks.0.attn.q",)})

    @property
    def training(self) -> TrainingConfig:
        """The training section of its config."""
        return TRAINING.model_copy(
            update={
                "steps": STEPS * self.times,
                "rollout_steps": self.rollout,
                "learning_rate": self.learning_rate,
                "allow_weak_base": True,
            }
        )


METHODS = {
    method.name: method
    for method in (
        Method("zero-shot", "zero-shot"),
        Method(BEFORE, "zero-shot"),
        Method(AXES, "calibrated"),
        *(
            Method(f"LoRA r{rank}{' + in/out' * both}", "LoRA", rank, both, learning_rate=3e-3 if rank > 16 else 5e-3)
            for both in (False, True)
            for rank in (4, 8, 16, 32)
        ),
        Method(LONGER, "LoRA", 32, in_out=True, times=3, learning_rate=3e-3),
        Method(FROM_PRIOR, "LoRA", 32, in_out=True, prior=True, learning_rate=3e-3),
        *(Method(name, "LoRA", 32, in_out=True, rollout=steps, learning_rate=3e-3) for name, steps in ROLLOUTS.items()),
        Method("in/out only", "LoRA", 1, in_out=True, blocks=False, learning_rate=5e-3),
        Method("DoRA r16", "LoRA", 16, dora=True, learning_rate=5e-3),
        Method("full", "full", learning_rate=8e-3),
        Method("scratch", "scratch", learning_rate=1.2e-2),
        Method("scratch, features of block 3 of 4", "scratch", layer=3, learning_rate=1.2e-2),
        Method("scratch, 3x steps", "scratch", times=3, learning_rate=1.2e-2),
        Method("behaviour cloning", "cloned"),  # an action prior, as `vjepa2-ac prior` trains it
    )
}

_ELSEWHERE = {BEST: (1e-3, 3e-3, 8e-3), "full": (2e-3, 8e-3, 1.6e-2)}
_LOOK_RATES = {
    "LoRA r16 + in/out": (3e-3, 5e-3, 8e-3),
    BEST: (2e-3, 3e-3, 5e-3, 8e-3),
    "full": (1e-3, 2e-3, 4e-3, 8e-3, 1.6e-2),
    "scratch": (1.5e-3, 3e-3, 6e-3, 1.2e-2, 2.4e-2),
}
_RATES: dict[str, dict[str, tuple[float, ...]]] = {
    "look": _LOOK_RATES,
    "motion": {**_ELSEWHERE, "scratch": (3e-3, 1.2e-2, 2.4e-2)},
    "randomized": {
        BEST: (1e-4, 3e-4, 1e-3, 3e-3, 8e-3),
        "full": (5e-4, 1e-3, 2e-3, 8e-3),
        "scratch": (1e-3, 3e-3, 1.2e-2),
        "scratch, 3x steps": (1e-3, 3e-3),
    },
    "Lift": {**_ELSEWHERE, "scratch, 3x steps": (3e-3, 6e-3, 1.2e-2)},
}
CANDIDATES = {
    f"{name}, lr {rate:g}": replace(METHODS[name], name=f"{name}, lr {rate:g}", learning_rate=rate)
    for of in _RATES.values()
    for name, rates in of.items()
    for rate in rates
}
"""What the learning rates were chosen from, on validation episodes and goals of each shift; of worlds that others made
on Lift alone, for all their tasks."""


CHOSEN = {
    "randomized": {
        **dict.fromkeys((BEST, LONGER), 3e-4),
        **dict.fromkeys(WHERE_ALL_VARIES, 5e-4),
        **dict.fromkeys(("full", "scratch", "scratch, 3x steps"), 1e-3),
    },
    "Lift": {"scratch": 3e-3, "scratch, 3x steps": 6e-3},
}
"""Learning rates of a shift where another than that of `look` was the best; other ranks have LoRA's share of theirs."""


def method_of(name: str, shift: str = "look") -> Method:
    """Return a method, or a candidate for one, by its name, with the learning rate that was chosen for a shift."""
    method = METHODS[name] if name in METHODS else CANDIDATES[name]
    chosen = CHOSEN.get(shift if shift in SHIFTS else "Lift", {})
    return replace(method, learning_rate=chosen.get(name, method.learning_rate))


@dataclass(frozen=True)
class Cell:
    """One run: trained once, measured once."""

    shift: str  # of SHIFTS, or a task of other_worlds.TASKS
    base: Base
    method: str
    episodes: int  # demonstrations of the shifted domain
    seed: int  # decides which demonstrations, fresh weights, order, and the goals

    @property
    def name(self) -> str:
        """What its files are called."""
        words = f"{self.shift}-{self.base}-{self.method}-k{self.episodes}-s{self.seed}"
        for long, short in ((" + in/out", "-io"), ("in/out", "io"), (", 3x steps", "-3x"), (",", ""), (" ", "-")):
            words = words.replace(long, short)
        return words


def all_cells(at_most: int) -> Iterator[Cell]:
    """Yield every cell, those that matter most first; of each change so many seeds, and no more than `at_most`."""
    seeds = min(at_most, SEEDS)
    main = ("zero-shot", AXES, BEST, "full", "scratch")
    elsewhere = {BEFORE, LONGER, FROM_PRIOR, *ROLLOUTS, *main}
    others = tuple(name for name, method in METHODS.items() if method.kind != "cloned" and name not in elsewhere)
    for seed in range(seeds):
        yield from _of("look", main, 20, seed)
    for seed in range(seeds):
        yield from _of("look", others, 20, seed)
    for seed in range(seeds):
        yield from _of("motion", (*main, LONGER, "scratch, 3x steps"), 20, seed)
    for seed in range(min(at_most, MORE_SEEDS)):
        yield from _of("randomized", ("zero-shot", BEST, "full", "scratch", "scratch, 3x steps"), 20, seed)
        yield Cell("randomized", "many cameras", LONGER, 20, seed)
    for seed in range(seeds):
        yield from (Cell("look", "many cameras", name, 20, seed) for name in ROLLOUTS)
        yield from (Cell("randomized", "many cameras", name, 20, seed) for name in WHERE_ALL_VARIES)
    for seed in range(seeds):
        for episodes in (10, 40):
            yield from _of("look", (BEST, "full", "scratch"), episodes, seed)
        yield Cell("look", "none", "scratch, 3x steps", 10, seed)  # steps or demonstrations: which does a base save?
    yield from world_cells(at_most)


def world_cells(at_most: int) -> Iterator[Cell]:
    """Yield the cells of worlds that others made."""
    for seed in range(at_most):
        for task, about in TASKS.items():
            if seed == 0 and about.origin is None:
                yield Cell(task, "one camera", BEFORE, 0, seed)
            if seed < about.seeds:
                yield from _of(task, IN_EVERY_WORLD, 20, seed)
            if seed < about.seeds > 1:
                yield Cell(task, "one camera", FROM_PRIOR, 20, seed)
    for task in MANY:
        yield from _of(task, IN_SOME_WORLDS, 20, 0)
        for episodes in (5, 80):
            yield from _of(task, IN_EVERY_WORLD[1:], episodes, 0)


IN_EVERY_WORLD = ("zero-shot", BEST, "full", "scratch, 3x steps", "behaviour cloning")
IN_SOME_WORLDS = ("in/out only", "LoRA r4", "LoRA r16", "DoRA r16", "scratch")


def candidate_cells() -> Iterator[Cell]:
    """Yield what the learning rates are chosen by: one base, one seed."""
    for shift, of in _RATES.items():
        for name, rates in of.items():
            base: Base = "none" if not METHODS[name].has_base else "many cameras" if shift in SHIFTS else "one camera"
            for rate in rates:
                yield Cell(shift, base, f"{name}, lr {rate:g}", 20, 0)


def _of(shift: str, methods: tuple[str, ...], episodes: int, seed: int) -> Iterator[Cell]:
    for name in methods:
        bases: tuple[Base, ...] = BASES if shift in SHIFTS else BASES[:1]
        if not METHODS[name].has_base:
            bases = ("none",)
        for base in bases:
            yield Cell(shift, base, name, 0 if METHODS[name].kind == "zero-shot" else episodes, seed)


def energies_of(cell: Cell) -> tuple[Literal["l1", "l2"], ...]:
    """Return by which energies a cell plans: upstream's, and for the methods that matter most the squared one, too."""
    both = cell.shift == "look" and cell.episodes in (0, 20) and cell.method in ("zero-shot", BEST, "full")
    return ("l1", "l2") if both else ("l1",)
