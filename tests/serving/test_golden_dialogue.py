"""Recorded messages of openpi's client (tests/golden/openpi/make.py) get the same replies as our client's."""

import runpy

import numpy as np

from paths import ROOT
from served import session
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.serving.session import Session
from vjepa2_ac.serving.wire import pack, unpack

FOLDER = ROOT / "tests/golden/openpi"
MESSAGE_PATHS = sorted(FOLDER.glob("*.bin"))


EXAMPLES = runpy.run_path(str(FOLDER / "make.py"))
make_image = EXAMPLES["draw_image"]


def get_replies(messages: list[bytes]) -> list[dict | str]:
    served: Session = session(goals={"cup": (SubGoal(make_image(20), "cup"),)})
    replies = [served.reply_to(message) for message in messages]
    return [unpack(reply) if isinstance(reply, bytes) else reply for reply in replies]


def test_recorded_openpi_messages_get_the_same_replies_as_messages_of_our_client() -> None:
    assert [path.stem for path in MESSAGE_PATHS] == list(EXAMPLES["DIALOGUE"])
    openpi_replies = get_replies([path.read_bytes() for path in MESSAGE_PATHS])
    own_replies = get_replies([pack(message) for message in EXAMPLES["DIALOGUE"].values()])
    for path, reply, expected in zip(MESSAGE_PATHS, openpi_replies, own_replies, strict=True):
        if isinstance(expected, str):
            assert reply == expected, path.name
            assert "degrees" in reply
        elif "actions" in expected:
            np.testing.assert_array_equal(reply["actions"], expected["actions"])
            assert (reply["why"], reply["goal"], reply["energy"]) == (
                expected["why"],
                expected["goal"],
                expected["energy"],
            ), path.name
            assert reply["why"] == "planned"
        else:
            assert reply == expected == {"status": "reset"}
