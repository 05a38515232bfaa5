"""An old name of `vjepa2_ac.model.adapter.lora`, for one release: model cards import it."""

import warnings

from vjepa2_ac.model.adapter.lora import add_adapter, load_trained, save_trained

__all__ = ["add_adapter", "load_trained", "save_trained"]

warnings.warn("vjepa2_ac.model.lora is vjepa2_ac.model.adapter.lora now", FutureWarning, stacklevel=2)
