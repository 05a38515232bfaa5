"""Warnings that PyTorch raises while it traces, and keeps from being shown: here a warning is an error."""

import pytest

tracing = [
    pytest.mark.filterwarnings(f"ignore:{warning}")
    for warning in (
        "The .grad attribute of a Tensor that is not a leaf",  # it looks at .grad of what it traces
        "<class 'torch.autograd.function.Function'> should not be instantiated",  # it is, for its own gradients
    )
]
