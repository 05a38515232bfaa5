"""An old name of `vjepa2_ac.model.checkpoints.loading`, for one release: model cards import it."""

import warnings

from vjepa2_ac.model.checkpoints.loading import load_base

__all__ = ["load_base"]

warnings.warn("vjepa2_ac.model.load is vjepa2_ac.model.checkpoints.loading now", FutureWarning, stacklevel=2)
