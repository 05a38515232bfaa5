"""Marks that ignore warnings which PyTorch raises and hides while it traces; in these tests warnings are errors."""

import pytest

tracing = [
    pytest.mark.filterwarnings(f"ignore:{warning}")
    for warning in (
        "The .grad attribute of a Tensor that is not a leaf",  # Dynamo reads .grad of traced tensors
        "<class 'torch.autograd.function.Function'> should not be instantiated",  # Dynamo does so for custom gradients
    )
]
