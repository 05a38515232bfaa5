"""Print, as JSON, what the fake GPU counts for known tensors, and its rows. A process of its own: PyTorch comes later.

The arguments are the folder of the benchmark, and lists of its arguments as JSON, one for each run.
"""

import json
import runpy
import sys
from pathlib import Path
from typing import Any

FOLDER = sys.argv[1]
MEBIBYTE = 2**20


def facts() -> dict[str, Any]:
    import torch
    from count import Count  # type: ignore[import-not-found]  # of the benchmark
    from stand_ins import FAKE  # type: ignore[import-not-found]

    found: dict[str, Any] = {}
    with FAKE, Count() as count:
        large = torch.empty(MEBIBYTE, dtype=torch.uint8, device="cuda")
        small = torch.empty(513, dtype=torch.uint8, device="cuda")  # 1024 bytes of the allocator
        rows = small.view(27, 19)[3:]
        found["live"] = count.storages.live
        del large, small
        found["live, of a view"] = count.storages.live
        found["peak"] = count.storages.peak
        del rows

        count.reset()
        weights = torch.ones(MEBIBYTE // 4, device="cuda", requires_grad=True)
        loss = weights.square().exp().sin().sum()  # keeps the output of exp; that of square, of its input nothing
        found["kept for the backward pass"] = count.storages.live
        loss.backward()
        del loss, weights

        count.reset()
        number = torch.ones(3, device="cuda")
        number.tolist()
        number.add_(1).sum().item()
        found["waits for numbers"] = count.waits
        count.reset()
        torch.ones(3).to("cuda", non_blocking=True)
        found["waits that are none"] = count.waits
        number.cpu()
        torch.ones(3).to("cuda")
        number.copy_(torch.ones(3))
        found["waits for copies"] = count.waits
    return found


if __name__ == "__main__":
    sys.path[:0] = [FOLDER, str(Path(FOLDER).parent)]
    import device  # type: ignore[import-not-found]  # of the benchmark

    device.load()
    known = facts()
    for arguments in json.loads(sys.argv[2]):
        sys.argv = ["fake_gpu", *arguments]
        runpy.run_path(FOLDER, run_name="__main__")
    sys.stdout.write(json.dumps(known) + "\n")
