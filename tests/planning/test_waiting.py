"""Planning does not synchronize with the device before the energies are computed."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from tiny_models import actions, cost, tiny_model

ASKING = {
    "_local_scalar_dense", "_to_copy", "copy_", "equal", "index", "index_put_", "is_nonzero", "lift_fresh",
    "masked_select", "nonzero", "unique_dim", "_unique2",
}  # fmt: skip
"""What fetches numbers, has a result whose size depends on them, or brings a list of them to the device."""


class Recorder(TorchDispatchMode):
    """Records the names of all operations."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: set[str] = set()

    def __torch_dispatch__(self, operation: Any, types: Any, given: Any = (), named: Any = None) -> Any:
        self.seen.add(operation._overloadpacket.__name__)
        return operation(*given, **(named or {}))


def operations_of(work: Callable[[], object]) -> set[str]:
    """Return what runs in something that was done once before."""
    work()
    with Recorder() as recorder:
        work()
    return recorder.seen


@torch.no_grad()
@pytest.mark.parametrize(("steps", "kind"), [("last", "l1"), ("sum", "cosine")])
def test_energies_are_computed_without_asking_the_device(steps: str, kind: str) -> None:
    measure, tried = cost(tiny_model(), samples_at_once=4, steps=steps, distance=kind), actions(10, 3)
    reported: list[tuple[int, int]] = []
    measure.progress = lambda *progress: reported.append(progress)
    seen = operations_of(lambda: measure(tried))
    assert reported == 2 * [(4, 10), (8, 10), (10, 10)]
    assert "addmm" in seen
    assert not seen & ASKING
