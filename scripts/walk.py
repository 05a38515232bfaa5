"""Walk every command of every guide, in real environments that have only the extras that the guide names.

python scripts/walk.py [--at FOLDER] [PAGE ...]     `make walk`: all pages, some ten minutes on 2 cores

The commands are those of the ```sh blocks. Each runs as it stands, with `SHORTER` behind it; `GIVEN` replaces what
stands for something of the reader's; `NOT_WALKED` says of each that does not run why not. So a new command is walked,
and a new page needs an entry in `PAGES` or `NO_GUIDES`: tests/test_walk.py holds that.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
NOT_A_STRANGERS = {"PYTHONDONTWRITEBYTECODE", "PYTHONPATH", "VIRTUAL_ENV"}  # of the environment of whoever walks
PORT = 8765  # of the server; 8000 may be taken
WHEEL = "wheel"  # environments of the wheel are walked outside of the clone

# The environment of a page, until a line of it installs another one: from the clone, or the wheel, with these extras.
PAGES = {
    "README.md": "[sim]",
    "docs/QUICKSTART.md": "wheel[sim,data]",
    "docs/encoders.md": "[sim]",  # its run is compared in docs/evaluation.md
    "docs/data.md": "[data]",
    "docs/training.md": "[data]",
    "docs/evaluation.md": "[data]",
    "docs/scaling.md": "[data]",
    "docs/decoding.md": "[sim]",
    "docs/planning.md": "[sim]",
    "docs/policies.md": "[sim]",
    "docs/python.md": "[sim]",
    "docs/serving.md": "[serve]",
    "docs/troubleshooting.md": "[data]",
}
NO_GUIDES = {
    "docs/published_figures.md": "the released weights, recordings of others, RoboCasa",
    "docs/worlds.md": "environments of others, 4 GB: test_worlds.py drives those that are there",
    "docs/explore.md": "its commands serve until they are ended: tests/explore starts them",
    "CONTRIBUTING.md": "of developers: the extra dev",
    "docs/releasing.md": "of developers: the extra dev",
    "docs/IMPLEMENTATION_NOTES.md": "measurements on a GPU",
}

FEW_STEPS = (
    "training.steps=2 validation.every=1 checkpoint.every=1 validation.clips=4 validation.ranking_samples=4"
    " data.workers=0 training.batch_size=2"
    " training.accumulation=1 training.warmup_steps=0 training.allow_weak_base=true"
)
FEW_CLIPS = "--clips 4 --ranking-clips 2 --samples 8 --examples 1 --landscapes 1 --nodes 3"
FEW_SAMPLES = "planning.samples=16 planning.iterations=1"
SHORTER = {  # by the first words of a command
    "train": FEW_STEPS,
    "evaluate": FEW_CLIPS,
    "decoder": "decoder.steps=2 data.workers=0",
    "simulate record": "--episodes 10 --steps 33",
    "simulate": f"--episodes 1 --steps 1 {FEW_SAMPLES}",
    "plan": FEW_SAMPLES,
    "prior": "--steps 20",
    "monitor": "--false-alarms 0.4 || test $? = 1",  # watched episodes of a hasty model
    "data calibrate CONFIG --axes": "--limit 8 || test $? = 1",  # of so few pairs: not to plan by
    "data calibrate": "--limit 8",
    "python examples/train_loop.py": "demo/examples/data 2",
    "python examples/finetune.py": "training.steps=2 training.warmup_steps=0 training.allow_weak_base=true",
}

OF_DROID = (  # in its place, and in the place of Meta's model
    "data.path=demo/data data.idle.rule=none data.idle.ranges=null data.frames=4 data.stride=4 data.test_share=0.3"
    " data.validation_share=0.2 model.base=builtin:sim-tiny model.dtype=float32 training.precision=fp32"
)
STATE = "0.498,-0.111,0.211,3.142,0,-1.175,0"
GIVEN = {  # pattern: what the reader has; in this order, in every page
    r"(python examples/\w+\.py) \[.*": r"\1",
    r"^\.venv/bin/": "",
    r"configs/default.yaml": f"configs/default.yaml {OF_DROID}",
    r"builtin:(debug|default)": rf"builtin:\1 {OF_DROID}",
    r"CONFIG checkpoint.remote=gs://my-bucket/my-run": "builtin:demo run_dir=runs/mirrored checkpoint.remote=mirror",
    r"CONFIG": "builtin:demo",
    r" --episode B_seed5_00h39_000039 --start 5": "",  # of the 60 that the demo records
    r"RUN_OR_MODEL|\bMODEL\b": "builtin:sim-tiny",
    r"init PATH|init data/my_robot$": "init demo/data --model builtin:sim-tiny --out my.yaml --overwrite",
    r"runs/(lora|a)\b": "demo/run",
    r"runs/(other|b)\b": "demo/other",
    r"runs/c\b": "demo/scratch",
    r"runs/decoder": "demo/decoder",
    r"checkpoints/vjepa2-ac-vitg.pt": "builtin:sim-tiny",
    r"(droid|other)\.yaml": "builtin:demo",
    r"now.png": "docs/plan_start.png",
    r"--state …": f"--state {STATE}",
    r" …": f" --start docs/plan_start.png --goal docs/plan_goal.png --state {STATE}",
}
NOT_WALKED = {  # pattern: why
    r"^make demo$": "takes minutes; its commands are walked first, on less",
    r"^make test$": "the suite itself",
    r"^python3 -m venv|^\. ": "the environment is made here",
    r"download( vjepa2.1-vitb-384)?$": "gigabytes",
    r"configs/scratch_vitb.yaml( --check)?$(?<!doctor configs/scratch_vitb.yaml)": "needs a download",
    r"^torchrun|^accelerate|^sbatch|^ACCELERATE": "several GPUs; tests/distributed and tests/test_train_slurm.py",
    r"--engine ray": "600 MB; tests/encoding/test_ray_engine.py",
    r"cache_dir=gs://": "needs a bucket; tests/encoding/test_bucket.py",
    r"optuna|^GRID|^for run in sweep": "minutes; tests/test_sweeps.py",
    r"^python (mp4_and_csv|ros2_bag|lance_to_files)": "needs recordings; tests/init/test_converters.py runs it",
    r"^cd day1": "needs the record of a server; tests/serving/test_recording.py makes the decision again",
    r"^vjepa2-ac score": "needs chunks of a policy; tests/evaluation/policies makes some",
    r"planning.axes=": "refused where the axes were fitted to so few pairs; tests/planning/test_axes.py",
    r"^vjepa2-ac serve": "walked last, with the simulated arm as its client",
}
BEFORE = (  # as `vjepa2-ac demo`, and what other pages have of it
    "vjepa2-ac simulate record demo/data --domain B --seed 5",
    "vjepa2-ac train builtin:demo",
    "vjepa2-ac decoder builtin:demo",
    "vjepa2-ac evaluate demo/run",
    "vjepa2-ac imagine demo/run --decoder demo/decoder --actions up,left,none --steps 4",
    "vjepa2-ac train builtin:demo run_dir=demo/other seed=1",
    "vjepa2-ac evaluate demo/other",
)


@dataclass(frozen=True)
class Step:
    """A command of a page: as it stands there, and what is run of it in which environment; or why it is not."""

    page: str
    shown: str
    run: str
    where: str  # such as [sim], wheel[sim,data]
    why_not: str = ""


def commands_of(text: str) -> list[str]:
    """Return the commands of a page, or of a part of it, without comments; continued lines are one."""
    blocks = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    shown = [re.sub(r"\s+", " ", re.sub(r"(^|\s)#\s.*", "", line)).strip() for line in lines]
    return [line for line in shown if line]


def shorter(command: str) -> str:
    """Return what stands behind a command so that it takes seconds; "" where it does anyhow."""
    words = re.sub(r"^.*vjepa2-ac ", "", command)
    return next((less for start, less in SHORTER.items() if f"{words} ".startswith(f"{start} ")), "")


def steps_of(page: str) -> list[Step]:
    """Return the walk through a page; of docs/python.md and README.md the scripts of examples/, too."""
    text, where = (ROOT / page).read_text(), PAGES[page]
    steps = []
    for shown in [*commands_of(text), *re.findall(r"`(python examples/\w+\.py [^`]*)`", text)]:
        if installs := re.search(r'pip install .*\[([\w,]+)\]"', shown):
            kind = WHEEL if "dist/" in shown else ""
            where = where if where.startswith(WHEEL) else f"{kind}[{installs[1]}]"
            steps.append(Step(page, shown, "", where, "the environment is made here"))
            continue
        reason = next((why for pattern, why in NOT_WALKED.items() if re.search(pattern, shown)), "")
        run = shown
        for pattern, given in GIVEN.items():
            run = re.sub(pattern, given, run)
        here = "[sim]" if "vjepa2-ac simulate" in shown and "sim" not in where else where  # docs/data.md says so
        steps.append(Step(page, shown, f"{run} {shorter(shown)}".strip(), here, reason))
    return steps


class Walk:
    """The folder of a walk: a copy of the project, its wheel, an empty folder for the wheel, and the environments."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.clone, self.outside = folder, folder / "clone", folder / "outside"
        self.failed: list[str] = []

    def copy(self) -> None:
        """Copy what git knows or would add, and build the wheel of it."""
        words = ["git", "ls-files", "-z", "-co", "--exclude-standard"]
        names = subprocess.run(words, cwd=ROOT, capture_output=True, check=True, text=True).stdout.split("\0")
        for name in filter(None, names):
            target = self.clone / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, target, follow_symlinks=False)
        self.outside.mkdir()
        building = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(self.folder / "dist")]
        subprocess.run(building, cwd=self.clone, check=True, stdout=subprocess.DEVNULL)

    def environment(self, where: str) -> Path:
        """Return the programs of an environment, which is made if it is not there yet."""
        programs = self.folder / f"env-{re.sub(r'[^a-z]', '-', where)}" / "bin"
        if not programs.exists():
            began = time.monotonic()
            subprocess.run([sys.executable, "-m", "venv", str(programs.parent)], check=True)
            extras = where.removeprefix(WHEEL)
            (wheel,) = (self.folder / "dist").glob("*.whl")
            what = [f"{wheel}{extras}"] if where.startswith(WHEEL) else ["-e", f".{extras}"]
            words = [str(programs / "pip"), "install", "--quiet", "-c", "constraints.txt", *what]
            subprocess.run(words, cwd=self.clone, check=True, stderr=subprocess.DEVNULL)
            print(f"{where}: installed in {time.monotonic() - began:.0f} s", flush=True)
        return programs

    def run(self, where: str, command: str, expected: int = 0) -> str:
        """Run a command; return what it said, and remember it if its status is another one than expected."""
        done, began = self._start(where, command), time.monotonic()
        said, _ = done.communicate()
        print(f"{where:16} {time.monotonic() - began:5.0f} s  {command}", flush=True)
        if done.returncode != expected:
            self.failed.append(f"{where}: {command}\nstatus {done.returncode}\n{said[-3000:]}")
            print(self.failed[-1], flush=True)
        return said

    def _start(self, where: str, command: str) -> subprocess.Popen[str]:
        programs = self.environment(where)
        variables = {key: value for key, value in os.environ.items() if key not in NOT_A_STRANGERS}
        return subprocess.Popen(
            ["bash", "-c", command],  # noqa: S607
            cwd=self.outside if where.startswith(WHEEL) else self.clone,
            env=variables | {"PATH": f"{programs}:{os.environ['PATH']}"},
            text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip

    def serve(self) -> None:
        """Connect to a server, first without the extra `serve`: the hint, pasted, installs it."""
        [serves] = [step for step in steps_of("docs/serving.md") if step.shown.startswith("vjepa2-ac serve")]
        connect = f"PlanningClient('ws://127.0.0.1:{PORT}').close()"
        command = f'python -c "from vjepa2_ac.serving.client import PlanningClient; {connect}"'
        server = self._start(serves.where, f"exec {serves.run} --port {PORT}")
        try:
            for where in ("[sim]", PAGES["docs/QUICKSTART.md"]):
                hint = re.search(r"(\S*pip install .*)\.$", self.run(where, command, expected=1).strip())
                if hint is None or "[serve]" not in hint[1]:
                    self.failed.append(f"{where}: no hint that installs [serve]")
                    continue
                self.run(where, hint[1])
                self.run(
                    where,
                    f"for i in $(seq 60); do {command} && exit; sleep 2; done; exit 1",
                )
        finally:
            server.terminate()
            said, _ = server.communicate(timeout=60)
        if server.returncode:
            self.failed.append(f"{serves.where}: {serves.run}\nstatus {server.returncode}\n{said[-3000:]}")


def main() -> int:
    """Walk the pages; return 1 if a command failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--at", type=Path, help="a new folder that is kept, with its environments")
    parser.add_argument("pages", nargs="*", metavar="PAGE", help=f"of {', '.join(PAGES)}")
    options = parser.parse_args()
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="walk-") as temporary:
        walk = Walk((options.at or Path(temporary)).absolute())
        if not walk.clone.exists():
            walk.copy()
            for command in BEFORE:
                walk.run("[sim]", f"{command} {shorter(command)}")
            shutil.copytree(walk.clone / "demo", walk.outside / "demo")
        for page in options.pages or PAGES:
            print(f"\n{page}")
            for step in steps_of(page):
                if step.why_not:
                    print(f"{step.where:16} not run  {step.shown}: {step.why_not}", flush=True)
                else:
                    walk.run(step.where, step.run)
            if page == "docs/serving.md":
                walk.serve()
    print(f"\n{time.monotonic() - began:.0f} s; {len(walk.failed)} failed", *walk.failed, sep="\n\n")
    return bool(walk.failed)


if __name__ == "__main__":
    sys.exit(main())
