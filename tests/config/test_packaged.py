"""The configs of the package are found by name, wherever it is installed."""

from pathlib import Path

import pytest

from paths import ROOT
from vjepa2_ac.cli import main
from vjepa2_ac.config.loading import load_config, load_config_of_run
from vjepa2_ac.config.packaged import config_path, packaged_configs
from vjepa2_ac.errors import InputError


def test_the_folder_of_a_checkout_is_that_of_the_package() -> None:
    assert sorted(packaged_configs()) == sorted(path.stem for path in (ROOT / "configs").glob("*.yaml"))
    assert (
        load_config("builtin:demo")
        == load_config(ROOT / "configs/demo.yaml")
        == load_config_of_run(Path("builtin:demo"))
    )
    assert all(packaged_configs().values())


@pytest.mark.parametrize("name", ["nothing", "", "../sim-tiny/config", "demo.yaml", "/etc/passwd"])
def test_a_name_that_is_none_lists_those_that_are(name: str) -> None:
    with pytest.raises(InputError, match=r"no config of that name.*builtin:demo, .*builtin:scratch_vitl"):
        config_path(f"builtin:{name}")


def test_text_prints_the_file_with_its_comments(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["config", "text", "builtin:own_robot"]) == 0
    (tmp_path / "mine.yaml").write_text(capsys.readouterr().out)
    assert (tmp_path / "mine.yaml").read_text() == (ROOT / "configs/own_robot.yaml").read_text()
    assert main(["config", "list"]) == 0
    assert capsys.readouterr().out.count("builtin:") >= 14
