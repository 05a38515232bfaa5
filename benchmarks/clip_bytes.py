"""How many bytes does a clip of an RLDS data set behind a URL cost, for each size of the disk cache?

    python benchmarks/clip_bytes.py [--episodes 4] [--steps 290] [--clips 24]

Episodes as long and as large as DROID's lie on an emulated Google Cloud Storage, with their features in the order of
their names and in a drawn order, as TFDS leaves it to a hash. Printed are the bytes and reads of the index for each
episode, of the first clip of each episode, and of a later clip: 16 frames of one camera at stride 4, at a random place
of a random episode, for a disk cache of nothing, of a third of the images of that camera, and of more than all of them.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from synthetic_droid import draw_episodes

from vjepa2_ac import storage
from vjepa2_ac.config import DiskCacheConfig, RldsData
from vjepa2_ac.data.sources.rlds.source import RldsSource
from vjepa2_ac.simulation.droid_writer import write_droid_rlds

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
FRAMES, STRIDE = 16, 4
SPAN = (FRAMES - 1) * STRIDE + 1


def main(options: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=4, help="of three cameras (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=290, help="of each episode (default: %(default)s)")
    parser.add_argument("--clips", type=int, default=24, help="later clips (default: %(default)s)")
    arguments = parser.parse_args(options)

    import pytest

    import gcs
    from tfrecords import in_any_order

    with tempfile.TemporaryDirectory() as scratch, gcs.running() as server, pytest.MonkeyPatch.context() as patch:
        patch.setenv("STORAGE_EMULATOR_HOST", server.url)
        named = write_droid_rlds(Path(scratch) / "named", draw_episodes(arguments.episodes, arguments.steps), shards=1)
        folders = {"by name": named, "drawn": in_any_order(named, Path(scratch) / "drawn", seed=0)}
        print(f"\n{'features':10}{'cache GB':>10}{'index':>18}{'first clip':>18}{'later clip':>18}   KB (reads)")
        for order, folder in folders.items():
            url = server.upload(folder, f"droid/{order.replace(' ', '_')}/1.0.0")
            third = arguments.episodes * arguments.steps * 17_000 / 3 / 1e9
            for limit_gb in (0.0, third, 10.0):
                cache = DiskCacheConfig(dir=f"{scratch}/{order} {limit_gb}", limit_gb=limit_gb)
                costs = measure(RldsSource(RldsData(path=url, disk_cache=cache)), server, arguments.clips)
                print(f"{order:10}{limit_gb:10.4f}" + "".join(f"{kb:10.0f} ({reads:5.1f})" for kb, reads in costs))


def measure(source: RldsSource, server: object, clips: int) -> list[tuple[float, float]]:
    """Return KB and reads of the index for each episode, of each first clip, and of each later clip."""
    generator = np.random.default_rng(0)

    def cost_of(action: Callable[[], int]) -> tuple[float, float]:
        server.forget()  # type: ignore[attr-defined]  # of tests/support/gcs.py
        before = storage.bytes_fetched()
        count = action()
        return (storage.bytes_fetched() - before) / count / 1e3, len(server.reads()) / count  # type: ignore[attr-defined]

    def clips_of(episodes: list[int]) -> int:
        for episode in episodes:
            read = source.read(episode)
            first = int(generator.integers(read.info.num_steps - SPAN + 1))
            read.read_frames(range(first, first + SPAN, STRIDE))
        return len(episodes)

    count = len(source.infos())
    return [
        cost_of(lambda: len(RldsSource(source._config.model_copy(update={"disk_cache": anew(source)})).infos())),
        cost_of(lambda: clips_of(list(range(count)))),
        cost_of(lambda: clips_of(generator.integers(0, count, clips).tolist())),
    ]


def anew(source: RldsSource) -> object:
    """Return a disk cache that holds nothing."""
    cache = source._config.disk_cache
    return cache.model_copy(update={"dir": f"{cache.dir} of the index"})


if __name__ == "__main__":
    main()
