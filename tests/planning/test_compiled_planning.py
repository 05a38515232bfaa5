"""Plans with compiled blocks equal the plain ones, and a second decision compiles nothing."""

import numpy as np
import pytest
from torch._dynamo.utils import counters

from decisions import STATE
from tiny_models import tiny_model
from tracing import tracing
from vjepa2_ac.config.planning import EnergyConfig, PlanningConfig
from vjepa2_ac.config.section import Component
from vjepa2_ac.errors import InputError
from vjepa2_ac.model import compilation
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.controller import Controller

pytestmark = tracing

PLAIN = PlanningConfig(
    samples=11,
    iterations=2,
    horizon=3,
    planner={"name": "cem", "options": {"elites": 4}},
    energy=EnergyConfig(samples_at_once=4),
)
COMPILED = PLAIN.model_copy(update={"compile": "blocks"})


@pytest.fixture(autouse=True)
def _with_a_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compilation, "missing_for_compilation", lambda _: None)


def decisions(model: WorldModel, config: PlanningConfig, count: int = 2) -> list[np.ndarray]:
    images = np.random.default_rng(0).integers(0, 256, (count + 1, 48, 48, 3), dtype=np.uint8)
    run = Controller(model, config)
    run.reset(images[0])
    return [run.act(image, STATE) for image in images[1:]]


@pytest.mark.usefixtures("traced")
@pytest.mark.parametrize("adapted", [False, True])
@pytest.mark.parametrize("planner", ["cem", "gradient"])
def test_compiled_plans_are_the_plain_ones(adapted: bool, planner: str) -> None:
    model, planned = tiny_model(adapted=adapted), {"planner": Component(planner)}
    expected = decisions(model, PLAIN.model_copy(update=planned))
    assert not counters["stats"]
    found = decisions(model, COMPILED.model_copy(update=planned))
    assert counters["stats"]["unique_graphs"]
    assert not counters["graph_break"]
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_what_cannot_be_compiled_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    model = tiny_model()
    monkeypatch.setattr(compilation, "missing_for_compilation", lambda kind: f"no compiler for {kind}")
    with pytest.raises(InputError, match=r"no compiler for cpu.*planning.compile=off"):
        Controller(tiny_model(), COMPILED)
    Controller(model, PLAIN)
