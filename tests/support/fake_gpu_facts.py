"""Print, as JSON, what the fake GPU counts for known tensors, and run its benchmark.

It runs in a separate process, because the fake GPU must be loaded before PyTorch. The arguments are the folder of the
benchmark, and a JSON list with the benchmark's arguments for each run.
"""

import json
import runpy
import sys
from pathlib import Path
from typing import Any

FOLDER = sys.argv[1]
MEBIBYTE = 2**20


def count_known_tensors() -> dict[str, Any]:
    import torch
    from count import UsageCounter  # type: ignore[import-not-found]  # of the benchmark
    from stand_ins import FAKE  # type: ignore[import-not-found]

    counts: dict[str, Any] = {}
    with FAKE, UsageCounter() as count:
        large = torch.empty(MEBIBYTE, dtype=torch.uint8, device="cuda")
        small = torch.empty(513, dtype=torch.uint8, device="cuda")  # the allocator reserves 1024 bytes
        rows = small.view(27, 19)[3:]
        counts["live"] = count.storages.live
        del large, small
        counts["live, with a view"] = count.storages.live
        counts["peak"] = count.storages.peak
        del rows

        count.reset()
        weights = torch.ones(MEBIBYTE // 4, device="cuda", requires_grad=True)
        loss = weights.square().exp().sin().sum()  # the backward pass needs the output of exp, and the weights
        counts["kept for the backward pass"] = count.storages.live
        loss.backward()
        del loss, weights

        count.reset()
        number = torch.ones(3, device="cuda")
        number.tolist()
        number.add_(1).sum().item()
        counts["waits for numbers"] = count.waits
        count.reset()
        torch.ones(3).to("cuda", non_blocking=True)
        counts["waits for non-blocking copies"] = count.waits
        number.cpu()
        torch.ones(3).to("cuda")
        number.copy_(torch.ones(3))
        counts["waits for copies"] = count.waits
    return counts


if __name__ == "__main__":
    sys.path[:0] = [FOLDER, str(Path(FOLDER).parent)]
    import device  # type: ignore[import-not-found]  # of the benchmark

    device.load()
    counts = count_known_tensors()
    for arguments in json.loads(sys.argv[2]):
        sys.argv = ["fake_gpu", *arguments]
        runpy.run_path(FOLDER, run_name="__main__")
    sys.stdout.write(json.dumps(counts) + "\n")
