"""An error reads as sentences, and travels between processes."""

import pickle

import pytest

from vjepa2_ac.errors import InputError


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (InputError(where="a.yaml", found="nothing"), "a.yaml: nothing."),
        (
            InputError(where="a.yaml", found="3", needed="4", fix="Set it to 4"),
            "a.yaml: 3. needed: 4. Set it to 4.",
        ),
        (InputError(where="a", found="2 are wrong\n  x\n", fix="See b"), "a: 2 are wrong\n  x\nSee b."),
        (InputError(where="a", found="is it?", fix="Yes."), "a: is it? Yes."),
    ],
)
def test_where_what_was_found_what_was_needed_and_the_way_out(error: InputError, message: str) -> None:
    assert str(error) == message


def test_an_error_of_a_loader_worker_arrives_as_it_was() -> None:
    error = InputError(where="a", found="b", needed="c", fix="d")
    other = pickle.loads(pickle.dumps(error))  # noqa: S301 - our own bytes
    assert (type(other), str(other), other.fix) == (InputError, str(error), "d")
