"""What every test can use: checked shapes, the shared reference data, tiny settings."""

import gc
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

import shape_checks

# Where arrays change shape, each call with arrays is checked while testing. In the other packages it would double the
# suite's time for what mypy proves already.
CHECKED = [
    "vjepa2_ac.spaces",
    "vjepa2_ac.media.images",
    "vjepa2_ac.media.image_similarity",
    "vjepa2_ac.media.video",
    "vjepa2_ac.data.clips",
    "vjepa2_ac.data.transforms",
    "vjepa2_ac.planning",
    "vjepa2_ac.evaluation.action_use",
    "vjepa2_ac.simulation.motion",
]
shape_checks.install(CHECKED, "beartype.beartype")
# A busy machine is slow, and that is no fault of what is tested.
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")

import gcs as gcs_server  # noqa: E402 - the hook comes first
from data_fixtures import droid, spoiled  # noqa: E402, F401 - fixtures for every folder
from paths import ROOT  # noqa: E402
from run_fixtures import (  # noqa: E402, F401
    base_folder,
    data_folder,
    default_signals,
    encoded_frames,
    make_config,
    nursery,
    one_thread,
    popen,
    reporter,
    whole_run,
)
from simulated import clone, simulated  # noqa: E402, F401

# Begun first, each by a process of its own: whoever comes to them last would work alone in the end.
LONGEST = (
    "test_notebook.py", "test_quickstart.py", "test_step.py", "test_benchmark.py", "test_counterfactual.py",
    "test_page.py", "test_memory.py", "test_end_to_end.py", "test_loop.py", "test_evaluate_run.py", "test_export.py",
    "test_real_client.py", "test_encoder_file.py", "test_pairs_of_options.py", "test_trained_planning.py",
    "test_docs_troubleshooting.py", "test_sweeps.py", "test_signals.py", "test_fake_gpu.py", "test_site.py",
    "test_wheel.py",
)  # fmt: skip


SLOW = (
    "benchmarks/", "distributed/test_nothing_hangs", "distributed/test_shared_work", "explore/test_command",
    "explore/test_page_in_browser", "judge/", "serving/test_real_client",
    "test_extending", "test_notebook", "test_quickstart", "test_site", "test_spot", "test_sweeps", "test_wheel",
    "training/test_soak",
)  # fmt: skip
"""Whole programs: `make test-slow`."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files first that take longest, and mark what is slow."""
    places = {name: place for place, name in enumerate(LONGEST)}
    for item in items:
        name = os.path.relpath(item.path, ROOT / "tests")
        if name.startswith(SLOW) or "test_a_real_world" in item.name:
            item.add_marker(pytest.mark.slow)
    items.sort(key=lambda item: places.get(item.path.name, len(places)))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Look for no garbage while all is imported, and never again in what is there then: half a second each time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.fixture(scope="session")
def shared() -> Path:
    """The larger reference data, which stands beside the project's own checkout only."""
    folder = ROOT.parent / "shared"
    if not folder.is_dir():
        pytest.skip("the larger reference data is not beside this checkout")
    return folder


@pytest.fixture(autouse=True, scope="session")
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Nothing of a test stays in the user's cache folder, and nothing in there helps a test."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VJEPA2_AC_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(autouse=True, scope="session")
def _without_fsync() -> Iterator[None]:
    """No test waits for a disk: what `fsync` protects from, the loss of power, happens in none."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture(autouse=True)
def _ordinary_scheduling() -> Iterator[None]:
    """No test leaves this process before all others (as SVT-AV1 does, as root): what it starts would starve them."""
    yield
    if hasattr(os, "sched_getscheduler"):
        assert os.sched_getscheduler(0) == os.SCHED_OTHER


@pytest.fixture(autouse=True, scope="session")
def _undrawn() -> Iterator[Callable[[pytest.MonkeyPatch], None]]:
    """Figures are composed, strips with one column, and stay empty where `drawn` is not used.

    Drawing is half of an evaluation's time.
    """
    from matplotlib.figure import Figure

    from vjepa2_ac.media import figure

    draw, columns = Figure.draw, figure._MAX_COLUMNS

    def draw_all(patch: pytest.MonkeyPatch) -> None:
        patch.setattr(Figure, "draw", draw)
        patch.setattr(figure, "_MAX_COLUMNS", columns)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "draw", lambda *_: None)
        patch.setattr(figure, "_MAX_COLUMNS", 1)
        yield draw_all


@pytest.fixture
def drawn(_undrawn: Callable[[pytest.MonkeyPatch], None], monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures have content."""
    _undrawn(monkeypatch)


@pytest.fixture(scope="session")
def _gcs() -> Iterator[gcs_server.Gcs]:
    with gcs_server.running() as running:
        yield running


@pytest.fixture
def gcs(_gcs: gcs_server.Gcs, monkeypatch: pytest.MonkeyPatch) -> gcs_server.Gcs:
    """A local Google Cloud Storage, empty; gs:// means it. What fails is tried again at once, 5 times in all."""
    from vjepa2_ac.storage import retries

    _gcs.wipe()
    monkeypatch.setenv("STORAGE_EMULATOR_HOST", _gcs.url)
    monkeypatch.setattr(retries, "DEFAULT", retries.RetryPolicy(attempts=5, first_wait_s=0.001, timeout_s=60.0))
    return _gcs


@pytest.fixture
def traced(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What would be compiled is traced only, and runs as it is: a compiler would take a minute."""
    import jaxtyping
    import torch._dynamo
    from torch._dynamo.utils import counters

    from vjepa2_ac.model import compilation

    monkeypatch.setattr(compilation, "BACKEND", "eager")
    torch._dynamo.reset()
    counters.clear()
    jaxtyping.config.update("jaxtyping_disable", True)  # checks of shapes are not what is compiled
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
    torch._dynamo.reset()


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with one_thread():
        yield
