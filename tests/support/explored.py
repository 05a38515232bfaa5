"""Explorers of the tiny run on its own data and on simulated episodes."""

from pathlib import Path

import pytest

from run_fixtures import tiny_config
from vjepa2_ac.config import Config
from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.decoding.decoder import TrainedDecoder, load_decoder
from vjepa2_ac.evaluation.evaluate_run import LoadedModels, load_models
from vjepa2_ac.evaluation.request import EvaluationOptions, resolve_config
from vjepa2_ac.explore.explorer import Explorer, open_explorer
from vjepa2_ac.explore.views import Views
from vjepa2_ac.simulation.counterfactual import SimulatedFutures

QUICK = PlanningConfig(samples=12, iterations=2, planner={"name": "cem", "options": {"elites": 4}})


def explorer_of(subject: Path, decoder: Path, options: EvaluationOptions) -> tuple[Explorer, Config]:
    """Return an explorer as the command opens it, and its config."""
    config = resolve_config(str(subject), options)

    def load(dataset: Dataset, decoder: TrainedDecoder) -> LoadedModels:
        return load_models(str(subject), config, options, dataset, decoder)

    return open_explorer(config, load_decoder(decoder), "test", load, SimulatedFutures.of), config


def views_of(subject: Path, decoder: Path, data: Path, folder: Path, base: Path) -> Views:
    """Return the views of a run on data, with a small search."""
    config = tiny_config(folder / "none", data, base, data__test_share=0.5, data__stride=2)
    explorer, config = explorer_of(subject, decoder, EvaluationOptions(data=config, out=folder, checkpoint="newest"))
    return Views.create("the run", explorer, config.model_copy(update={"planning": QUICK}))


@pytest.fixture(scope="session")
def recorded(
    whole_run: Path, whole_decoder: Path, data_folder: Path, base_folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> Views:
    """Views of data that cannot be simulated."""
    return views_of(whole_run, whole_decoder, data_folder, tmp_path_factory.mktemp("recorded"), base_folder)


@pytest.fixture(scope="session")
def live(
    whole_run: Path, whole_decoder: Path, simulated: Path, base_folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> Views:
    """Views of simulated data."""
    return views_of(whole_run, whole_decoder, simulated, tmp_path_factory.mktemp("live"), base_folder)
