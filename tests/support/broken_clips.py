"""Run the command line so that the third and the fourth held-out clip cannot be read.

If processes share seven clips in batches of two or three, these clips are at the boundary of a process's share.
"""

import sys
from unittest import mock

from vjepa2_ac.cli import main
from vjepa2_ac.data import loader
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation import evaluate_run
from vjepa2_ac.training import validation

if __name__ == "__main__":
    broken: set[tuple[int, int]] = set()
    choose, read = loader.validation_windows, loader.read_clip

    def choose_and_break(*args: object, **kwargs: object) -> object:
        windows = choose(*args, **kwargs)  # type: ignore[arg-type]
        broken.update(windows[2:4])
        return windows

    def read_unless_broken(dataset: loader.Dataset, request: loader.ClipRequest) -> object:
        if (request.episode, request.start) in broken:
            raise InputError(where="a clip", found="its image is damaged")
        return read(dataset, request)

    with (
        mock.patch.object(evaluate_run, "validation_windows", choose_and_break),
        mock.patch.object(validation, "validation_windows", choose_and_break),
        mock.patch.object(loader, "read_clip", read_unless_broken),
    ):
        sys.exit(main(sys.argv[1:]))
