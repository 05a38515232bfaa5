"""Encoding on a cluster: Ray Data hands missing episodes to actors, and those of a lost actor to another one."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_dict, parse_config
from vjepa2_ac.distributed import computing_device
from vjepa2_ac.encoding.encode_dataset import Engine, begin_encoding, open_cache, require_shared
from vjepa2_ac.encoding.latent_cache import EncoderOnDevice, FramesToEncode, LatentCache, encode_files, frames_in
from vjepa2_ac.errors import InputError, UnreachableError, require_library
from vjepa2_ac.reporter import Reporter

_MOST_AT_ONCE = 16  # requests in a task: the next one is decoded while one is encoded
_FEWEST_TASKS = 64  # if there are as many requests: the last ones end at about the same time
_MOST_DEATHS = 10  # of actors one after the other before they have begun: nothing is installed on their nodes
_LONGEST_END_S = 30.0
_AGAIN = "The same command goes on with what is missing"


@contextlib.contextmanager
def ray_engine(address: str) -> Iterator[Engine]:
    """Connect to a Ray cluster, or start a Ray on this machine, until the context ends.

    Args:
        address: Of the cluster, as `ray.init` takes it; empty: start one.

    Raises:
        UnreachableError: Ray is not installed, or there is no cluster at the address.
    """
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    if address:
        os.environ.setdefault("RAY_NUM_REDIS_GET_RETRIES", "1")  # 40 s, not 13 minutes, where nobody answers
    where = f"--engine ray={address}" if address else "--engine ray"
    ray = require_library("ray", where=where, called="Ray, which shares work on a cluster", extra="cluster")
    require_library("ray.data", where=where, called="Ray Data, which shares work on a cluster", extra="cluster")
    how: dict[str, Any] = {"address": address} if address else {"address": "local", "include_dashboard": False}
    try:
        ray.init(**how, logging_level=logging.ERROR, log_to_driver=False)
    except (OSError, RuntimeError, ValueError) as error:
        found = f"no Ray cluster that can be used ({error})"
        raise UnreachableError(where=where, found=found, fix="`ray status` on its head node shows it") from None
    try:
        yield partial(_encode, where)
    except (ray.exceptions.RayError, ray.data.exceptions.ExecutionTimeoutError) as error:
        raise UnreachableError(where=where, found=f"Ray has given up ({error})", fix=_AGAIN) from error
    finally:
        for thread in threading.enumerate():
            if thread.name == "iter_threaded":  # of Ray Data: one that asks Ray after its end ends us without an error
                thread.join(_LONGEST_END_S)
        ray.shutdown()


def _encode(where: str, config: Config, cache: LatentCache, left: Sequence[FramesToEncode], reporter: Reporter) -> None:
    """Encode what is left with an actor on each GPU, or on each CPU core where there is none.

    An actor that joins late takes part, and one that dies loses nothing.

    Raises:
        InputError: As of `encode_share`, from any actor; or there is no GPU and the config requests one; or an actor
            has other data, or not the folder of the cache.
    """
    import ray

    devices = ray.cluster_resources()
    kind = "GPU" if config.training.device != "cpu" and devices.get("GPU") else "CPU"
    if kind == "CPU" and config.training.device == "cuda":
        raise InputError(where=f"training.device: cuda, {where}", found="a cluster without a GPU")
    begin_encoding(cache, left, reporter)
    context, size = ray.data.DataContext.get_current(), max(1, min(_MOST_AT_ONCE, len(left) // _FEWEST_TASKS))
    context.enable_progress_bars = context.print_on_execution_start = False
    context.max_consecutive_actor_init_deaths = _MOST_DEATHS
    logging.getLogger("ray.data").setLevel(logging.ERROR)
    folder = cache.folder.absolute() if isinstance(cache.folder, Path) else cache.folder
    tasks = [{"wanted": _Task(left[first : first + size])} for first in range(0, len(left), size)]
    results = ray.data.from_items(tasks, override_num_blocks=len(tasks)).map(
        _Actor,
        fn_constructor_args=(config_as_dict(config), folder, Path.cwd()),
        compute=ray.data.ActorPoolStrategy(min_size=1, initial_size=max(1, int(devices.get(kind, 1)))),
        num_cpus=int(kind == "CPU"),
        num_gpus=int(kind == "GPU"),
    )
    progress, done, total = reporter.task("encoding frames", "frames"), 0, frames_in(left)
    progress(done, total)
    for row in results.iter_rows():
        result: _Result = row["found"]
        if result.error is not None:
            raise result.error
        for name, reason in result.broken.items():
            cache.dataset.broken.met(name, reason)
        done += result.frames
        progress(done, total)
    require_shared(cache, lambda: not cache.missing())


@dataclass(frozen=True, eq=False)
class _Task:
    wanted: Sequence[FramesToEncode]


@dataclass(frozen=True, eq=False)
class _Result:
    frames: int
    broken: Mapping[str, str]  # all that the actor has met, by identity, and why
    error: Exception | None = None  # a value: Ray would wrap it, and may try again


class _Actor:
    """Encodes on one device. What it needs is opened and loaded at the first task."""

    def __init__(self, config: Mapping[str, Any], folder: Path | str, here: Path) -> None:
        self._config, self._folder, self._here = config, folder, here

    @cached_property
    def _opened(self) -> tuple[LatentCache, EncoderOnDevice]:
        with contextlib.suppress(OSError):  # where this node has no such folder, what is missed will be named
            os.chdir(self._here)
        config = parse_config(self._config, where="the config")
        cache, model = open_cache(config, self._folder)
        require_shared(cache, lambda: cache.is_begun)
        return cache, EncoderOnDevice.of(config, model, computing_device(config.training))

    def __call__(self, row: Mapping[str, Any]) -> dict[str, _Result]:
        wanted = row["wanted"].wanted
        try:
            cache, encoder = self._opened
            left = [one for one in wanted if not cache.files.has(one.episode, one.camera)]  # by one that died
            encode_files(cache.dataset, left, encoder, cache.files)
        except Exception as error:
            error.add_note(traceback.format_exc())
            return {"found": _Result(0, {}, error)}
        return {"found": _Result(frames_in(wanted), cache.dataset.broken.reasons)}
