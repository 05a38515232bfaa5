"""What does the fake GPU say of tensors that are known? Run in a process of its own; prints facts as JSON.

The arguments are the folder of the benchmark, and of each of its runs a list of arguments as JSON: they are done, too.
"""

import copy
import json
import runpy
import sys
from pathlib import Path
from typing import Any

FOLDER = sys.argv[1]
MEBIBYTE = 2**20


def facts() -> dict[str, Any]:
    import torch
    from count import Count, Machine  # type: ignore[import-not-found]  # of the benchmark
    from stand_ins import FAKE, fake_gpu  # type: ignore[import-not-found]
    from work import imagined_model, largest_batch  # type: ignore[import-not-found]

    from vjepa2_ac.config import AdapterConfig, EncoderSizes, ModelSizes, PredictorSizes
    from vjepa2_ac.model.adapter.lora import merge_adapter
    from vjepa2_ac.model.network.world_model import WorldModel

    found: dict[str, Any] = {}
    with FAKE, Count(Machine(tflops=100.0, bandwidth=2.0)) as count:
        large = torch.empty(MEBIBYTE, dtype=torch.uint8, device="cuda")
        small = torch.empty(513, dtype=torch.uint8, device="cuda")  # 1024 bytes of the allocator
        rows = small.view(27, 19)[3:]
        found["live"] = count.live
        del large, small
        found["live, of a view"] = count.live
        found["peak"] = count.peak
        del rows

        count.reset()
        weights = torch.ones(MEBIBYTE // 4, device="cuda", requires_grad=True)
        loss = weights.square().exp().sin().sum()  # keeps the output of exp; that of square, of its input nothing
        found["kept for the backward pass"] = count.live
        loss.backward()
        found["peak of the backward pass"] = count.peak
        del loss, weights

        count.reset()
        number = torch.ones(3, device="cuda")
        number.tolist()
        number.add_(1).sum().item()
        found["waits for numbers"] = list(count.waits.values())
        found["places of waits"] = list(count.waits)
        count.reset()
        number.to("cpu", non_blocking=True).sum().item()
        torch.ones(3).to("cuda", non_blocking=True)
        found["waits that are none"] = sum(count.waits.values())
        number.cpu()
        torch.ones(3).to("cuda")
        number.copy_(torch.ones(3))
        torch.tensor([1.0], device="cuda")
        found["waits for copies"] = sum(count.waits.values())

        left, right = (torch.empty(4096, 4096, dtype=torch.bfloat16, device="cuda") for _ in range(2))
        count.reset()
        left @ right
        found["product"] = count.total._asdict()
        count.reset()
        left[:, :1].expand(4096, 4096) + right.t()
        found["sum"] = count.total._asdict()
        weights = torch.ones(8, device="cuda", requires_grad=True)
        hook = weights.square()
        hook.register_hook(lambda gradient: gradient * gradient.sum().item())
        count.reset()
        with torch.autograd.set_detect_anomaly(True, check_nan=False):
            hook.sin().sum().backward()
        found["waits in the backward pass"] = sum(count.waits.values())
        found["places in the backward pass"] = sorted({place for _, place in count.costs})
    with fake_gpu():
        sizes = ModelSizes(
            image_size=32,
            encoder=EncoderSizes(width=64, heads=1, depth=1),
            predictor=PredictorSizes(width=64, heads=1, depth=1),
        )
        model, merged = imagined_model(sizes, torch.bfloat16, AdapterConfig()), WorldModel.empty(sizes)
        merged.predictor, merged.adaptation = copy.deepcopy(model.predictor), model.adaptation
        merge_adapter(merged)
        kinds = ({(str(one.dtype), str(one.device)) for one in some.predictor.parameters()} for some in (model, merged))
        found["kinds of weights with an adapter, and merged"] = [sorted(some) for some in kinds]
    caps = [2.0, 3.0, 4.3, 21.2, 102.4]  # of which 1.5 GB are the allowance
    found["largest batches"] = [largest_batch(lambda batch: max(1.0 * batch, 0.2 * batch + 0.5), cap) for cap in caps]
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
