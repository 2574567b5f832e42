"""Held-out PSNR against seconds of training, read from the logs of runs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from gsgan.utils.errors import DataError

COLUMNS = ["val/seconds", "val/psnr", "val/psnr_splat", "step"]


@dataclass(frozen=True)
class Curve:
    """One training.

    Args:
        label: name of the run.
        seconds: of training until each validation, rising.
        psnr: dB, mean over the validation images.
        colour: dB, of Step I's colour; empty where the log lacks it.
    """

    label: str
    seconds: tuple[float, ...]
    psnr: tuple[float, ...]
    colour: tuple[float, ...] = ()


def curve(label: str, run: Path) -> Curve | None:
    """The curve of a run folder, its resumed parts joined; None where its logs hold none.

    A resumed part repeats the iterations after its checkpoint: the later part counts, from the
    iteration in its folder's name and from its first validation on.

    Raises:
        DataError: when a log cannot be read.
    """
    whole = pd.DataFrame(columns=COLUMNS, dtype=float)
    for log in sorted(run.glob("logs*/metrics.csv"), key=lambda path: path.parent.name):
        part = _validations(log)
        if len(part):
            start = log.parent.name.rpartition("_")[2]  # of logs_000250, the first iteration
            earlier = whole.step < (float(start) if start.isdecimal() else math.inf)
            earlier &= whole["val/seconds"] < part["val/seconds"].iloc[0]
            whole = pd.concat([whole[earlier], part])
    if len(whole) < 2:
        return None
    seconds, psnr, colour = (tuple(whole[name].tolist()) for name in COLUMNS[:3])
    return Curve(label, seconds, psnr, () if whole["val/psnr_splat"].isna().any() else colour)


def _validations(log: Path) -> pd.DataFrame:
    """Each validation; an incomplete last line is skipped."""
    try:
        table = pd.read_csv(log, on_bad_lines="skip", dtype=str).reindex(columns=COLUMNS)
        complete = log.read_text(encoding="utf-8").endswith("\n")
    except (OSError, UnicodeError, ValueError) as error:
        raise DataError(
            f"{log}: not a readable log of a training ({type(error).__name__}); remove it to go on "
            "without it"
        ) from error
    table = table.apply(pd.to_numeric, errors="coerce").iloc[: None if complete else -1]
    return table.dropna(subset=COLUMNS[:2]).fillna({"step": 0.0})
