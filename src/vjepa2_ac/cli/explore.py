"""The command explore: an interactive page that shows a model's predictions for commanded motions."""

from __future__ import annotations

import argparse
import contextlib
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from vjepa2_ac.cli import options as cli
from vjepa2_ac.cli.waiting import Work
from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import load_config
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.reporter import Reporter
from vjepa2_ac.runs.folder import is_run, read_run_config
from vjepa2_ac.storage.paths import BUILTIN

if TYPE_CHECKING:
    from vjepa2_ac.decoding.decoder import TrainedDecoder
    from vjepa2_ac.explore.views import Views

_DEMO_RUN, _BUILTIN_MODEL = "demo/run", f"{BUILTIN}sim-tiny"
_EPISODES = 8  # number of episodes to simulate for the package's model, which has no data set


def add_explore(commands: cli.Commands) -> None:
    """Add `explore` to a parser."""
    parser = cli.command(commands, "explore", _explore, "demo/run --against base")
    text = f"a run, or a value of model.base ({_DEMO_RUN} if it exists, otherwise {_BUILTIN_MODEL})"
    cli.add(parser, "subject RUN_OR_MODEL", text, cli.as_model, nargs="?")
    cli.add(
        parser, "overrides key=value", "such as planning.samples=200 (on a CPU the default search is short)", nargs="*"
    )
    cli.add(
        parser,
        "--against base|RUN|MODEL",
        "a model to compare with; repeatable (the base model of a run)",
        cli.as_model,
        action="append",
    )
    cli.add(
        parser,
        "--decoder FOLDER",
        "a decoder from `vjepa2-ac decoder` (the one next to the run, otherwise builtin:sim-tiny)",
        cli.as_model,
    )
    cli.add(
        parser, "--data CONFIG", "a config: show its data; required for a model, except builtin:sim-tiny", cli.as_local
    )
    cli.add(parser, "--split", "episodes to use (test)", choices=["test", "validation", "train"], default="test")
    cli.add_checkpoint(parser)
    cli.add(parser, "--port N", "port of the page; 0: any free port (8001)", cli.whole_number(0, 65535), default=8001)


def _explore(options: argparse.Namespace) -> int:
    """Open an interactive page that shows predictions for your motions.

    Press a key to command a motion, and compare the predicted frames with those of the base model and with the true
    frames. Choose a goal to see the energy and to plan (docs/explore.md). The command runs until Ctrl-C.
    """
    if "=" in (options.subject or "") and not Path(options.subject).exists():  # the subject is omitted: an override
        options.subject, options.overrides = None, [options.subject, *options.overrides]
    subject = options.subject or (_DEMO_RUN if is_run(_DEMO_RUN) else _BUILTIN_MODEL)
    config = read_run_config(Path(subject), options.overrides) if is_run(subject) else None
    cli.require_subject(subject, config, options.words)
    cli.report_relocated_paths(subject)
    decoder = _decoder(subject, options)
    with _data(subject, options) as data:
        with cli.reporter() as reporter:
            views = _views(subject, data, decoder, options, reporter)
            episodes = counted(len(views.explorer.episodes), "episode")
            about = f"{subject}, {episodes}; a step takes {views.step_seconds:.2f} s here"
        _serve(views, options, about)
    return 0


def _serve(views: Views, options: argparse.Namespace, about: str) -> None:
    from vjepa2_ac.explore.server import serve_page

    def ready(url: str) -> None:
        Work.begin("")
        cli.show(about, f"The page: {url}   (Ctrl-C ends it)")

    with contextlib.suppress(KeyboardInterrupt):
        serve_page(views, options.port, ready)


@contextmanager
def _data(subject: str, options: argparse.Namespace) -> Iterator[Config | None]:
    """Yield the config of the data to explore.

    It is the config of `--data`; or None for the data of a run; or, for the package's model, a config of episodes that
    are simulated into a temporary folder.

    Raises:
        InputError: Another model is given without `--data`.
    """
    if options.data is not None:
        yield cli.read_config(options.data)
    elif is_run(subject):
        yield None
    elif subject == _BUILTIN_MODEL:
        from vjepa2_ac.simulation.record import RecordingSpec, record_dataset

        with tempfile.TemporaryDirectory() as folder:
            Work.begin("recording episodes of the simulated arm")
            path = Path(folder) / "data"
            record_dataset(path, RecordingSpec("A", seed=5), episodes=_EPISODES)
            shares = ["data.validation_share=0.1", "data.test_share=0.8"]
            yield load_config(f"{BUILTIN}demo", [f"data.path={path}", f"model.base={subject}", *shares])
    else:
        needed = "--data CONFIG, which names held-out episodes"
        raise InputError(where=f"explore {subject}", found="a model, which has no data of its own", needed=needed)


def _decoder(subject: str, options: argparse.Namespace) -> TrainedDecoder:
    """Load the decoder of `--decoder`, or else the one in the run's parent folder, or else the package's decoder."""
    from vjepa2_ac.decoding.decoder import CARD, load_decoder

    folder = Path(subject).parent / "decoder"
    return load_decoder(options.decoder or (folder if (folder / CARD).is_file() else _BUILTIN_MODEL))


def _views(
    subject: str, data: Config | None, decoder: TrainedDecoder, options: argparse.Namespace, reporter: Reporter
) -> Views:
    from vjepa2_ac.evaluation.evaluate_run import load_models
    from vjepa2_ac.evaluation.request import require_single_process, resolve_config
    from vjepa2_ac.explore.explorer import open_explorer
    from vjepa2_ac.explore.views import Views
    from vjepa2_ac.simulation.counterfactual import SimulatedFutures

    require_single_process()
    request = cli.evaluation_options(options, data=data, out=Path())
    config = resolve_config(subject, request)

    load = partial(load_models, subject, config, request)
    explorer = open_explorer(config, decoder, options.split, load, SimulatedFutures.of, reporter)
    return Views.create(subject, explorer, config)
