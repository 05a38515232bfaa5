"""What the documentation shows as a complete config is one."""

import re

import pytest
import yaml

from paths import ROOT
from vjepa2_ac.config_file import parse_config

BLOCKS = re.findall(r"```yaml\n(.*?)```", (ROOT / "docs/data.md").read_text(), flags=re.DOTALL)


@pytest.mark.parametrize("text", BLOCKS, ids=lambda text: text.splitlines()[0])
def test_every_config_of_the_data_page_is_complete(text: str) -> None:
    parse_config(yaml.safe_load(text), where="docs/data.md")


def test_every_form_of_data_has_its_config() -> None:
    sources = {yaml.safe_load(text)["data"].get("source", "rlds") for text in BLOCKS}
    assert sources == {"rlds", "droid_raw", "lerobot", "npz"}
