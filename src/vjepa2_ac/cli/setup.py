"""The commands init, config, download, doctor and demo."""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import TYPE_CHECKING

from vjepa2_ac import __version__
from vjepa2_ac.cli import options as cli
from vjepa2_ac.cli.waiting import Work
from vjepa2_ac.config.loading import config_as_yaml, config_path, config_schema, load_config, packaged_configs
from vjepa2_ac.errors import InputError, UserError, counted, shell_command
from vjepa2_ac.reporter import INDEXING
from vjepa2_ac.storage import check_local_writable, translate_write_errors, write_atomically
from vjepa2_ac.storage.paths import BUILTIN, to_config_value

if TYPE_CHECKING:
    from vjepa2_ac.init.draft import Draft
    from vjepa2_ac.training.cost import MemoryEstimate

_SIMULATED = "demo/data"
_PATHS_BY_NAME = {"droid": "gs://gresearch/robotics/droid/1.0.1", "sim": _SIMULATED}
_TRIAL_STEPS = 100
_MIN_SHOWN_BYTES = 500_000  # smaller parts would be printed as 0.000 GB
_ESTIMATE_NOTE = (
    "Estimated with fake tensors. On an H100 the estimate for training from frames was within 1 % of the peak that"
    " PyTorch measured. The current estimate for training from cached latents was not compared with a measurement. The"
    " CUDA allowance was not measured."
)
_REPORTED_VARIABLES = re.compile(
    "(ACCELERATE|CUDA|GOMP|MKL|MUJOCO|NCCL|OMP|PYTORCH|TORCH|VJEPA2_AC)_.*|.*RANK|WORLD_SIZE"
)
_RECORD = "simulate record {path} --domain B --episodes 60 --seed 5"


def add_init(commands: cli.Commands) -> None:
    """Add `init` to a parser."""
    parser = cli.add_command(commands, "init", _init, "data/my_robot")
    cli.add(parser, "path PATH", "a folder, a URL, droid, or sim (the simulated arm)", cli.as_path_or_url)
    cli.add(parser, "--out FILE", "the config to write (NAME.yaml, with the name of the data's folder)", cli.as_path)
    cli.add(parser, "--scratch", "train a predictor from scratch; --model is the encoder", action="store_true")
    cli.add(parser, "--model MODEL", "the base model (Meta's released model)", cli.as_model)
    cli.add(parser, "--overwrite", "overwrite an existing config", action="store_true")


def add_config_command(commands: cli.Commands) -> None:
    """Add `config` to a parser."""
    parser = cli.add_command(commands, "config", _config, "text builtin:own_robot > my_robot.yaml")
    parser.add_argument("what", choices=["schema", "list", "show", "text"])
    cli.add(parser, "config CONFIG", "for show and text: a YAML config, or builtin:NAME", cli.as_local, nargs="?")
    cli.add_overrides(parser, "for show: such as training.steps=100")


def add_download(commands: cli.Commands) -> None:
    """Add `download` to a parser."""
    parser = cli.add_command(commands, "download", _download, "vjepa2-ac-vitg")
    cli.add(parser, "name NAME", "a name from --list (vjepa2-ac-vitg, the world model, 11.7 GB)", nargs="?")
    cli.add(parser, "--to PATH", "the file to write (checkpoints/NAME.pt)", cli.as_path)
    cli.add(parser, "--url", "another URL of the same file")
    cli.add(parser, "--list", "list names, sizes and licences, and download nothing", action="store_true")


def add_doctor(commands: cli.Commands) -> None:
    """Add `doctor` to a parser."""
    parser = cli.add_command(commands, "doctor", _doctor, "my_robot.yaml training.batch_size=4")
    cli.add_config(parser, such_as="training.batch_size=4", nargs="?")


def add_demo(commands: cli.Commands) -> None:
    """Add `demo` to a parser."""
    cli.add_command(commands, "demo", _demo, "    # then look at demo/run/report.html")


