"""The YAML text of draft values is parsed back to the same values, for all values and comments."""

from hypothesis import given, settings
from hypothesis import strategies as st

from vjepa2_ac.init.draft_values import GUESSED, DraftValue, format_yaml, list_guesses, plain_values
from vjepa2_ac.storage.structured import parse_yaml

WORDS = st.text(alphabet=st.characters(exclude_categories=("C", "Zl", "Zp")), max_size=12)
NAMES = st.from_regex(r"[a-z_]{1,8}", fullmatch=True)
NUMBERS = st.integers(-(10**9), 10**9) | st.floats(allow_nan=False, allow_infinity=False)
VALUES = st.one_of(st.none(), st.booleans(), NUMBERS, WORDS, st.lists(WORDS, max_size=3), st.dictionaries(NAMES, WORDS))
DRAFT_VALUES = st.builds(DraftValue, VALUES, WORDS, st.booleans())
SECTIONS = st.recursive(DRAFT_VALUES, lambda inner: st.dictionaries(NAMES, inner, min_size=1, max_size=3), max_leaves=8)


@settings(max_examples=200)
@given(values=st.dictionaries(NAMES, SECTIONS, min_size=1, max_size=4), header=st.lists(WORDS, max_size=2))
def test_yaml_text_parses_to_the_same_values(values: dict[str, object], header: list[str]) -> None:
    assert parse_yaml(format_yaml(header, values), where="here") == plain_values(values)  # type: ignore[arg-type]


def test_guesses_are_marked_and_listed() -> None:
    values = {"data": {"camera": DraftValue("front", "of two", is_guess=True), "frames": DraftValue(8, "enough")}}
    assert f"# {GUESSED}of two" in format_yaml([], values)
    assert list_guesses(values) == {"data.camera": "front: of two"}
