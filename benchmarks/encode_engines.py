"""What does it cost to share the encoding of a data set? The true command, by one process, by shares and by Ray.

    python benchmarks/encode_engines.py                    # needs the extra cluster
    python benchmarks/encode_engines.py --ways plain shares

Start: until the first file of latents is there. Speed: frames of the later files per second, until the last one is
there. All have a core for each process. Every cache is compared with the first one: its latents are the same bits.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import psutil  # type: ignore[import-untyped]
import torch
import yaml
from safetensors.torch import load_file
from synthetic_droid import draw_episodes

from vjepa2_ac.config import EncoderSizes, ModelSizes, PredictorSizes
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.simulation.droid_writer import write_droid_rlds

STEPS = 40  # of an episode
SIZES = ModelSizes(
    image_size=128,
    encoder=EncoderSizes(width=192, depth=6, heads=3),
    predictor=PredictorSizes(width=48, depth=1, heads=3),
)
PROCESSES = 2


class Job:
    """Commands at work on one cache."""

    def __init__(self, config: Path, out: Path, *words: str, shares: int = 1) -> None:
        self.out, self.started = out, time.time()
        command = [sys.executable, "-m", "vjepa2_ac.cli", "encode", str(config), "--out", str(out), *words]
        places = [{"RANK": str(rank), "WORLD_SIZE": str(shares)} for rank in range(shares)]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        self.processes = [
            subprocess.Popen(command, env=environment | place, stdout=subprocess.DEVNULL)  # noqa: S603 - our own
            for place in places
        ]

    def files(self) -> list[Path]:
        """Return the whole files, the oldest first."""
        found = [path for path in self.out.rglob("*.safetensors") if not path.name.startswith(".")]
        return sorted(found, key=lambda path: path.stat().st_mtime)

    def wait_for(self, count: int) -> None:
        """Wait until so many files are there."""
        while len(self.files()) < count:
            if any(process.poll() not in {None, 0} for process in self.processes):
                raise SystemExit("a command failed")
            time.sleep(0.1)

    def actors(self) -> list[psutil.Process]:
        """Return the processes of the actors of a Ray that this job has started."""
        below = psutil.Process(self.processes[0].pid).children(recursive=True)
        return [one for one in below if "MapWorker" in " ".join(one.cmdline()[:1])]

    def finish(self, way: str) -> float:
        """Wait for its end, and print a line; return frames per second."""
        for process in self.processes:
            if process.wait():
                raise SystemExit("a command failed")
        whole, times = time.time() - self.started, [path.stat().st_mtime for path in self.files()]
        start, speed = times[0] - self.started, (len(times) - 1) * STEPS / (times[-1] - times[0])
        print(f"{way:26} start {start:5.1f} s, then {speed:6.1f} frames/s; {whole:6.1f} s in all", flush=True)
        return speed


def plain(config: Path, out: Path, _: int) -> Job:
    """Encode in one process."""
    return Job(config, out)


def shares(config: Path, out: Path, _: int) -> Job:
    """Encode in processes that do not know of one another."""
    return Job(config, out, shares=PROCESSES)


def ray(config: Path, out: Path, _: int) -> Job:
    """Encode by Ray, of this machine."""
    return Job(config, out, "--engine", "ray")


def killed_actor(config: Path, out: Path, episodes: int) -> Job:
    """Kill one of Ray's actors after a third of the episodes."""
    job = ray(config, out, episodes)
    job.wait_for(episodes // 3)
    job.actors()[0].kill()
    return job


def killed_node(config: Path, out: Path, episodes: int) -> Job:
    """Take one of a cluster's two nodes away after a third of the episodes."""
    return _on_nodes(Nodes(2), Nodes.remove, config, out, episodes)


def late_node(config: Path, out: Path, episodes: int) -> Job:
    """Give a cluster of one node a second one after a third of the episodes."""
    return _on_nodes(Nodes(1), Nodes.add, config, out, episodes)


def _on_nodes(cluster: Nodes, change: Callable[[Nodes], None], config: Path, out: Path, episodes: int) -> Job:
    """Encode on a cluster that is changed after a third of the episodes."""
    job = Job(config, out, "--engine", f"ray={cluster.address}")
    job.wait_for(episodes // 3)
    change(cluster)
    return cluster.end_with(job)


class Nodes:
    """A Ray cluster on this machine, with nodes of one core each."""

    def __init__(self, count: int) -> None:
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
        from ray.cluster_utils import Cluster

        self._cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
        self.address: str = self._cluster.address
        self._nodes: list[object] = []
        for _ in range(count):
            self.add()

    def add(self) -> None:
        """Add a node."""
        self._nodes.append(self._cluster.add_node(num_cpus=1))

    def remove(self) -> None:
        """Kill the newest node."""
        self._cluster.remove_node(self._nodes.pop(), allow_graceful=False)

    def end_with(self, job: Job) -> Job:
        """Wait for a job, and end."""
        job.processes[0].wait()
        self._cluster.shutdown()
        return job


WAYS: dict[str, Callable[[Path, Path, int], Job]] = {
    one.__name__: one for one in (plain, shares, ray, killed_actor, killed_node, late_node)
}


def main(arguments: list[str] | None = None) -> None:
    """Encode one data set in every way."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_droid_rlds(folder / "data", draw_episodes(options.episodes, STEPS), shards=4)
        WorldModel.random(SIZES, seed=0).save_pretrained(folder / "base")
        values = {
            "run_dir": str(folder / "run"),
            "data": {"path": str(folder / "data"), "frames": 4, "stride": 1, "workers": 1},
            "model": {"base": str(folder / "base"), "dtype": "float32"},
            "training": {"precision": "fp32", "device": "cpu"},
        }
        config = folder / "config.yaml"
        config.write_text(yaml.safe_dump(values))
        first, speeds = folder / options.ways[0], dict[str, float]()
        for way in options.ways:
            speeds[way] = WAYS[way](config, folder / way, options.episodes).finish(way)
            for path in first.rglob("*.safetensors"):
                found, known = load_file(folder / way / path.relative_to(first)), load_file(path)
                assert all(torch.equal(found[one], known[one]) for one in known)
    base = speeds[options.ways[0]]
    print(f"{os.cpu_count()} cores; " + ", ".join(f"{way} {speed / base:.2f}x" for way, speed in speeds.items()))


if __name__ == "__main__":
    main()
