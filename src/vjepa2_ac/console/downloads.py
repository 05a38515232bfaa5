"""Console output of download: the published checkpoints as a table, and what one of them is."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.table import Table

from vjepa2_ac.model.checkpoints.published import Published

_MILLION = 10**6
_COLUMNS = ("holds", "family", "encoder", "pixels", "file", "licence", "encoder's key")


def published_table(published: Sequence[Published]) -> Table:
    """Return a table with a row for each published checkpoint; names are not divided, however narrow it is."""
    table = Table(box=box.SIMPLE_HEAD, title="Published checkpoints", title_justify="left")
    table.add_column("name", no_wrap=True, min_width=max(len(one.name) for one in published))
    for column in _COLUMNS:
        table.add_column(column, overflow="fold")
    for one in published:
        table.add_row(
            one.name,
            one.holds,
            one.family,
            f"{one.encoder.name}, {one.encoder_parameters / _MILLION:,.0f} M",
            str(one.image_size),
            one.size,
            one.licence,
            one.key,
        )
    return table


def published_notes(published: Sequence[Published]) -> list[str]:
    """Return what the table does not say, a line each."""
    encoders = (
        "Beside an encoder: its parameters, and the key of its weights in the file; pixels are those of its images."
    )
    lines = [encoders, "The licence is that of Meta's repository. Sizes with 'about' are estimates."]
    if not any(one.sha256 for one in published):
        lines.append("No SHA-256 of these files is known: what is checked is the size.")
    return lines


def published_summary(one: Published, url: str) -> str:
    """Return what a checkpoint is, its size and licence, and where it comes from; shown before it is fetched."""
    parts = (
        "encoder and action-conditioned predictor" if one.holds == "world model" else "without a predictor for actions"
    )
    checked = "size and SHA-256 are checked" if one.sha256 else "its size is checked, for no SHA-256 is known"
    return (
        f"{one.name}: {one.holds}, {parts}; V-JEPA {one.family.removeprefix('v')}, {one.encoder.name},"
        f" {one.image_size} px\n{one.size}, licence {one.licence}; from {url}; {checked}"
    )
