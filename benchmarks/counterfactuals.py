"""Does the imagined hand move to the true side under actions that were not taken? Per axis, chance beside it.

    python benchmarks/counterfactuals.py demo/run demo/decoder               # a minute or two after `make demo`
    python benchmarks/counterfactuals.py demo/run demo/decoder --starts 48 --json counterfactuals.json

Of simulated data only: the simulator carries out the same actions from the same held-out starts. See
`vjepa2_ac.simulation.counterfactual_sides` for what is counted. Cells of one episode are alike, so the intervals
(Wilson, of independent cells) are somewhat too narrow.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from vjepa2_ac.simulation.counterfactual_sides import AXES, CHANCE, LEAST_PX, Sides, SidesOptions, measure_sides
from vjepa2_ac.storage import write_atomically


def rows(found: Sides) -> Iterator[dict[str, Any]]:
    """Yield a row for each source, axis and model step."""
    steps = len(found.cells[0].true_px) if found.cells else 0
    for source in found.sources:
        for axis in (*AXES, None):
            for step in range(steps):
                side = found.of(source, axis, step)
                share = side.share
                yield {
                    "source": source,
                    "axis": axis or "all",
                    "step": step + 1,
                    "right": side.right,
                    "cells": side.cells,
                    "left_out": side.left_out,
                    "share": None if share is None else share.as_dict(),
                    "chance": CHANCE,
                }


def table(found: Sides) -> str:
    """Return the rows as Markdown."""
    lines = ["| source | axis | after step | to the true side | cells | left out | chance |", "|---" * 7 + "|"]
    for row in rows(found):
        share = row["share"]
        text = "none" if share is None else f"{share['value']:.2f} [{share['low']:.2f}, {share['high']:.2f}]"
        cells = (row["source"], row["axis"], row["step"], text, row["cells"], row["left_out"], row["chance"])
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    frames, episodes = found.probe_fitted_on
    lines.append("")
    lines.append(
        f"Images of {found.image_px} px; left out where the hand truly moves by less than {LEAST_PX:g} px; the probe"
        f" was fitted on {frames} true frames of {episodes} training episodes."
    )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("subject", help="folder of a run on simulated data")
    parser.add_argument("decoder", help="folder of a decoder")
    parser.add_argument("--starts", type=int, default=24)
    parser.add_argument("--steps", type=int, default=3, help="model steps")
    parser.add_argument("--json", type=Path, help="write the rows there, too")
    options = parser.parse_args(arguments)
    found = measure_sides(options.subject, SidesOptions(options.decoder, options.starts, options.steps))
    if options.json:
        write_atomically(options.json, json.dumps(list(rows(found)), indent=1).encode())
    print(table(found))


if __name__ == "__main__":
    main()
