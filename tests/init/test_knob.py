"""The text of a config reads back as its values, whatever they are and whatever the comments say."""

from hypothesis import given, settings
from hypothesis import strategies as st

from vjepa2_ac.init.found import GUESSED, Knob, as_yaml, guesses, plain
from vjepa2_ac.storage.structured import parse_yaml

WORDS = st.text(alphabet=st.characters(exclude_categories=("C", "Zl", "Zp")), max_size=12)
NAMES = st.from_regex(r"[a-z_]{1,8}", fullmatch=True)
NUMBERS = st.integers(-(10**9), 10**9) | st.floats(allow_nan=False, allow_infinity=False)
VALUES = st.one_of(st.none(), st.booleans(), NUMBERS, WORDS, st.lists(WORDS, max_size=3), st.dictionaries(NAMES, WORDS))
KNOBS = st.builds(Knob, VALUES, WORDS, st.booleans())
SECTIONS = st.recursive(KNOBS, lambda inner: st.dictionaries(NAMES, inner, min_size=1, max_size=3), max_leaves=8)


@settings(max_examples=200)
@given(knobs=st.dictionaries(NAMES, SECTIONS, min_size=1, max_size=4), head=st.lists(WORDS, max_size=2))
def test_text_reads_back(knobs: dict[str, object], head: list[str]) -> None:
    assert parse_yaml(as_yaml(head, knobs), where="here") == plain(knobs)  # type: ignore[arg-type]


def test_guesses_are_marked_and_listed() -> None:
    knobs = {"data": {"camera": Knob("front", "of two", is_guess=True), "frames": Knob(8, "enough")}}
    assert f"# {GUESSED}of two" in as_yaml([], knobs)
    assert guesses(knobs) == {"data.camera": "front: of two"}
