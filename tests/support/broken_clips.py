"""The command line, for which the third and the fourth of all held-out clips are broken.

The parts of processes that share seven clips, in batches of two or three, begin or end there.
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

    def chosen(*given: object, **named: object) -> object:
        found = choose(*given, **named)  # type: ignore[arg-type]
        broken.update(found[2:4])
        return found

    def some_read(dataset: loader.Dataset, wish: loader.ClipRequest) -> object:
        if (wish.episode, wish.start) in broken:
            raise InputError(where="a clip", found="its image is damaged")
        return read(dataset, wish)

    with (
        mock.patch.object(evaluate_run, "validation_windows", chosen),
        mock.patch.object(validation, "validation_windows", chosen),
        mock.patch.object(loader, "read_clip", some_read),
    ):
        sys.exit(main(sys.argv[1:]))
