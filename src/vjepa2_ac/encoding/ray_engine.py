"""Encoding on a cluster: Ray Data distributes the missing episodes to actors and retries the tasks of a lost actor."""

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
from vjepa2_ac.distributed import select_device
from vjepa2_ac.encoding.encode_dataset import Engine, begin_encoding, open_cache, require_shared
from vjepa2_ac.encoding.latent_cache import EncoderOnDevice, FramesToEncode, LatentCache, count_frames, encode_files
from vjepa2_ac.errors import InputError, UnreachableError, require_library
from vjepa2_ac.reporter import Reporter

_MAX_TASK_REQUESTS = 16  # requests per task; several requests let decoding and encoding overlap
_MIN_TASKS = 64  # if there are enough requests; many tasks let all actors finish at about the same time
_MAX_ACTOR_DEATHS = 10  # consecutive actors that die during start-up, as on nodes without this package
_SHUTDOWN_TIMEOUT_S = 30.0  # maximum wait for a thread of Ray Data at shutdown
_RESUME_HINT = "Run the same command again to encode the missing frames"


@contextlib.contextmanager
def ray_engine(address: str) -> Iterator[Engine]:
    """Yield an engine that encodes on a Ray cluster; Ray is shut down when the context ends.

    Args:
        address: Address of the cluster, as for `ray.init`; empty: Ray is started on this machine.

    Raises:
        UnreachableError: Ray is not installed, or there is no cluster at the address.
    """
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    if address:
        os.environ.setdefault("RAY_NUM_REDIS_GET_RETRIES", "1")  # an unreachable address fails in 40 s, not 13 min
    where = f"--engine ray={address}" if address else "--engine ray"
    ray = require_library("ray", where=where, called="Ray, which shares work on a cluster", extra="cluster")
    require_library("ray.data", where=where, called="Ray Data, which shares work on a cluster", extra="cluster")
    options: dict[str, Any] = {"address": address} if address else {"address": "local", "include_dashboard": False}
    try:
        ray.init(**options, logging_level=logging.ERROR, log_to_driver=False)
    except (OSError, RuntimeError, ValueError) as error:
        problem = f"cannot connect to a Ray cluster ({error})"
        raise UnreachableError(
            where=where, found=problem, fix="Run `ray status` on the head node to check the address"
        ) from None
    try:
        yield partial(_encode, where)
    except (ray.exceptions.RayError, ray.data.exceptions.ExecutionTimeoutError) as error:
        raise UnreachableError(where=where, found=f"Ray failed ({error})", fix=_RESUME_HINT) from error
    finally:
        for thread in threading.enumerate():
            if thread.name == "iter_threaded":  # this thread of Ray Data would kill the process if Ray shut down first
                thread.join(_SHUTDOWN_TIMEOUT_S)
        ray.shutdown()


def _encode(
    where: str, config: Config, cache: LatentCache, missing: Sequence[FramesToEncode], reporter: Reporter
) -> None:
    """Encode the missing frames with one actor per GPU, or per CPU core on a cluster without GPUs.

    Actors may join later. If an actor dies, another actor encodes its episodes.

    Raises:
        InputError: As in `encode_share`, from any actor; or the config requires a GPU and the cluster has none; or an
            actor has other data, or cannot access the folder of the cache.
    """
    import ray

    devices = ray.cluster_resources()
    kind = "GPU" if config.training.device != "cpu" and devices.get("GPU") else "CPU"
    if kind == "CPU" and config.training.device == "cuda":
        raise InputError(where=f"training.device: cuda, {where}", found="the cluster has no GPU")
    begin_encoding(cache, missing, reporter)
    context, task_size = ray.data.DataContext.get_current(), max(1, min(_MAX_TASK_REQUESTS, len(missing) // _MIN_TASKS))
    context.enable_progress_bars = context.print_on_execution_start = False
    context.max_consecutive_actor_init_deaths = _MAX_ACTOR_DEATHS
    logging.getLogger("ray.data").setLevel(logging.ERROR)
    folder = cache.folder.absolute() if isinstance(cache.folder, Path) else cache.folder
    tasks = [{"task": _Task(missing[first : first + task_size])} for first in range(0, len(missing), task_size)]
    results = ray.data.from_items(tasks, override_num_blocks=len(tasks)).map(
        _Actor,
        fn_constructor_args=(config_as_dict(config), folder, Path.cwd()),
        compute=ray.data.ActorPoolStrategy(min_size=1, initial_size=max(1, int(devices.get(kind, 1)))),
        num_cpus=int(kind == "CPU"),
        num_gpus=int(kind == "GPU"),
    )
    progress, num_encoded, total = reporter.task("encoding frames", "frames"), 0, count_frames(missing)
    progress(num_encoded, total)
    for row in results.iter_rows():
        result: _Result = row["result"]
        if result.error is not None:
            raise result.error
        for name, reason in result.broken.items():
            cache.dataset.broken.record(name, reason)
        num_encoded += result.frames
        progress(num_encoded, total)
    require_shared(cache, lambda: not cache.missing())


@dataclass(frozen=True, eq=False)
class _Task:
    requests: Sequence[FramesToEncode]


@dataclass(frozen=True, eq=False)
class _Result:
    frames: int  # number of frames of the task
    broken: Mapping[str, str]  # reason of each broken episode that the actor has found so far, by identity
    error: Exception | None = None  # not raised, because Ray would wrap it and might retry the task


class _Actor:
    """A worker that encodes on one device; it opens the data and loads the model at the first task."""

    def __init__(self, config: Mapping[str, Any], folder: Path | str, working_directory: Path) -> None:
        self._config, self._folder, self._working_directory = config, folder, working_directory

    @cached_property
    def _opened(self) -> tuple[LatentCache, EncoderOnDevice]:
        with contextlib.suppress(OSError):  # if this node lacks the folder, opening the data reports missing files
            os.chdir(self._working_directory)
        config = parse_config(self._config, where="the config")
        cache, model = open_cache(config, self._folder)
        require_shared(cache, lambda: cache.is_begun)
        return cache, EncoderOnDevice.from_model(config, model, select_device(config.training))

    def __call__(self, row: Mapping[str, Any]) -> dict[str, _Result]:
        requests = row["task"].requests
        try:
            cache, encoder = self._opened
            # An actor that died may have written some of the files.
            missing = [request for request in requests if not cache.files.has_file(request.episode, request.camera)]
            encode_files(cache.dataset, missing, encoder, cache.files)
        except Exception as error:
            error.add_note(traceback.format_exc())
            return {"result": _Result(0, {}, error)}
        return {"result": _Result(count_frames(requests), cache.dataset.broken.reasons)}
