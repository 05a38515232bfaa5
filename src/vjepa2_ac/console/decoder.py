"""Console output of the training of a decoder."""

from __future__ import annotations

import math

from rich.table import Table

from vjepa2_ac.console.progress import MetricsTable, with_interval
from vjepa2_ac.decoding.decoder_folder import DecoderCard
from vjepa2_ac.intervals import Estimate

_ROWS = {"decoder": "decoder", "linear": "linear decoder", "mean_image": "mean image"}


def held_out_table(card: DecoderCard) -> Table:
    """Return a table of how well the decoder shows frames of held-out episodes, beside what needs no network."""
    held_out = card.held_out
    table = MetricsTable(
        f"{held_out['frames']:,} frames of {held_out['episodes']:,} held-out episodes (95 % interval over episodes)",
        ["", "PSNR, dB", "SSIM"],
    )
    for name, label in _ROWS.items():
        psnr, ssim = (_estimate(held_out[name][metric]) for metric in ("psnr_db", "ssim"))
        table.add_row(label, with_interval(psnr, ".1f"), with_interval(ssim, ".3f"))
    return table


def _estimate(values: dict[str, float | None]) -> Estimate:
    return Estimate(*(math.nan if values[name] is None else float(values[name]) for name in ("value", "low", "high")))  # type: ignore[arg-type]
