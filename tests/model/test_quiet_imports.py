"""A program that imports this package keeps its own settings of the garbage collector and of logging."""

import gc
import importlib
import logging

import pytest

from vjepa2_ac.model.quiet_imports import quiet_imports


@pytest.mark.parametrize("collects", [True, False])
def test_a_quiet_import_leaves_all_as_it_was(collects: bool) -> None:
    logger, was_enabled = logging.getLogger("torchao"), gc.isenabled()
    try:
        (gc.enable if collects else gc.disable)()
        logger.setLevel(logging.DEBUG)
        with quiet_imports():
            assert (gc.isenabled(), logger.level) == (False, logging.ERROR)
        with pytest.raises(ModuleNotFoundError), quiet_imports():
            importlib.import_module("not_installed")
        assert (gc.isenabled(), logger.level) == (collects, logging.DEBUG)
    finally:
        (gc.enable if was_enabled else gc.disable)()
        logger.setLevel(logging.NOTSET)
