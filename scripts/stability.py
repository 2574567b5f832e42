"""Compares every numerically hard case of the tests in float32 with float64.

    python scripts/stability.py [--page docs/results/stability.md] [--out folder] [--device cuda]

Prints a table, writes ``stability.md``, ``.csv`` and ``.json`` into a folder, and a page of the
docs with one line per case. Ends with an error when a case gets another status than expected.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from omegaconf import OmegaConf
from rich.progress import track

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).resolve().parent / "bench"))

from bench_common import Bench, records
from stability.cases.case import compare_all

from gsgan.bench.common import markdown, number, sentence
from gsgan.utils.errors import GsganError
from gsgan.utils.files import write_atomically

ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--page", type=Path, help="a page of the docs to write")
    parser.add_argument(
        "--out", type=Path, default=Path("outputs/bench/stability")
    )
    parser.add_argument(
        "--device", default="auto", help="auto takes CUDA where there is one"
    )
    given = parser.parse_args()
    try:
        run(given.page, given.out, given.device)
    except GsganError as error:
        sys.exit(f"gsgan: {error}")


def run(page: Path | None, folder: Path, device: str = "auto") -> None:
    """Compares every case, writes the table.

    Args:
        page: a Markdown page that is written, or None.
        folder: of the files.
        device: ``auto`` or a torch device.

    Raises:
        ConfigError: on an unusable device.
        GsganError: when a case gets another status than expected, after all is written.
    """
    config = OmegaConf.create({"device": device, "threads": None, "docs": None})
    bench = Bench.start("stability", config, folder)
    rows = compare_all(bench.device)
    frame = pd.DataFrame(
        list(track(rows, "comparing", console=bench.console, transient=True))
    )
    bench.write(
        "Hard cases: float32 against float64",
        f"{sentence(bench.where)}.\n\n{table(frame)}",
        {"rows": records(frame)},
        frame,
    )
    if page is not None:
        write_atomically(page, whole_page(frame, bench.where))
    for status, count in frame.status.value_counts().items():
        bench.console.print(f"{count:5d} {status}", highlight=False)
    bad = frame[frame.status != frame.expected]
    if len(bad):
        first = bad.iloc[0]
        raise GsganError(
            f"{len(bad)} of {len(frame)} cases have another status than expected, first "
            f"{first.case} ({first.backend}): expected {first.expected}, got {first.status}"
        )


def table(frame: pd.DataFrame) -> str:
    """Every case on every backend, Markdown."""
    shown = frame.drop(columns="expected").rename(
        columns=lambda name: name.replace("_", " ")
    )
    for name in ("value error", "gradient error"):
        shown[name] = [number(error, 2) for error in shown[name]]
    return markdown(shown)


def whole_page(frame: pd.DataFrame, where: Mapping[str, Any]) -> str:
    """One line per case, the worst of its backends, a table per subject; Markdown."""
    describe = [
        "git",
        "describe",
        "--always",
        "--exclude=*",
        "--dirty= with changes",
    ]
    commit = subprocess.run(
        describe, cwd=ROOT, check=False, capture_output=True, text=True
    ).stdout
    parts = [
        "# Results: numerically hard cases",
        f"Commit: {commit.strip() or 'not recorded'}; machine and date: {sentence(where)}. "
        'Written by `make stability ARGS="--page docs/results/stability.md"`; '
        "[what it means](../rasteriser.md#hard-cases).",
    ]
    for subject, cases in frame.groupby("subject", sort=False):
        lines = [
            _by_case(name, rows)
            for name, rows in cases.groupby("case", sort=False)
        ]
        parts += [
            f"## {subject[:1].upper()}{subject[1:]}",
            markdown(pd.DataFrame(lines)),
        ]
    return "\n\n".join(parts) + "\n"


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


if __name__ == "__main__":
    main()
