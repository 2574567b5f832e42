"""``python -m gsgan.bench stability``: the float32 error of every hard case."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from omegaconf import DictConfig
from rich.progress import track

from gsgan.bench.cases.case import compare_all
from gsgan.bench.common import Bench, markdown, number, records, sentence
from gsgan.utils.errors import GsganError


def run(config: DictConfig, folder: Path) -> None:
    """Runs every case, writes ``stability.md``, ``.csv`` and ``.json``.

    Args:
        config: as conf/bench_stability.yaml.
        folder: where they go.

    Raises:
        GsganError: when a case gets another status than expected, after all is written.
    """
    bench = Bench.start("stability", config, folder, "stability")
    rows = compare_all(bench.device)
    frame = pd.DataFrame(list(track(rows, "comparing", console=bench.console, transient=True)))
    bench.write(
        "Hard cases: float32 against float64",
        f"{sentence(bench.where)}.\n\n{page(frame)}",
        {"rows": records(frame)},
        frame,
        docs=summary(frame, bench.where),
    )
    for status, count in frame.status.value_counts().items():
        bench.console.print(f"{count:5d} {status}", highlight=False)
    bad = frame[frame.status != frame.expected]
    if len(bad):
        first = bad.iloc[0]
        raise GsganError(
            f"{len(bad)} of {len(frame)} cases have another status than expected, first "
            f"{first.case} ({first.backend}): expected {first.expected}, got {first.status}"
        )


def page(frame: pd.DataFrame) -> str:
    """Every case on every backend, Markdown."""
    shown = frame.drop(columns="expected").rename(columns=lambda name: name.replace("_", " "))
    for name in ("value error", "gradient error"):
        shown[name] = [number(error, 2) for error in shown[name]]
    return markdown(shown)


def summary(frame: pd.DataFrame, where: Mapping[str, Any]) -> str:
    """One line per case for the docs, the worst of its backends, a table per subject; Markdown."""
    parts = [sentence(where) + "."]
    for subject, cases in frame.groupby("subject", sort=False):
        lines = [_by_case(name, rows) for name, rows in cases.groupby("case", sort=False)]
        parts += [f"### {subject[:1].upper()}{subject[1:]}", markdown(pd.DataFrame(lines))]
    return "\n\n".join(parts)


def _by_case(name: str, rows: pd.DataFrame) -> dict[str, str]:
    """One case on all its backends; those with another status than the first are named."""
    first = rows.iloc[0]
    others = rows[rows.status != first.status]
    named = [f"{row.backend}: {row.status}" for row in others.itertuples()]
    return {
        "case": name,
        "value error": number(rows.value_error.max(), 2),
        "gradient error": number(rows.gradient_error.max(), 2),
        "status": ", ".join([first.status, *named]),
        "note": first.note,
    }
