"""The command-line program: parses the arguments and runs one command."""

from __future__ import annotations

import atexit
import contextlib
import gc
import logging
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from vjepa2_ac import __version__, process
from vjepa2_ac.cli import closed_loop, data, evaluate, explore, plan, policies, setup, train
from vjepa2_ac.cli.options import Commands, Handler, Parser, add_commands, parse_arguments
from vjepa2_ac.cli.waiting import watch_silence
from vjepa2_ac.errors import (
    InputError,
    UserError,
    describe_error,
    extra_for_library,
    is_out_of_memory,
    pip_install,
    printable,
)
from vjepa2_ac.process import EXIT_STATUS, StoppedError, exit_on_signals, is_first_process


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status.

    0: done. 1: a check failed. 2: an input cannot be used. 75: a training run was stopped by a signal and can be
    resumed. 130: interrupted. If the reader of the output closes early, as `head` does, the status does not change. If
    the output could not be written, for example to a full disk, an error is printed at the end.
    """
    # OpenMP reads this spin count when PyTorch is imported. With it an idle thread sleeps after about 20 microseconds
    # instead of milliseconds. A spinning thread occupies its core: with the default, two trainings on the same cores
    # were ten times slower (commit 0d046757).
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    atexit.register(gc.freeze)  # skips the garbage collection of PyTorch's 500,000 objects when the program exits
    with process.guard_output() as get_output_error, _print_package_warnings(), exit_on_signals():
        status = _run(arguments)
        if problem := get_output_error():
            _print_error(f"standard output: cannot be written ({problem}): some output is missing")
            return status or 2
        return status


def _run(arguments: Sequence[str] | None) -> int:
    words = sys.argv[1:] if arguments is None else arguments
    try:
        options = parse_arguments(_make_parser(), words)
        options.words = words
        handler: Handler = options.handler
        _require_working_directory()
        if options.plugin:
            from vjepa2_ac.config.loading import register_plugins

            register_plugins(options.plugin)
        with watch_silence():
            return handler(options) or 0
    except ModuleNotFoundError as error:  # libraries of extras for which no UserError was raised
        library = (error.name or "vjepa2_ac").partition(".")[0]
        if library == "vjepa2_ac":
            raise
        _print_error(f"{library}: it is not installed. Run {pip_install(extra_for_library(library))}")
        return 2
    except (UserError, OSError, MemoryError, RuntimeError) as error:  # OSError: for example a full disk
        if isinstance(error, RuntimeError) and not is_out_of_memory(error):
            raise
        if not getattr(error, "is_reported", False):
            _print_error(describe_error(error))
        return 2
    except StoppedError as stopped:
        if is_first_process():
            print(printable(str(stopped)), file=sys.stderr)
        return EXIT_STATUS
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def _require_working_directory() -> None:
    """Check that the working directory exists. Relative paths need it, and so does the import of PyTorch's libraries.

    Raises:
        InputError: The working directory was deleted or unmounted.
    """
    try:
        Path.cwd()
    except OSError:
        problem, fix = "the folder does not exist any more", "Change to an existing folder with `cd`"
        raise InputError(where="working directory", found=problem, fix=fix) from None


def _print_error(error: str) -> None:
    print(printable(f"error: {error}"), file=sys.stderr)


class _WarningFormatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        return printable(f"warning: {super().format(record)}")


@contextlib.contextmanager
def _print_package_warnings() -> Iterator[None]:
    """Print the log warnings of this package to stderr within the context. Loggers of libraries are not changed."""
    logger, handler = logging.getLogger("vjepa2_ac"), logging.StreamHandler()
    handler.setFormatter(_WarningFormatter())
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def _make_parser() -> Parser:
    parser = Parser(prog="vjepa2-ac", description="Fine-tune V-JEPA 2-AC with LoRA, and measure whether it improved.")
    parser.add_argument("--version", action="version", version=__version__, help="show the version")
    parser.epilog = "`vjepa2-ac COMMAND --help` begins with an example."
    groups: dict[str, list[Callable[[Commands], None]]] = {
        "start": [setup.add_demo, setup.add_init, setup.add_download, setup.add_doctor, setup.add_config_command],
        "inspect": [data.add_data, evaluate.add_imagine, explore.add_explore],
        "train": [train.add_encode, train.add_train, train.add_decoder_command],
        "evaluate": [
            evaluate.add_evaluate,
            evaluate.add_compare,
            closed_loop.add_simulate,
            policies.add_score,
            policies.add_monitor,
        ],
        "use": [plan.add_plan, plan.add_goals, policies.add_prior, closed_loop.add_serve, train.add_export],
    }
    add_commands(parser, groups)
    return parser
