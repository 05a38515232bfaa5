"""The command init: a config for the data and the machine that are there."""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from vjepa2_ac.cli.options import Commands, argument, as_model, as_path, as_place, command
from vjepa2_ac.errors import InputError, UserError
from vjepa2_ac.storage import is_url, try_writing_at, user_can_write, write_atomically

if TYPE_CHECKING:
    from vjepa2_ac.init.draft import Draft
    from vjepa2_ac.init.found import FoundData

FORMS = ("droid", "lerobot", "npz", "raw", "rlds", "sim", "scratch")
_SIMULATED = "demo/data"
_WITHOUT_A_PATH = {
    "droid": "gs://gresearch/robotics/droid/1.0.1",
    "lerobot": "hf://datasets/lerobot/droid_1.0.1",
    "raw": "gs://gresearch/robotics/droid_raw/1.0.1",
    "sim": _SIMULATED,
    "scratch": _SIMULATED,
}
_TRIAL_STEPS = 100
_RECORD = "vjepa2-ac simulate record {path} --domain B --episodes 60 --seed 5"


def add_to(commands: Commands) -> None:
    """Add `init` to a parser."""
    text = (
        "Write a commented config for the data and the machine that are there, look at the data as `data check` does,"
        " and say what to do next. Guesses are marked. Exit status as of `data check`."
    )
    parser = command(commands, "init", _init, text)
    text = (
        f"one of {', '.join(FORMS)}; or left out: the files tell. sim: simulated data and the tiny model. scratch: a"
        " fresh predictor on V-JEPA 2.1's ViT-B, without Meta's action-conditioned model"
    )
    argument(parser, "form FORM", text, as_place, nargs="?")
    argument(
        parser, "path PATH", "the data: a folder, or a URL (droid, lerobot, raw: DROID's own)", as_place, nargs="?"
    )
    argument(parser, "--out FILE", "the config (NAME.yaml, by the data's folder)", as_path)
    text = "another one than the released: what model.base takes, such as builtin:sim-tiny; scratch: an encoder"
    argument(parser, "--model MODEL", text, as_model)
    argument(parser, "--overwrite", "write over a config that is there", action="store_true")


def _init(options: argparse.Namespace) -> int:
    form, path = _form_and_path(options.form, options.path)
    name = _name_of(form, path)
    out = options.out or Path(f"{name}.yaml")
    if out.exists() and not options.overwrite:
        raise InputError(
            where=str(out), found="a file is there", needed="a new one", fix="--out another, or --overwrite"
        )

    with user_can_write(f"--out {out}"):
        try_writing_at(out.parent)
    if options.model is not None:
        _require_model(options.model, is_encoder=form == "scratch")
    is_missing = path == _SIMULATED and not Path(path).exists()
    found = _found(form, path, is_missing=is_missing)

    from vjepa2_ac.console.progress import ConsoleReporter, console
    from vjepa2_ac.init.choices import download_of
    from vjepa2_ac.init.draft import TINY, choose_model, make_draft
    from vjepa2_ac.init.look import measured
    from vjepa2_ac.init.machine import this_machine
    from vjepa2_ac.reporter import INDEXING

    with ConsoleReporter() as reporter:
        found = found if is_missing else measured(found, reporter.task(INDEXING))
    model_path = options.model or (TINY if path == _SIMULATED or form == "sim" else None)
    model = choose_model("scratch" if form == "scratch" else "released", model_path)
    machine = this_machine(found.sample if is_url(found.path) else "")
    console.print(f"Data: {'; '.join(found.about)}.\nMachine: {machine.about}.")
    draft = make_draft(found, machine, model, run_dir=f"runs/{name}")
    with user_can_write(f"--out {out}"):
        write_atomically(out, draft.text(found, machine).encode())
    _say(draft, out, draft.costs(machine))
    status = 0 if is_missing else _check(draft, out)
    if status:
        console.print(f"\nMend this first, then: vjepa2-ac data check {out}", soft_wrap=True)
    fetch = None if Path(model.path).exists() else download_of(model, machine)
    for line in _next(draft, found, out, name, fetch, is_missing=is_missing):
        console.print(line, soft_wrap=True)
    return status


