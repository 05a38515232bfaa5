"""An environment program in which a hand must reach a position drawn from the seed. Its argument selects a fault."""

import base64
import json
import sys
from typing import Any

import numpy as np

HOW = sys.argv[1] if len(sys.argv) > 1 else "as it should be"
ABOUT = {"world": "fake 1.0", "task": "Come", "instruction": "come here", "rate_hz": 10, "steps": 12, "expert": True}
REACH_M = 0.03  # largest motion per control step


def place_of(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform([0.3, -0.1, 0.2], [0.5, 0.1, 0.4])


class World:
    def reset(self, seed: int) -> dict[str, Any]:
        self.place = place_of(seed)
        self.is_hard = HOW == "hard" or (HOW == "sometimes hard" and seed % 3 == 1)
        self.state = np.array([0.4, 0.0, 0.3, np.pi, 0.0, 0.0, 0.0])
        return self.seen()

    def step(self, target: list[float] | None, steps: int) -> dict[str, Any]:
        held = target or [*(self.state[:3] if self.is_hard else self.place), np.pi, 0.0, 0.0, 0.0]
        for _ in range(steps):
            way = np.array(held[:3]) - self.state[:3]
            self.state[:3] += way * min(1.0, REACH_M / max(float(np.linalg.norm(way)), 1e-9))
            self.state[6] = held[6]
        return {**self.seen(), "target": held}

    def seen(self) -> dict[str, Any]:
        image = np.zeros((24, 32, 3), dtype=np.uint8)
        for place, channel in ((self.state, 0), (self.place, 1)):
            row, column = int(12 + 100 * place[1]), int(16 + 100 * (place[0] - 0.4))
            image[max(0, row - 2) : row + 2, max(0, column - 2) : column + 2, channel] = 255
        far = float(np.linalg.norm(self.state[:3] - self.place))
        pixels = {"height": 24, "width": 32, "rgb": base64.b64encode(image.tobytes()).decode()}
        return {"image": pixels, "state": self.state.tolist(), "success": far < 0.02, "distance_m": far}


def say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def main() -> None:
    say(json.dumps(ABOUT | {"expert": HOW != "no expert"}))
    world = World()
    for line in sys.stdin:
        request = json.loads(line)
        say(json.dumps(getattr(world, request.pop("do"))(**request)))


if __name__ == "__main__":
    main()
