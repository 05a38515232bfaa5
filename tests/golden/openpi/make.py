"""Write the messages that openpi-client 0.1.2 sends in a short dialogue. Runs where that client is installed.

    python -m venv client && client/bin/pip install openpi-client==0.1.2 typing_extensions
    client/bin/python tests/golden/openpi/make.py

Written on 2026-11-23 with Python 3.11.7, numpy 1.26.4 and msgpack 1.2.4.
"""

from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
STATE = np.array([0.4, 0.0, 0.3, 3.1, 0.0, 0.1, 0.2])


def draw_image(number: int) -> np.ndarray:
    """Return an image that needs no file: 48 x 60 pixels."""
    y, x, c = np.mgrid[:48, :60, :3]
    return ((x * (number + 3) + y * (2 * number + 5) + 40 * c) % 256).astype(np.uint8)


DROID = {"observation/cartesian_position": STATE[:6], "observation/gripper_position": STATE[6:]}
DIALOGUE = {
    "1_goal_and_picture": {"observation/image": draw_image(0), "observation/state": STATE, "goal/image": draw_image(9)},
    "2_same_goal_next_picture": {
        "observation/image": draw_image(1),
        "observation/state": STATE.astype(np.float32),
        "goal/image": draw_image(9),
    },
    "3_a_state_in_degrees": {"observation/image": draw_image(1), "observation/state": STATE * [1, 1, 1, 60, 1, 1, 1]},
    "4_new_episode_by_prompt": {
        "observation/exterior_image_1_left": draw_image(2),
        **DROID,
        "prompt": "cup",
        "reset": True,
    },
    "5_roboarena": {
        "endpoint": "infer",
        "session_id": "7d7c6c0e",
        "prompt": "cup",
        "observation/exterior_image_0_left": draw_image(3),
        "observation/joint_position": np.zeros(7),
        "observation/wrist_image_left": draw_image(4),
        **DROID,
        "observation/gripper_position": np.float64(0.2),
    },
    "6_roboarena_reset": {"endpoint": "reset", "session_id": "7d7c6c0f"},
}

if __name__ == "__main__":
    from openpi_client import msgpack_numpy

    packer = msgpack_numpy.Packer()
    for name, message in DIALOGUE.items():
        (HERE / f"{name}.bin").write_bytes(packer.pack(message))
