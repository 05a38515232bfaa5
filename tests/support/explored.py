"""Explorers of the tiny run: on its own data, and on simulated episodes."""

from pathlib import Path

import pytest

from run_fixtures import tiny_config
from vjepa2_ac.config.planning import CemConfig, PlanningConfig
from vjepa2_ac.decoding.decoder_folder import load_decoder
from vjepa2_ac.evaluation.evaluate_run import load_models
from vjepa2_ac.evaluation.request import EvaluationOptions, settle
from vjepa2_ac.explore.explorer import open_explorer
from vjepa2_ac.explore.views import Views
from vjepa2_ac.simulation.counterfactual import SimulatedFutures

QUICK = PlanningConfig(samples=12, iterations=2, cem=CemConfig(elites=4))


def views_of(subject: Path, decoder: Path, data: Path, folder: Path, base: Path) -> Views:
    """Return the views of a run on data, with a search that is over at once."""
    config = tiny_config(folder / "none", data, base, data__test_share=0.5, data__stride=2)
    asked = EvaluationOptions(data=config, out=folder)
    config = settle(str(subject), asked)
    explorer = open_explorer(
        config,
        load_decoder(decoder),
        "test",
        lambda dataset, decoder: load_models(str(subject), config, asked, dataset, decoder),
        SimulatedFutures.of,
    )
    return Views.of("the run", explorer, config.model_copy(update={"planning": QUICK}))


@pytest.fixture
def recorded(whole_run: Path, whole_decoder: Path, data_folder: Path, base_folder: Path, tmp_path: Path) -> Views:
    """Of data of which only the recording is known."""
    return views_of(whole_run, whole_decoder, data_folder, tmp_path, base_folder)


@pytest.fixture
def live(whole_run: Path, whole_decoder: Path, simulated: Path, base_folder: Path, tmp_path: Path) -> Views:
    """Of data whose world can be simulated again."""
    return views_of(whole_run, whole_decoder, simulated, tmp_path, base_folder)
