"""Fixtures and settings for all tests: checks of array shapes, reference data, a tiny run."""

import gc
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

import shape_checks

# Modules whose array shapes are checked at each call during tests. Checks of all packages would double the duration.
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
# On a busy machine a test may be slow.
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")

import gcs as gcs_server  # noqa: E402 - the hook comes first
from data_fixtures import droid, write_with_changed_record  # noqa: E402, F401 - fixtures for every folder
from paths import ROOT  # noqa: E402
from run_fixtures import (  # noqa: E402, F401
    base_folder,
    data_folder,
    default_signals,
    encoded_frames,
    fork_server,
    make_config,
    one_thread,
    popen,
    reporter,
    whole_run,
)
from simulated import clone, simulated  # noqa: E402, F401

# The longest files are started first, so that no process runs one of them alone at the end.
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
"""Tests of whole programs, which `make test-slow` runs."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort the longest files first, and mark slow tests."""
    ranks = {name: rank for rank, name in enumerate(LONGEST)}
    for item in items:
        name = os.path.relpath(item.path, ROOT / "tests")
        if name.startswith(SLOW) or "test_installed_environment_is_solved" in item.name:
            item.add_marker(pytest.mark.slow)
    items.sort(key=lambda item: ranks.get(item.path.name, len(ranks)))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Disable garbage collection during the imports, and exclude the imported objects from later collections."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of the larger reference data, next to the checkout; tests are skipped if it is missing."""
    folder = ROOT.parent / "shared"
    if not folder.is_dir():
        pytest.skip("the larger reference data is not beside this checkout")
    return folder


@pytest.fixture(autouse=True, scope="session")
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Use a temporary cache folder instead of the user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VJEPA2_AC_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(autouse=True, scope="session")
def _without_fsync() -> Iterator[None]:
    """Skip `fsync`, which protects from power loss only, so that tests do not wait for the disk."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture(autouse=True)
def _ordinary_scheduling() -> Iterator[None]:
    """Check that no test gives this process real-time priority (as SVT-AV1 does for root), which slows down others."""
    yield
    if hasattr(os, "sched_getscheduler"):
        assert os.sched_getscheduler(0) == os.SCHED_OTHER


@pytest.fixture(autouse=True, scope="session")
def _undrawn() -> Iterator[Callable[[pytest.MonkeyPatch], None]]:
    """Skip the drawing of figures, and limit strips to one column, unless a test uses the fixture `drawn`.

    Drawing takes half of an evaluation's time.
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
    """Draw figures completely."""
    _undrawn(monkeypatch)


@pytest.fixture(scope="session")
def _gcs() -> Iterator[gcs_server.Gcs]:
    with gcs_server.running() as running:
        yield running


@pytest.fixture
def gcs(_gcs: gcs_server.Gcs, monkeypatch: pytest.MonkeyPatch) -> gcs_server.Gcs:
    """An empty local Google Cloud Storage that serves gs://. Failed requests are retried at once, up to 5 times."""
    from vjepa2_ac.storage import retries

    _gcs.wipe()
    monkeypatch.setenv("STORAGE_EMULATOR_HOST", _gcs.url)
    monkeypatch.setattr(retries, "DEFAULT", retries.RetryPolicy(attempts=5, first_wait_s=0.001, timeout_s=60.0))
    return _gcs


@pytest.fixture
def traced(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Trace functions instead of compiling them, which would take a minute."""
    import jaxtyping
    import torch._dynamo
    from torch._dynamo.utils import counters

    from vjepa2_ac.model import compilation

    monkeypatch.setattr(compilation, "BACKEND", "eager")
    torch._dynamo.reset()
    counters.clear()
    jaxtyping.config.update("jaxtyping_disable", True)  # the shape checks must not be traced
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
    torch._dynamo.reset()


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with one_thread():
        yield
