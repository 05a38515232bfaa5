"""`torchrun … -m vjepa2_ac.cli …` with forked workers, which start faster than new Python processes."""

import sys

from torch.distributed.launcher.api import elastic_launch
from torch.distributed.run import config_from_args, parse_args

from vjepa2_ac.cli import main


def run() -> None:
    """Launch as torchrun does, with its own options and agent."""
    options = parse_args(sys.argv[1:])
    config, _, _ = config_from_args(options)
    config.start_method = "fork"
    elastic_launch(config, _as_a_process)(options.training_script_args)


def _as_a_process(words: list[str]) -> None:
    if status := main(words):
        sys.exit(status)


if __name__ == "__main__":
    run()
