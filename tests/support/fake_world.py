"""An environment program in which a hand must reach a position drawn from the seed. Its argument selects a fault."""

import base64
import json
import sys
from typing import Any

import numpy as np

FAULT = sys.argv[1] if len(sys.argv) > 1 else "as it should be"
ABOUT: dict[str, Any] = {
    "world": "fake 1.0",
    "task": "Come",
    "instruction": "come here",
    "rate_hz": 10,
    "steps": 12,
    "expert": True,
}
ABOUT["versions"] = {"mujoco": "3.0"}
REACH_M = 0.03  # largest motion per control step


def draw_block_position(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform([0.3, -0.1, 0.2], [0.5, 0.1, 0.4])


class World:
    def reset(self, seed: int) -> dict[str, Any]:
        self.block_position = draw_block_position(seed)
        self.is_hard = FAULT == "hard" or (FAULT == "sometimes hard" and seed % 3 == 1)
        self.state = np.array([0.4, 0.0, 0.3, np.pi, 0.0, 0.0, 0.0])
        return self.observe()

    def step(self, target: list[float] | None, steps: int) -> dict[str, Any]:
        target_state = target or [*(self.state[:3] if self.is_hard else self.block_position), np.pi, 0.0, 0.0, 0.0]
        for _ in range(steps):
            offset = np.array(target_state[:3]) - self.state[:3]
            self.state[:3] += offset * min(1.0, REACH_M / max(float(np.linalg.norm(offset)), 1e-9))
            self.state[6] = target_state[6]
        return {**self.observe(), "target": target_state}

    def observe(self) -> dict[str, Any]:
        image = np.zeros((24, 32, 3), dtype=np.uint8)
        for position, channel in ((self.state, 0), (self.block_position, 1)):
            row, column = int(12 + 100 * position[1]), int(16 + 100 * (position[0] - 0.4))
            image[max(0, row - 2) : row + 2, max(0, column - 2) : column + 2, channel] = 255
        far = float(np.linalg.norm(self.state[:3] - self.block_position))
        pixels = {"height": 24, "width": 32, "rgb": base64.b64encode(image.tobytes()).decode()}
        return {"image": pixels, "state": self.state.tolist(), "success": far < 0.02, "distance_m": far}


def write_line(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def main() -> None:
    write_line(json.dumps(ABOUT | {"expert": FAULT != "no expert"}))
    world = World()
    for line in sys.stdin:
        request = json.loads(line)
        write_line(json.dumps(getattr(world, request.pop("do"))(**request)))


if __name__ == "__main__":
    main()