def _init(options: argparse.Namespace) -> int:
    """Write a commented config for your data and this machine.

    Uncertain values are marked GUESSED. The data are then checked as by `data check`, with the same exit status, and
    the next commands are printed.
    """
    path, is_scratch = _PATHS_BY_NAME.get(options.path, options.path), options.scratch
    name = "scratch-" * is_scratch + ("sim" if path == _SIMULATED else _name_of(path))
    out = options.out or Path(f"{name}.yaml")
    if out.exists() and not options.overwrite:
        fix = "Choose another file with --out, or add --overwrite"
        raise InputError(where=str(out), found="the file exists already", needed="a new file", fix=fix)
    with translate_write_errors(f"--out {out}"):
        check_local_writable(out.parent)

    from vjepa2_ac.init.recognize import add_episode_lengths, make_simulated_properties, read_properties
    from vjepa2_ac.model.model_files import find_base, find_encoder_path

    if options.model is not None:
        (find_encoder_path if is_scratch else find_base)(options.model)
    Work.begin("looking at the data")
    is_missing = path == _SIMULATED and not Path(path).exists()
    data = make_simulated_properties(path) if is_missing else read_properties(path)

    from vjepa2_ac.init.draft import TINY, choose_model, detect_machine, make_draft
    from vjepa2_ac.init.draft_values import list_guesses

    with cli.make_reporter() as reporter:
        data = data if is_missing else add_episode_lengths(data, reporter.task(INDEXING))
    model, machine = choose_model(options.model or (TINY if path == _SIMULATED else None), is_scratch), detect_machine()
    cli.show(f"Data: {'; '.join(data.descriptions)}.\nMachine: {machine.description}.")
    draft = make_draft(data, machine, model, run_dir=f"runs/{name}")
    with translate_write_errors(f"--out {out}"):
        write_atomically(out, draft.to_yaml(data, machine).encode())
    guessed = [
        f"  GUESSED  {key} = {value_and_reason}" for key, value_and_reason in list_guesses(draft.config_values).items()
    ]
    cli.show(*draft.costs, f"Written: {out}", *guessed, *(f"Warning: {text}." for text in draft.warnings))
    status = 0 if is_missing else _check(draft, out)
    if status:
        check, train = shell_command("data", "check", out), shell_command("train", out, "--check")
        cli.show(f"\nFix these errors and run `{check}` again. If it finds no errors, continue with\n`{train}`.")
        return status
    preparations = [(f"vjepa2-ac {_RECORD.format(path=path)}", "records the data in about half a minute")] * is_missing
    if not Path(model.path).exists() and (download := model.download):
        preparations.append((download[0], f"downloads the model ({download[1]})"))
    commands = [*preparations, *_recommend_next(draft, out, name)]
    cli.show("\nNext:", *(f"  {command}   # {purpose}" for command, purpose in commands))
    return 0


def _name_of(path: str) -> str:
    """Return a name for the config and the run: the last part of the path that is not a version number."""
    parts = [re.sub(r"\W+", "-", part).strip("-") for part in path.split("/") if not re.fullmatch(r"[\d.v]*", part)]
    return next((part for part in reversed(parts) if part), "own")


def _check(draft: Draft, out: Path) -> int:
    """Run `data check` on the new config and return the exit status. An error is printed; the config is not deleted."""
    from vjepa2_ac.cli.data import check_and_print

    cli.show(f"\n$ {shell_command('data', 'check', out)}")
    try:
        return check_and_print(draft.config)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def _recommend_next(draft: Draft, out: Path, name: str) -> list[tuple[str, str]]:
    """Return the next commands, from a trial to the full run, each with its purpose."""
    trial, steps = f"runs/{name}-trial", draft.config.training.steps
    short = (f"training.steps={_TRIAL_STEPS}", "validation.every=50", "checkpoint.every=50")
    return [
        (shell_command("train", out, "--check"), "checks everything that can fail before the first step"),
        (
            shell_command("train", out, f"run_dir={trial}", *short),
            f"trial of {_TRIAL_STEPS} steps: check the loss and the time per step",
        ),
        (shell_command("evaluate", trial), "compares the trial with the base model on held-out episodes"),
        (shell_command("train", out), f"full run of {steps:,} steps; run again to resume"),
    ]


def _config(options: argparse.Namespace) -> None:
    """Show the configs of the package, or all config keys.

    Choices:
      list    the configs that are included in the package
      text    a packaged config with its comments, as a template
      show    a config with all defaults
      schema  all keys with their types and ranges, as JSON schema
    """
    what, needs_config = options.what, options.what in {"show", "text"}
    if needs_config != (options.config is not None):
        problem = f"config {what} {options.config or 'without a file'}"
        raise InputError(where="command line", found=problem, needed=f"config {what}{' CONFIG' * needs_config}")
    if what == "schema":
        print(json.dumps(config_schema(), indent=2))
    elif what == "list":
        for name, about in packaged_configs().items():
            cli.show(f"builtin:{name:<14}{about}")
    elif what == "text":
        print(config_path(options.config).read_text(encoding="utf-8"), end="")
    else:
        print(config_as_yaml(load_config(options.config, options.overrides)), end="")


