"""Every knob of planning is documented and read."""

import re

from paths import ROOT
from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.config_file import _all_keys


def test_every_knob_of_planning_is_read_somewhere() -> None:
    source = "\n".join(path.read_text() for path in (ROOT / "src").rglob("*.py"))
    for key in _all_keys(PlanningConfig):
        *sections, name = key.split(".")
        owners = "|".join(["config", "self", *sections[-1:]])
        assert re.search(rf"\b_?({owners})\.{name}\b", source), f"nobody reads {key}"


def test_every_knob_of_planning_is_documented() -> None:
    schema = PlanningConfig.model_json_schema()
    for name, section in {**schema["$defs"], "PlanningConfig": schema}.items():
        for key, knob in section["properties"].items():
            assert knob.get("description") or "$ref" in knob, f"{name}.{key}"