def _require_model(name: str, *, is_encoder: bool) -> None:
    from vjepa2_ac.model.base_model import find_base, find_encoder_path

    (find_encoder_path if is_encoder else find_base)(name)


def _form_and_path(first: str | None, second: str | None) -> tuple[str | None, str]:
    """Return the form, None if the files are to tell, and the place of the data."""
    if first is None:
        raise InputError(
            where="init", found="no data", needed=f"a folder, a URL, or one of {', '.join(FORMS)}",
            fix="Try `vjepa2-ac init sim`, or `vjepa2-ac init path/to/your/data`",
        )  # fmt: skip
    if first not in FORMS:
        if second is not None:
            raise InputError(where="init", found=f"{first!r}, no form of data", needed=f"one of {', '.join(FORMS)}")
        return None, first
    if second is None and first not in _WITHOUT_A_PATH:
        raise InputError(where=f"init {first}", found="no path", needed="the folder or the URL of the data")
    return first, second or _WITHOUT_A_PATH[first]


def _name_of(form: str | None, path: str) -> str:
    """Return a name for the config and the run: of the last folder that is not a version."""
    if path == _SIMULATED:
        return "scratch" if form == "scratch" else "sim"
    parts = [re.sub(r"\W+", "-", part).strip("-") for part in path.split("/") if not re.fullmatch(r"[\d.v]*", part)]
    name = next((part for part in reversed(parts) if part), "own")
    return f"scratch-{name}" if form == "scratch" else name


def _found(form: str | None, path: str, *, is_missing: bool) -> FoundData:
    from vjepa2_ac.init.look import look_at, simulated

    if is_missing:
        return simulated(path)
    return look_at(path, {"droid": "rlds", "sim": "rlds", "scratch": None}.get(form or "", form))


def _say(draft: Draft, out: Path, costs: list[str]) -> None:
    from vjepa2_ac.console.progress import console
    from vjepa2_ac.init.found import guesses

    for line in costs:
        console.print(line)
    console.print(f"Written: {out}")
    for key, why in guesses(draft.knobs).items():
        console.print(f"  guessed  {key}{': ' if why else ''}{why}", soft_wrap=True)


def _check(draft: Draft, out: Path) -> int:
    """Run `data check` on the config; a reason why it cannot be is printed, and the config stays."""
    from vjepa2_ac.cli.data import check_and_print
    from vjepa2_ac.console.progress import console

    console.print(f"\n$ vjepa2-ac data check {out}")
    try:
        return check_and_print(draft.config)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def _next(
    draft: Draft, found: FoundData, out: Path, name: str, fetch: tuple[str, str] | None, *, is_missing: bool
) -> list[str]:
    lines = []
    if is_missing:
        lines.append((_RECORD.format(path=found.path), "the data; half a minute on a core of its own"))
    if fetch:
        lines.append((fetch[0], f"the model, once: {fetch[1]}"))
    trial, steps = f"runs/{name}-trial", draft.config.training.steps
    short = f"training.steps={_TRIAL_STEPS} validation.every=50 checkpoint.every=50"
    of_trial = ", ".join(filter(None, (f"{_TRIAL_STEPS} steps", draft.time_of(_TRIAL_STEPS))))
    of_run = draft.time_of(steps) or f"time not known before the trial: its time a step, times {steps:,}"
    lines += [
        (f"vjepa2-ac train {out} --check", "everything that can fail, before the first step"),
        (f"vjepa2-ac train {out} run_dir={trial} {short}", f"{of_trial}: does it learn, how long does a step take?"),
        (f"vjepa2-ac evaluate {trial}", "against the base, on held-out episodes"),
        (f"vjepa2-ac train {out}", f"the real run, {of_run}; the same command goes on after a stop"),
    ]
    return ["\nNext:", *(f"  {line}   # {about}" for line, about in lines)]
