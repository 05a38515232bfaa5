"""The command-line program: parse the arguments, call one function, print its result."""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from vjepa2_ac import __version__, output
from vjepa2_ac.cli.data import add_data
from vjepa2_ac.cli.doctor import add_doctor
from vjepa2_ac.cli.encode import add_encode
from vjepa2_ac.cli.ending import tidy_end
from vjepa2_ac.cli.evaluate import add_checkpoint, add_evaluate
from vjepa2_ac.cli.options import Commands, Handler, Parser, as_local, as_path, command, parsed, say_places_elsewhere
from vjepa2_ac.cli.plan import add_plan
from vjepa2_ac.cli.simulate import add_simulate
from vjepa2_ac.errors import InputError, in_words, is_out_of_memory, printable


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return its status.

    0 done, 1 a check failed, 2 an input cannot be used, 75 a training run was asked to stop and can be resumed,
    130 interrupted. A reader that closes early, as `head` does, changes nothing; a full disk for the output is an
    error, except for progress messages.
    """
    with output.own_streams() as streams, _our_warnings(), tidy_end():
        status = _run(arguments)
        if lost := streams.what_was_lost():
            _complain(lost)
            return status or 2
        return status


def _run(arguments: Sequence[str] | None) -> int:
    options = parsed(_parser(), arguments)
    handler: Handler = options.handler
    try:
        _require_working_directory()
        return handler(options) or 0
    except (InputError, OSError, MemoryError) as error:  # a full disk, a path that is no path: the message names it
        _complain(in_words(error))
        return 2
    except ModuleNotFoundError as error:  # one that every installation has: those of extras are errors of their own
        library = (error.name or "vjepa2_ac").partition(".")[0]
        if library == "vjepa2_ac":
            raise
        _complain(f"{library}: it is not installed. Run pip install -c constraints.txt -e .")
        return 2
    except RuntimeError as error:
        if not is_out_of_memory(error):
            raise
        _complain(in_words(error))
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def _require_working_directory() -> None:
    """Check that the working directory exists: relative paths and libraries of PyTorch need it."""
    try:
        Path.cwd()
    except OSError:
        raise InputError(
            where="working directory",
            found="it is gone: it was deleted, or its disk went away",
            fix="Change to a folder that is there, with `cd`",
        ) from None


def _complain(error: str) -> None:
    print(printable(f"error: {error}"), file=sys.stderr)


class _Warning(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        return printable(f"warning: {super().format(record)}")


@contextlib.contextmanager
def _our_warnings() -> Iterator[None]:
    """Print warnings of this program, as long as the context lasts; those of libraries are left to them."""
    ours, handler = logging.getLogger("vjepa2_ac"), logging.StreamHandler()
    handler.setFormatter(_Warning())
    ours.addHandler(handler)
    for library in ("bitsandbytes", "torchao", "torch.utils._pytree"):  # kernels for other devices; torchao's own past
        logging.getLogger(library).setLevel(logging.ERROR)
    try:
        yield
    finally:
        ours.removeHandler(handler)


def _parser() -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = Parser(
        prog="vjepa2-ac", description="Fine-tune V-JEPA 2-AC with LoRA, and know whether it helped."
    )
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    _add_train(commands)
    add_evaluate(commands)
    add_data(commands)
    add_encode(commands)
    add_doctor(commands)
    add_plan(commands)
    _add_export(commands)
    _add_config(commands)
    _add_download(commands)
    add_simulate(commands)
    return parser


def _add_train(commands: Commands[argparse.ArgumentParser]) -> None:
    parser = command(
        commands,
        "train",
        _train,
        "Train an adapter (or the whole predictor) as a config says. SIGTERM, SIGINT, SIGUSR1, SIGHUP: finish the step,"
        " write a checkpoint, end with status 75; the same command goes on from there. A second signal: end at once.",
    )
    parser.add_argument(
        "config", metavar="CONFIG", type=as_local, help="a YAML config, or with --resume the folder of a run"
    )
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="such as training.learning_rate=3e-4")
    parser.add_argument("--resume", action="store_true", help="go on with the run in the folder CONFIG")
    parser.add_argument(
        "--check", action="store_true", help="do everything that can fail and stop before the first step"
    )
    parser.add_argument(
        "--allow-config-change", action="store_true", help="go on with the run in run_dir though its config is another"
    )


def _train(options: argparse.Namespace) -> int:
    from vjepa2_ac.config.loading import load_config
    from vjepa2_ac.console.progress import ConsoleReporter, console
    from vjepa2_ac.distributed.preemption import EXIT_STATUS, StoppedError
    from vjepa2_ac.runs.folder import read_run_config
    from vjepa2_ac.training.loop import train

    path = Path(options.config)
    if options.resume and options.overrides:
        raise InputError(
            where="command line", found="--resume with overrides", needed="the run's own config, unchanged"
        )
    if path.is_dir() and not options.resume:
        raise InputError(
            where=options.config, found="a folder", needed="a config file", fix="To go on with a run, add --resume"
        )
    if options.resume:
        say_places_elsewhere(options.config)
    config = read_run_config(path) if options.resume else load_config(path, options.overrides)
    output.never_wait()
    reporter = ConsoleReporter()
    speaks = os.environ.get("RANK", "0") == "0"  # one of several processes
    try:
        folder = train(config, reporter, check_only=options.check, allow_config_change=options.allow_config_change)
    except StoppedError as stopped:
        if speaks:
            print(printable(str(stopped)), file=sys.stderr)
        return EXIT_STATUS
    finally:
        reporter.close()
    if speaks and not options.check:
        console.print(f"The run is in {folder}; see how good it is: vjepa2-ac evaluate {folder}")
    return 0


def _add_export(commands: Commands[argparse.ArgumentParser]) -> None:
    parser = command(
        commands, "export", _export, "Write a run's model, adapter merged in, or its adapter, for others to use."
    )
    parser.add_argument("run", metavar="RUN", type=as_path, help="the folder of a run")
    parser.add_argument(
        "folder", metavar="FOLDER", type=as_path, help="where to, new or empty; official: or a .pt file"
    )
    parser.add_argument(
        "--to",
        choices=["merged", "official", "hub"],
        default="merged",
        help="merged: a folder that `model.base` takes. official: one .pt by Meta's names, for the official code."
        " hub: the adapter in PEFT's format with a model card, ready to upload",
    )
    add_checkpoint(parser)


def _export(options: argparse.Namespace) -> None:
    from vjepa2_ac.console.progress import console
    from vjepa2_ac.export.export import export_run

    written = export_run(options.run, options.folder, options.to, options.checkpoint)
    what = {"merged": "merged model", "official": "official checkpoint", "hub": "adapter with its model card"}
    console.print(f"The {what[options.to]} of checkpoint {written.checkpoint} is in {written.path}")
    if options.to == "hub":
        console.print("The card names base and data by their paths on this machine: read it before you upload it.")


def _add_config(commands: Commands[argparse.ArgumentParser]) -> None:
    parser = command(commands, "config", _config, "Print the JSON schema of configs, or one config with every default.")
    parser.add_argument("what", choices=["schema", "show"])
    parser.add_argument("config", metavar="CONFIG", type=as_local, nargs="?", help="for show: a YAML config")
    parser.add_argument("overrides", nargs="*", metavar="key=value")


def _config(options: argparse.Namespace) -> None:
    from vjepa2_ac.config.loading import config_as_yaml, config_schema, load_config

    if options.what == "schema" and options.config is not None:
        raise InputError(where="command line", found=f"config schema {options.config}", needed="config schema")
    if options.what == "schema":
        print(json.dumps(config_schema(), indent=2))
    elif options.config is None:
        raise InputError(
            where="command line", found="config show without a file", needed="vjepa2-ac config show CONFIG"
        )
    else:
        print(config_as_yaml(load_config(options.config, options.overrides)), end="")


def _add_download(commands: Commands[argparse.ArgumentParser]) -> None:
    parser = command(
        commands, "download", _download, "Fetch the official checkpoint (11.7 GB); goes on where it stopped."
    )
    parser.add_argument("path", metavar="PATH", type=as_path, nargs="?", default=Path("checkpoints/vjepa2-ac-vitg.pt"))
    parser.add_argument("--url", default=None, help="another address than Meta's")


def _download(options: argparse.Namespace) -> None:
    from vjepa2_ac.console.progress import DownloadProgress, console
    from vjepa2_ac.model.checkpoints.download import OFFICIAL_URL, download

    progress = DownloadProgress(options.path.name)
    download(options.url or OFFICIAL_URL, options.path, progress=progress)
    console.print(f"The checkpoint is in {options.path}")
