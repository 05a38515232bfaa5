"""What users of version 0.1 were told to import still works, and says where it went."""

import importlib
import sys

import pytest

OLD = [
    ("vjepa2_ac.model.load", "load_base", "vjepa2_ac.model.checkpoints.loading", "load_base"),
    ("vjepa2_ac.model.lora", "load_trained", "vjepa2_ac.model.adapter.lora", "load_trained"),
    ("vjepa2_ac.model.heads", "fit_heads", "vjepa2_ac.model.network.input_heads", "fit_heads"),
    ("vjepa2_ac.data.picture_file", "read_picture", "vjepa2_ac.media.image_file", "read_image"),
]


@pytest.mark.filterwarnings("default::DeprecationWarning")  # of libraries, where nothing imported them before
@pytest.mark.parametrize(("old", "name", "new", "new_name"), OLD, ids=[entry[0] for entry in OLD])
def test_an_old_name_is_the_new_one_and_says_so(old: str, name: str, new: str, new_name: str) -> None:
    sys.modules.pop(old, None)
    with pytest.warns(FutureWarning, match=new):
        module = importlib.import_module(old)
    assert getattr(module, name) is getattr(importlib.import_module(new), new_name)


PRINTED = [
    ("vjepa2_ac.config", "ModelConfig"),
    ("vjepa2_ac.episode", "Widths"),
    ("vjepa2_ac.model.adapter.lora", "load_trained"),
    ("vjepa2_ac.model.checkpoints.loading", "load_base"),
    ("vjepa2_ac.model.network.input_heads", "fit_heads"),
    ("vjepa2_ac.planning.session", "load_to_plan"),
]


@pytest.mark.parametrize(("module", "name"), PRINTED)
def test_what_cards_and_docs_imported_before_the_public_names_is_still_there(module: str, name: str) -> None:
    assert callable(getattr(importlib.import_module(module), name))
