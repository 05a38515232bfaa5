"""An old name of `vjepa2_ac.planning.session`, for one release: model cards and scripts of version 0.1 import it."""

import warnings

from vjepa2_ac.planning.session import load_to_plan

__all__ = ["load_to_plan"]

warnings.warn("vjepa2_ac.training.planning is vjepa2_ac.planning.session now", FutureWarning, stacklevel=2)
