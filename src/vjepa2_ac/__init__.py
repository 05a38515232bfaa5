"""Fine-tune, evaluate and plan with V-JEPA 2-AC, Meta's action-conditioned video world model.

The public names are described in docs/python.md. They are imported lazily: `import vjepa2_ac` is fast and does not
import PyTorch.
"""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vjepa2_ac.api import encode, evaluate, load_model, load_run, open_dataset, read_clips, train
    from vjepa2_ac.config.loading import load_config
    from vjepa2_ac.errors import UserError
    from vjepa2_ac.model.world_model import WorldModel
    from vjepa2_ac.planning.controller import Controller

__all__ = [
    "Controller", "UserError", "WorldModel", "encode", "evaluate", "load_config", "load_model", "load_run",
    "open_dataset", "read_clips", "train",
]  # fmt: skip

__version__ = version("vjepa2-ac")

_NAMES = {  # module -> public names that are imported from it on first use
    "vjepa2_ac.api": ("encode", "evaluate", "load_model", "load_run", "open_dataset", "read_clips", "train"),
    "vjepa2_ac.config.loading": ("load_config",),
    "vjepa2_ac.errors": ("UserError",),
    "vjepa2_ac.model.world_model": ("WorldModel",),
    "vjepa2_ac.planning.controller": ("Controller",),
}


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


if not TYPE_CHECKING:  # with __getattr__ a type checker would accept any name

    def __getattr__(name: str) -> Any:
        """Import a public name."""
        for module, names in _NAMES.items():
            if name in names:
                globals()[name] = value = getattr(import_module(module), name)
                return value
        raise AttributeError(f"vjepa2_ac has no {name!r}; its public names are {', '.join(__all__)}")
