"""An old name of `vjepa2_ac.model.network.input_heads`, for one release: model cards import it."""

import warnings

from vjepa2_ac.model.network.input_heads import fit_heads

__all__ = ["fit_heads"]

warnings.warn("vjepa2_ac.model.heads is vjepa2_ac.model.network.input_heads now", FutureWarning, stacklevel=2)
