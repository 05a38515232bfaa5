"""Fine-tune V-JEPA 2-AC, the action-conditioned video world model, and know whether it helped."""

from importlib.metadata import version

__version__ = version("vjepa2-ac")
