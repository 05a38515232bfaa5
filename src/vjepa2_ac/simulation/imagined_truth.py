"""What really happens under actions that a model has imagined, where the data were simulated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.imagined import Film
from vjepa2_ac.simulation.counterfactual import resimulate
from vjepa2_ac.simulation.recording.simulation_file import SIMULATION_FILE


def with_what_happens(film: Film) -> Film:
    """Return the film with the truth of every sequence of actions, or with a note that says why there is none."""
    config = film.dataset.config
    if not (Path(config.path) / SIMULATION_FILE).is_file():
        return film
    camera = config.cameras[0]
    try:
        recording = film.dataset.source.read(film.episode, camera)
        arm = resimulate(config.path, recording, film.imagination.start, camera)
    except InputError as error:
        note = f"What really happens under other actions is not known: {error}"
        return replace(film, imagination=replace(film.imagination, notes=(*film.imagination.notes, note)))
    return film.with_outcomes(lambda actions: arm.under(actions, config.model_stride).frames)