def _download(options: argparse.Namespace) -> None:
    """Download Meta's world model, or an encoder of V-JEPA 2 or 2.1.

    An interrupted download is resumed by the same command. The size of the file is checked.
    """
    from vjepa2_ac.model.model_files import OFFICIAL, PUBLISHED, download, find_published

    if options.list:
        for model in PUBLISHED:
            parameters = f"{model.encoder.parameters / 1e6:,.0f} M"
            encoder = f"{model.encoder.name} ({parameters}), {model.image_size} px, key {model.key}"
            cli.show(f"{model.name:<22}{model.model_kind}, {encoder}, {model.size}, {model.licence}")
        cli.show(
            "The licence is that of Meta's repository. Downloads are checked by size, because Meta publishes no hashes."
        )
        return
    model = find_published(options.name or OFFICIAL)
    path, url = options.to or Path("checkpoints") / model.file, options.url or model.url
    cli.show(
        f"{model.name}: {model.model_kind}, V-JEPA {model.family.removeprefix('v')}, {model.image_size} px,"
        f" {model.size}"
    )
    cli.show(f"Licence: {model.licence}. URL: {url}. The size of the file is checked.")
    with cli.make_reporter() as reporter:
        download(url, path, published=model, reporter=reporter)
    cli.show(f"Saved to {path}. In a config:  {model.config_key}: {to_config_value(path)}")


def _doctor(options: argparse.Namespace) -> int:
    """Estimate whether a run fits on this GPU, or describe this machine.

    With a config, the GPU memory is estimated part by part with a training step on fake tensors; no weights are loaded.
    On a machine without a GPU, the estimate is compared with 24 GB. Without a config, versions and hardware are
    printed. Exit status 0: the run fits. 1: it does not fit. 2: an input cannot be used.
    """
    if options.config is None:
        for line in _report_lines():
            cli.show(line)
        return 0

    config = load_config(options.config, options.overrides)

    import torch

    from vjepa2_ac.model.checkpoints import base_sizes
    from vjepa2_ac.training.cost import USUAL_GPU, estimate_memory, suggest_memory_savings

    sizes = base_sizes(config.model)
    gpu, available = None, USUAL_GPU
    if torch.cuda.is_available():
        device = torch.cuda.get_device_properties(torch.cuda.current_device())
        gpu, available = device.name, device.total_memory
    estimate = estimate_memory(config, sizes)
    needed = estimate.total(checkpointing=estimate.checkpointing)
    cli.show(
        _verdict(needed, available, gpu, suggest_memory_savings(config, sizes, available)), *_memory_lines(estimate)
    )
    cli.show(f"To check the rest: {shell_command('train', options.config, '--check', *options.overrides)}")
    return 0 if needed <= available else 1


def _memory_lines(estimate: MemoryEstimate) -> list[str]:
    """Return one line for each memory part of at least 0.0005 GB, then the peaks without and with checkpointing."""
    weights = estimate.parameters
    counts = f"encoder {weights.encoder:,}, predictor {weights.predictor:,}, trained {weights.trained:,}"
    lines = [f"Parameters: {counts}", "Estimated GPU memory, part by part (not all parts are needed at once):"]
    parts = {name: size for name, size in estimate.parts.items() if size >= _MIN_SHOWN_BYTES}
    lines += [f"  {name:<37}{size / 1e9:8.3f} GB" for name, size in parts.items()]
    for checkpointing, word in ((False, "without"), (True, "with")):
        chosen = "  <- this config" if checkpointing == estimate.checkpointing else ""
        total = estimate.total(checkpointing=checkpointing) / 1e9
        lines.append(f"  peak {word + ' checkpointing':<32}{total:8.3f} GB{chosen}")
    return [*lines, _ESTIMATE_NOTE]


