"""Does the imagined hand move to the true side under actions that were not taken, and does the gripper? Chance beside.

    python benchmarks/counterfactuals.py demo/run demo/decoder               # a minute or two after `make demo`
    python benchmarks/counterfactuals.py demo/run demo/decoder --starts 48 --json counterfactuals.json
    python benchmarks/counterfactuals.py demo/pick-run demo/pick-decoder --of gripper --starts 64

Of simulated data only: the simulator carries out the same actions from the same held-out starts. See
`counterfactual_probes` for what is counted. Cells of one episode are alike, so
the intervals of shares (Wilson, of independent cells) are somewhat too narrow; those of `extent` are over episodes.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from counterfactual_probes import (
    ACTIONS,
    AXES,
    CHANCE,
    LEAST_CLOSEDNESS,
    LEAST_PX,
    GripperSides,
    Sides,
    SidesOptions,
    measure_gripper,
    measure_sides,
)

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
        text = with_interval(share)
        cells = (row["source"], row["axis"], row["step"], text, row["cells"], row["left_out"], row["chance"])
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    frames, episodes = found.probe_fitted_on
    lines.append("")
    lines.append(
        f"Images of {found.image_px} px; left out where the hand truly moves by less than {LEAST_PX:g} px; the probe"
        f" was fitted on {frames} true frames of {episodes} training episodes."
    )
    return "\n".join(lines)


def gripper_rows(found: GripperSides) -> Iterator[dict[str, Any]]:
    """Yield a row for each source, action and model step; the action stands where the others have an axis."""
    steps = len(found.cells[0].true) if found.cells else 0
    for source in found.sources:
        for action in (*ACTIONS, None):
            for step in range(steps):
                side, extent = found.of(source, action, step), found.extent(source, action, step)
                share, latent = side.share, found.extent_in_latents(source, action, step)
                yield {
                    "source": source,
                    "axis": action or "gripper",
                    "step": step + 1,
                    "right": side.right,
                    "cells": side.cells,
                    "left_out": side.left_out,
                    "share": None if share is None else share.as_dict(),
                    "chance": CHANCE,
                    "extent": None if extent is None else extent.as_dict(),
                    "extent_in_latents": None if latent is None else latent.as_dict(),
                }


def gripper_table(found: GripperSides) -> str:
    """Return the rows as Markdown."""
    titles = (
        "source",
        "action",
        "after step",
        "to the true side",
        "cells",
        "left out",
        "chance",
        "extent",
        "in latents",
    )
    lines = ["| " + " | ".join(titles) + " |", "|---" * len(titles) + "|"]
    for row in gripper_rows(found):
        share, *extents = (with_interval(row[name]) for name in ("share", "extent", "extent_in_latents"))
        cells = (row["source"], row["axis"], row["step"], share, row["cells"], row["left_out"], row["chance"], *extents)
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    frames, episodes = found.probe_fitted_on
    lines.append("")
    lines.append(
        f"Images of {found.image_px} px; differences to `none`; left out where the true closedness differs by less than"
        f" {LEAST_CLOSEDNESS:g}; extent: what is read over what is true; in latents: along the true difference; the"
        f" probe was fitted on {frames} true frames of {episodes} training episodes."
    )
    for source, reading in found.readings.items():
        lines.append(
            f"Mean error of closedness, {source}: {reading.error:.3f}; of always saying the mean:"
            f" {reading.error_of_mean:.3f}."
        )
    return "\n".join(lines)


def with_interval(estimate: dict[str, float | None] | None) -> str:
    """Return an estimate as text."""
    if estimate is None or estimate["value"] is None:
        return "none"
    if estimate["low"] is None:
        return f"{estimate['value']:.2f}"
    return f"{estimate['value']:.2f} [{estimate['low']:.2f}, {estimate['high']:.2f}]"


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("subject", help="folder of a run on simulated data")
    parser.add_argument("decoder", help="folder of a decoder")
    parser.add_argument("--starts", type=int, default=24)
    parser.add_argument("--steps", type=int, default=3, help="model steps")
    parser.add_argument("--of", choices=("hand", "gripper", "both"), default="both", help="what is counted")
    parser.add_argument("--json", type=Path, help="write the rows there, too")
    options = parser.parse_args(arguments)
    asked, found, tables = SidesOptions(options.decoder, options.starts, options.steps), [], []
    if options.of != "gripper":
        sides = measure_sides(options.subject, asked)
        found, tables = [*rows(sides)], [table(sides)]
    if options.of != "hand":
        gripper = measure_gripper(options.subject, asked)
        found, tables = [*found, *gripper_rows(gripper)], [*tables, gripper_table(gripper)]
    if options.json:
        write_atomically(options.json, json.dumps(found, indent=1).encode())
    print("\n\n".join(tables))


if __name__ == "__main__":
    main()
