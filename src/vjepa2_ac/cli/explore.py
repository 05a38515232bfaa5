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
    parser = cli.add_command(commands, "explore", _explore, "demo/run --against base")
    text = f"a run, or a value of model.base ({_DEMO_RUN} if it exists, otherwise {_BUILTIN_MODEL})"
    cli.add(parser, "subject RUN_OR_MODEL", text, cli.as_model, nargs="?")
    cli.add_overrides(parser, "such as planning.samples=200 (on a CPU the default search is short)")
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
        "a decoder from `vjepa2-ac decoder` (`decoder` next to the run, otherwise builtin:sim-tiny)",
        cli.as_model,
    )
    cli.add(
        parser,
        "--data CONFIG",
        "a config, whose data are shown; required for a model, except builtin:sim-tiny",
        cli.as_local,
    )
    cli.add(parser, "--split", "episodes to use (test)", choices=["test", "validation", "train"], default="test")
    cli.add_checkpoint(parser)
    cli.add(parser, "--port N", "port of the page; 0: any free port (8001)", cli.whole_number(0, 65535), default=8001)


def _explore(options: argparse.Namespace) -> int:
    """Open an interactive page that shows predictions for your motions.

    Press a key to command a motion, and compare the predicted frames with those of the base model and with the true
    frames. Choose a goal to see the energy and to plan (docs/explore.md). The command runs until Ctrl-C.
    """
    if (
        "=" in (options.subject or "") and not Path(options.subject).exists()
    ):  # an override, because the subject is omitted
        options.subject, options.overrides = None, [options.subject, *options.overrides]
    subject = options.subject or (_DEMO_RUN if is_run(_DEMO_RUN) else _BUILTIN_MODEL)
    config = read_run_config(Path(subject), options.overrides) if is_run(subject) else None
    cli.require_subject(subject, config, options.words)
    cli.report_remote_urls(subject)
    decoder = _load_decoder(subject, options)
    with _open_data(subject, options) as data:
        with cli.make_reporter() as reporter:
            views = _open_views(subject, data, decoder, options, reporter)
            episodes = counted(len(views.explorer.episodes), "episode")
            about = f"{subject}, {episodes}; a model step takes {views.step_seconds:.2f} s on this machine"
        _serve(views, options, about)
    return 0


def _serve(views: Views, options: argparse.Namespace, about: str) -> None:
    from vjepa2_ac.explore.server import serve_page

    def show_url(url: str) -> None:
        Work.begin("")
        cli.show(about, f"The page: {url}   (Ctrl-C ends it)")

    with contextlib.suppress(KeyboardInterrupt):
        serve_page(views, options.port, show_url)


@contextmanager
def _open_data(subject: str, options: argparse.Namespace) -> Iterator[Config | None]:
    """Yield the config of the data to explore; None: the data of the run.

    Without `--data`, episodes for the package's model are simulated and written to a temporary folder.

    Raises:
        InputError: `--data` is missing for a model that is not part of the package.
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
            splits = ["data.validation_share=0.1", "data.test_share=0.8"]
            yield load_config(f"{BUILTIN}demo", [f"data.path={path}", f"model.base={subject}", *splits])
    else:
        needed = "--data CONFIG, a config with held-out episodes"
        raise InputError(where=f"explore {subject}", found="a model, which has no data of its own", needed=needed)


def _load_decoder(subject: str, options: argparse.Namespace) -> TrainedDecoder:
    """Load the decoder: that of `--decoder`, of the run's parent folder, or of the package, whichever exists first."""
    from vjepa2_ac.decoding.decoder import CARD, load_decoder

    folder = Path(subject).parent / "decoder"
    return load_decoder(options.decoder or (folder if (folder / CARD).is_file() else _BUILTIN_MODEL))


def _open_views(
    subject: str, data: Config | None, decoder: TrainedDecoder, options: argparse.Namespace, reporter: Reporter
) -> Views:
    from vjepa2_ac.evaluation.evaluate_run import load_models
    from vjepa2_ac.evaluation.request import require_single_process, resolve_config
    from vjepa2_ac.explore.explorer import open_explorer
    from vjepa2_ac.explore.views import Views
    from vjepa2_ac.simulation.counterfactual import SimulatedFutures

    require_single_process()
    request = cli.make_evaluation_options(options, data=data, out=Path())
    config = resolve_config(subject, request)

    load = partial(load_models, subject, config, request)
    explorer = open_explorer(config, decoder, options.split, load, SimulatedFutures.of, reporter)
    return Views.create(subject, explorer, config)