def _verdict(needed: int, available: int, gpu: str | None, overrides: list[str] | None) -> str:
    """Return a sentence that states whether the run fits, and if it does not, which keys to change.

    Args:
        needed: Estimated peak memory in bytes.
        available: Memory of the GPU in bytes.
        gpu: Name of the GPU; None: this machine has no GPU.
        overrides: `key=value` changes with which the run fits; None: no such changes are known.
    """
    fits, size, capacity = needed <= available, f"{needed / 1e9:.1f} GB", f"{available / 1e9:.1f} GB"
    if gpu is None:
        comparison = f"a GPU with {capacity} is {'large enough' if fits else 'too small'}"
        text = f"No GPU: PyTorch finds none on this machine. The estimated peak is {size}; {comparison}."
    else:
        text = f"{'Fits' if fits else 'Does not fit'}: the estimated peak is {size}; {gpu} has {capacity}."
    if not fits:
        text += f" It fits with {', '.join(overrides)}." if overrides else " It needs a larger GPU or a smaller model."
    return text


def _report_lines() -> Iterator[str]:
    """Yield lines for a bug report: versions, CPU, GPU and environment variables, without secrets and paths.

    PyTorch is imported last, because the import may fail. The last line states what this machine can run.
    """
    root = Path(__file__).parents[3]
    commit = _output(f"git -C {shlex.quote(str(root))} describe --always --dirty") if (root / ".git").exists() else ""
    yield f"vjepa2-ac {__version__} {commit}".rstrip()
    yield f"Python {platform.python_version()}, {platform.platform()}"
    name = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text(encoding="utf-8"))
    yield f"CPU: {name[1] if name else platform.machine()}, {counted(os.cpu_count() or 1, 'core')}"
    libraries = [line for line in requires("vjepa2-ac") or [] if not re.search("extra == .(data|dev|docs)", line)]
    yield f"Libraries: {', '.join(dict.fromkeys(_with_version(line) for line in libraries))}"
    for key, value in sorted(os.environ.items()):
        if _REPORTED_VARIABLES.fullmatch(key):
            yield f"{key}={'(a path)' if '/' in value else value}"
    gpu = _output("nvidia-smi --query-gpu=name,memory.total,driver_version --format=csv,noheader")
    yield f"GPU: {gpu or 'none'}"

    import torch

    usable = counted(torch.cuda.device_count(), "usable GPU")
    yield f"PyTorch: CUDA {torch.version.cuda or 'not in this build'}, {usable}"
    if torch.cuda.is_available():
        yield "A GPU is usable. Whether a run fits is not measured here: `vjepa2-ac doctor CONFIG` estimates it."
    elif gpu:
        yield "The GPU is not usable: install a PyTorch build whose CUDA version the driver supports."
    else:
        yield "CPU only: the demo runs here; fine-tuning the released model needs a GPU."


def _output(command: str) -> str:
    """Return the standard output of a shell command; empty if the program is not installed."""
    return subprocess.getoutput(f"{command} 2>/dev/null")  # noqa: S605 - the command is a constant of this file


def _with_version(requirement: str) -> str:
    name = re.split(r"[^\w.-]", requirement)[0]
    try:
        return f"{name} {version(name)}"
    except PackageNotFoundError:
        return f"{name} (not installed)"


_DEMO_CLIP = "--episode B_seed5_00h39_000039 --start 5"  # a held-out clip in which the arm can move within the image


def _demo(_options: argparse.Namespace) -> int:
    """Run the whole workflow on a simulated arm, in about 5 minutes.

    The command records data, fine-tunes a tiny world model with LoRA, trains a decoder, makes a video of predicted
    frames and evaluates the run. It needs 4 to 7 minutes on 2 CPU cores and no download. All files are written to the
    folder demo. Run the same command again to resume.
    """
    from vjepa2_ac.simulation.domains import load_mujoco

    load_mujoco()
    Work.begin("")  # each command prints its own progress
    commands = [
        _RECORD.format(path=_SIMULATED),
        f"train {BUILTIN}demo",
        f"decoder {BUILTIN}demo",
        f"imagine demo/run --decoder demo/decoder --actions up,left,none --steps 4 {_DEMO_CLIP}",
        "evaluate demo/run --decoder demo/decoder",
    ]
    for words in commands[Path(_SIMULATED).exists() :]:
        print(f"$ vjepa2-ac {words}", flush=True)
        program = [sys.executable, "-P", "-m", "vjepa2_ac.cli", *shlex.split(words)]
        if status := subprocess.call(program):  # noqa: S603 - the command is a constant of this file
            return status
    return 0
