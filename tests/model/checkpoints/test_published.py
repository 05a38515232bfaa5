"""The published checkpoints: their names cannot be mistaken for one another, and other spellings are understood."""

import pytest

from vjepa2_ac.console.progress import PlainConsole
from vjepa2_ac.console.setup import published_table
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.checkpoints.published import PUBLISHED, find_published, published_as


def test_files_do_not_collide_on_a_disk_that_is_blind_to_case() -> None:
    assert len({one.file.casefold() for one in PUBLISHED}) == len(PUBLISHED)
    assert len({one.url for one in PUBLISHED}) == len(PUBLISHED)


def test_every_name_of_a_file_leads_to_it() -> None:
    for one in PUBLISHED:
        for name in (one.name, one.file, one.remote, one.remote.removesuffix(".pt"), one.hub_name):
            assert find_published(name) is one
        assert one in {published_as(one.file), published_as(one.remote)}


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("vjepa2_1_vitG_384.pt", "vjepa2.1-vitG-2b-384"),
        ("vjepa2_1_vitg_384.pt", "vjepa2.1-vitg-1b-384"),
        ("vjepa2.1-vitG-384", "vjepa2.1-vitG-2b-384"),
        ("vjepa21-vitb-384", "vjepa2.1-vitb-384"),
        ("vitl.pt", "vjepa2-vitl"),
    ],
)
def test_other_spellings_are_understood(text: str, name: str) -> None:
    assert find_published(text).name == name


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("VJEPA2_1_VITG_384", r"Did you mean .*vjepa2\.1-vitg-1b-384 or vjepa2\.1-vitG-2b-384"),
        ("vjepa2-vitx", r"Did you mean vjepa2-vit.*download --list"),
        ("facebook/vjepa2-vitl-fpc64-256", r"Did you mean vjepa2-vitl .*--list"),
        ("dinov3", r"no published checkpoint of this name.*--list"),
        ("checkpoints/vitl.pt", r"Did you mean vjepa2-vitl .*--to"),
    ],
)
def test_a_name_that_is_none_is_answered_with_a_way_out(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        find_published(text)


def test_the_sizes_tell_the_two_largest_encoders_apart() -> None:
    by_name = {one.name: one for one in PUBLISHED}
    smaller, larger = by_name["vjepa2.1-vitg-1b-384"].bytes_range, by_name["vjepa2.1-vitG-2b-384"].bytes_range
    assert smaller[1] < larger[0]
    assert by_name["vjepa2.1-vitb-384"].bytes_range == (1_664_223_428, 1_664_223_428)


@pytest.mark.parametrize("width", [60, 80, 120])
def test_the_table_names_every_checkpoint_whole(width: int, capsys: pytest.CaptureFixture[str]) -> None:
    PlainConsole(width=width).print(published_table(PUBLISHED))
    lines = capsys.readouterr().out.splitlines()
    for one in PUBLISHED:
        assert sum(f" {one.name} " in line for line in lines) == 1
    assert all(len(line) <= width for line in lines)
