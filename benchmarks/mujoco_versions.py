"""Compare two versions of MuJoCo: the same actions from the same starts of a third-party environment.

    worlds/libero/bin/python benchmarks/mujoco_versions.py build/mujoco libero libero_spatial --near
    other/bin/python benchmarks/mujoco_versions.py build/mujoco libero libero_spatial --near
    worlds/libero/bin/python benchmarks/mujoco_versions.py build/mujoco libero libero_spatial --near
    python benchmarks/mujoco_versions.py build/mujoco           # the table

Run the program with the Python of each environment (docs/worlds.md); the arguments after the folder are those of
examples/worlds. Each run records the scripted expert in its version of MuJoCo, if no recording of that version is in
the folder, and replays the recordings of all versions. The replayed actions are the inputs of the environment's
controller at each control step, without feedback from the state, as in a replay of LIBERO's demonstrations. The replay
of a recording in its own version shows the differences that are not due to the version.

The program runs without `vjepa2_ac`, which is not installed in these environments.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

WORLDS = Path(__file__).resolve().parents[1] / "examples" / "worlds"
PROBLEMS = 10  # seeds 0 to 9; in LIBERO they select the benchmark's fixed initial states
STEPS_AFTER_SUCCESS = 10  # control steps of the expert after its first success
PIXEL_LEVELS = 8  # of 255; smaller differences of a pixel are not visible
HEAD = (
    "task | recorded with | replayed with | solved by the expert | solved by the replay"
    " | object at the start, mm | object at the end, mm | first frame, levels | pixels that differ"
)


def main() -> None:
    """Record and replay in this environment, or print the table of a folder."""
    folder, *words = Path(sys.argv[1]), *sys.argv[2:]
    if not words:
        print(make_table(folder))
        return
    folder.mkdir(parents=True, exist_ok=True)
    world, task, here = open_world(*words), " ".join(words[1:]), f"MuJoCo {version('mujoco')}"
    own = folder / f"{task} in {here}.npz"
    if not own.exists():
        save(own, [run(world, seed) for seed in range(PROBLEMS)])
    for recorded in sorted(folder.glob(f"{task} in *.npz")):
        replayed = recorded.with_name(f"{recorded.stem}, replayed in {here}.npz")
        if ", replayed" not in recorded.name and not replayed.exists():
            actions = np.load(recorded)["actions"]
            save(replayed, [run(world, seed, actions[seed]) for seed in range(PROBLEMS)])


def open_world(name: str, *options: str) -> Any:
    """Return the environment object of a program in examples/worlds."""
    sys.path.insert(0, str(WORLDS))
    importlib.import_module("serve_environment")  # moves the folder behind installed packages
    spec = importlib.util.spec_from_file_location("program", WORLDS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    program = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(program)
    sys.argv = [name, *options]
    if name == "robosuite":
        return program.World(program.read_options(""))
    read, suite, number = program.read_task("")
    return program.World(suite, number, read)


def run(world: Any, seed: int, actions: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Run the expert, or replay the inputs of the controller; return the actions, positions and the first frame.

    Args:
        world: The environment.
        seed: Start of the problem.
        actions: Inputs of the controller, [control steps, inputs]; rows of NaN are not executed. None: the expert acts
            until some control steps after its first success.
    """
    _, info = world.reset(seed=seed)
    frame, start, executed, since = world.render(), get_object(world), list[np.ndarray](), 0
    if actions is not None:
        for action in actions[~np.isnan(actions).any(axis=1)]:
            world.env.step(action)
        info = world.info()
    else:
        step_inner = world.env.step

        def step_and_note(action: np.ndarray) -> Any:
            executed.append(np.array(action))
            return step_inner(action)

        world.env.step = step_and_note
        while since <= STEPS_AFTER_SUCCESS and len(executed) < get_num_steps(world):
            *_, info = world.step(None)
            since = since + 1 if info["success"] else 0
        world.env.step = step_inner
    ends = {"start_m": start, "end_m": get_object(world), "solved": np.array(bool(info["success"]))}
    return {**ends, "frame": frame, "actions": np.array(executed)}


def get_object(world: Any) -> np.ndarray:
    """Return the position of the task's object in metres."""
    if hasattr(world, "at"):  # LIBERO: the object of the first goal
        return np.array(world.at(world.goals[0][1]))
    return np.array(world.data.body_xpos[world.env.cube_body_id])  # Lift


def get_num_steps(world: Any) -> int:
    """Return the number of control steps in which the task can be solved, as in the programs."""
    return 240 * len(world.goals) if hasattr(world, "goals") else 60


def save(path: Path, episodes: list[dict[str, np.ndarray]]) -> None:
    """Write episodes; shorter action sequences are padded with NaN."""
    values = {name: np.stack([each[name] for each in episodes]) for name in ("start_m", "end_m", "solved", "frame")}
    sequences = [each["actions"] for each in episodes]
    padded = np.full((len(sequences), max(map(len, sequences)), *sequences[0].shape[1:]), np.nan)
    for row, sequence in zip(padded, sequences, strict=True):
        row[: len(sequence)] = sequence
    values["actions"] = padded
    np.savez_compressed(path, **values)  # type: ignore[arg-type]  # no name is allow_pickle


def make_table(folder: Path) -> str:
    """Return a table with a row for each replay: means over problems, and the largest value in parentheses."""
    rows = [f"| {HEAD} |", "|---" * (HEAD.count("|") + 1) + "|"]
    for path in sorted(folder.glob("*, replayed in *.npz")):
        name, _, here = path.stem.partition(", replayed in ")
        task, _, recorder = name.partition(" in ")
        recorded, replayed = np.load(folder / f"{name}.npz"), np.load(path)
        moved_mm = [1000 * np.linalg.norm(replayed[key] - recorded[key], axis=-1) for key in ("start_m", "end_m")]
        levels = np.abs(replayed["frame"].astype(float) - recorded["frame"])
        differs = 100 * (levels.max(axis=-1) > PIXEL_LEVELS).mean(axis=(1, 2))
        solved = [f"{values['solved'].sum()} of {len(values['solved'])}" for values in (recorded, replayed)]
        spread = [f"{each.mean():.1f} (at most {each.max():.1f})" for each in moved_mm]
        frame = f"{levels.mean():.2f} | {differs.mean():.1f} %"
        rows.append(f"| {' | '.join([task, recorder, here, *solved, *spread, frame])} |")
    return "\n".join(rows)


if __name__ == "__main__":
    main()
