"""What openpi's client sends, as it was recorded (tests/golden/openpi/make.py), is answered as our own client is."""

import runpy

import numpy as np

from paths import ROOT
from served import session
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.serving.session import Session
from vjepa2_ac.serving.wire import pack, unpack

FOLDER = ROOT / "tests/golden/openpi"
FRAMES = sorted(FOLDER.glob("*.bin"))


MADE = runpy.run_path(str(FOLDER / "make.py"))
picture = MADE["picture"]


def answers(messages: list[bytes]) -> list[dict | str]:
    one: Session = session(goals={"cup": (SubGoal(picture(20), "cup"),)})
    found = [one.answer(message) for message in messages]
    return [unpack(answer) if isinstance(answer, bytes) else answer for answer in found]


def test_the_recorded_dialogue_is_answered_as_ours_is() -> None:
    assert [path.stem for path in FRAMES] == list(MADE["DIALOGUE"])
    theirs = answers([path.read_bytes() for path in FRAMES])
    ours = answers([pack(message) for message in MADE["DIALOGUE"].values()])
    for path, one, other in zip(FRAMES, theirs, ours, strict=True):
        if isinstance(other, str):
            assert one == other, path.name
            assert "degrees" in one
        elif "actions" in other:
            np.testing.assert_array_equal(one["actions"], other["actions"])
            assert (one["why"], one["goal"], one["energy"]) == (other["why"], other["goal"], other["energy"]), path.name
            assert one["why"] == "planned"
        else:
            assert one == other == {"status": "reset"}
