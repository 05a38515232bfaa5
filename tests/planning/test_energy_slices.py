"""An energy slice is the energy of the plan with two components of its first action changed."""

import numpy as np
import pytest
import torch
from torch import Tensor

from vjepa2_ac.config.planning import LimitsConfig, PlanningConfig
from vjepa2_ac.planning.energy import energy_slices
from vjepa2_ac.planning.search_space import pose_space

CHOSEN = torch.arange(28.0).reshape(4, 7) / 1000
LIMITS = LimitsConfig(xyz=(0.04, 0.08, 0.0))


def weighted(actions: Tensor) -> Tensor:
    """Return a cost in which every number of every step counts by itself."""
    return (actions * torch.arange(1.0, 29.0).reshape(4, 7)).sum(dim=(1, 2))


def test_a_slice_changes_two_numbers_of_the_first_action_and_no_others() -> None:
    slices = energy_slices(weighted, CHOSEN, pose_space(PlanningConfig(horizon=4, limits=LIMITS)), nodes=5)
    assert tuple(one.axes for one in slices) == ((0, 1), (0, 2), (1, 2))
    for one in slices:
        for row, up in enumerate(one.up):
            for column, across in enumerate(one.across):
                changed = CHOSEN.clone()
                changed[0, one.axes[0]], changed[0, one.axes[1]] = across, up
                assert one.energy[row, column] == pytest.approx(float(weighted(changed[None])[0]), rel=1e-5)


def test_a_slice_reaches_beyond_the_limits_also_along_an_axis_that_is_held() -> None:
    slices = energy_slices(weighted, CHOSEN, pose_space(PlanningConfig(horizon=4, limits=LIMITS)), nodes=3)
    np.testing.assert_allclose(slices[0].across, [-0.05, 0, 0.05], rtol=1e-5)
    np.testing.assert_allclose(slices[0].up, [-0.1, 0, 0.1], rtol=1e-5)
    np.testing.assert_allclose(slices[2].up, [-0.1, 0, 0.1], rtol=1e-5)  # dz is held: as wide as the widest
    held = pose_space(PlanningConfig(horizon=4, limits=LimitsConfig(xyz=(0, 0, 0), rotation=0.1)))
    np.testing.assert_allclose(energy_slices(weighted, CHOSEN, held, nodes=3)[0].up, [-0.0625, 0, 0.0625], rtol=1e-5)
