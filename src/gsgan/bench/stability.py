"""``python -m gsgan.bench stability``: the float32 error of every hard case."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from rich.progress import track

from gsgan.bench.cases import Row, verdicts
from gsgan.bench.environment import Environment, environment
from gsgan.bench.tables import csv_text, fill_block, markdown, number
from gsgan.utils.console import make_console
from gsgan.utils.devices import pick_device
from gsgan.utils.errors import GsganError
from gsgan.utils.files import write_atomically

HEADER = (
    "case", "subject", "backend", "value error", "gradient error", "worst input", "verdict", "note",
)  # fmt: skip
BY_CASE = ("case", "value error", "gradient error", "verdict", "note")


def run(config: DictConfig, folder: Path) -> None:
    """Judges every case, writes ``stability.md``, ``.csv`` and ``.json``.

    Args:
        config: as conf/bench_stability.yaml.
        folder: where they go.

    Raises:
        GsganError: when a case gets another verdict than it is to get, after all is written.
    """
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    device, console = pick_device(config.device), make_console()
    where = environment(device)
    console.print(where.sentence(), highlight=False)
    shown = track(verdicts(device), "judging", console=console, transient=True)
    rows = list(shown)
    write(rows, where, folder)
    if config.docs is not None:
        fill_block(Path(config.docs), "stability", summary(rows, where))
    for verdict, count in Counter(row.verdict for row in rows).most_common():
        console.print(f"{count:5d} {verdict}", highlight=False)
    console.print(f"tables and raw numbers: {folder}", markup=False, highlight=False)
    bad = [row for row in rows if not row.as_expected]
    if bad:
        first = bad[0]
        raise GsganError(
            f"{len(bad)} of {len(rows)} verdicts are not the expected ones, first {first.case} "
            f"({first.backend}): expected {first.expected}, got {first.verdict}"
        )


def write(rows: Sequence[Row], where: Environment, folder: Path) -> None:
    """The three files, each whole or not at all."""
    records = [_plain(row) for row in rows]
    header = list(records[0]) if records else []
    write_atomically(folder / "stability.md", page(rows, where))
    write_atomically(
        folder / "stability.csv", csv_text(header, [list(record.values()) for record in records])
    )
    text = json.dumps({"where": where.as_dict(), "rows": records}, indent=1, allow_nan=False)
    write_atomically(folder / "stability.json", text)


def page(rows: Sequence[Row], where: Environment) -> str:
    """Every case on every backend, Markdown."""
    lines = [
        [
            row.case, row.subject, row.backend, _error(row.value_error),
            _error(row.gradient_error), row.worst_input, row.verdict, row.note,
        ]
        for row in rows
    ]  # fmt: skip
    title = "# Hard cases: float32 against float64"
    return f"{title}\n\n{where.sentence()}.\n\n{markdown(HEADER, lines)}\n"


def summary(rows: Sequence[Row], where: Environment) -> str:
    """One line a case for the docs, the worst of its backends, a table a subject; Markdown."""
    parts = [where.sentence() + "."]
    for subject in dict.fromkeys(row.subject for row in rows):
        cases = [row for row in rows if row.subject == subject]
        lines = [
            _by_case([row for row in cases if row.case == name])
            for name in dict.fromkeys(row.case for row in cases)
        ]
        parts += [f"### {subject[:1].upper()}{subject[1:]}", markdown(BY_CASE, lines)]
    return "\n\n".join(parts)


def _by_case(rows: Sequence[Row]) -> list[str]:
    """One case on all its backends; who got another verdict than the first is named."""
    first = rows[0]
    differing = [f"{row.backend}: {row.verdict}" for row in rows if row.verdict != first.verdict]
    verdict = first.verdict if not differing else ", ".join([first.verdict, *differing])
    values, gradients = (
        max((e for e in errors if not math.isnan(e)), default=math.nan)
        for errors in ([r.value_error for r in rows], [r.gradient_error for r in rows])
    )
    return [first.case, _error(values), _error(gradients), verdict, first.note]


def _error(value: float) -> str:
    return "∞" if value == math.inf else number(_known(value), 2)


def _plain(row: Row) -> dict[str, Any]:
    """By field, what cannot be had as None: JSON has no NaN."""
    fields = asdict(row)
    return {k: _known(v) if isinstance(v, float) else v for k, v in fields.items()}


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
