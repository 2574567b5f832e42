"""Compares every numerically hard case of the tests in float32 with float64.

    python scripts/stability.py [--page docs/results/stability.md] [--out folder] [--device cuda]

Prints a table, writes ``stability.md``, ``.csv`` and ``.json`` into a folder, and a page of the
docs with a line per subject and those cases that are not right. Ends with an error when a case
gets another status than expected.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill, shorten
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
    """A row per subject, and a line per case that is not right on every backend; Markdown."""
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
    subjects, others = [], []
    for subject, rows in frame.groupby("subject", sort=False):
        cases = [case for _, case in rows.groupby("case", sort=False)]
        right = [case for case in cases if (case.status == "right").all()]
        subjects.append(_by_subject(subject, len(cases), right))
        others += [
            _by_case(case) for case in cases if (case.status != "right").any()
        ]

    parts = [
        "# Results: numerically hard cases",
        fill(
            f"Commit: {commit.strip() or 'not recorded'}; machine and date: {sentence(where)}.",
            width=100,
            break_on_hyphens=False,
        ),
        '```bash\nmake stability ARGS="--page docs/results/stability.md"\n```',
        "Float32 against float64, the worst of all backends; errors are those of cases that are "
        "right.\n`outputs/bench/stability` has a row for every case.\n"
        "[What a status means](../rasteriser.md#hard-cases).",
        markdown(pd.DataFrame(subjects)),
    ]
    if others:
        parts += [
            "## Cases with another status",
            markdown(pd.DataFrame(others)),
        ]
    return "\n\n".join(parts) + "\n"


def _by_subject(
    subject: str, count: int, right: Sequence[pd.DataFrame]
) -> dict[str, str]:
    """The number of cases of a subject, and the largest errors of those that are right."""
    rows = pd.concat(right) if right else None
    return {
        "subject": f"{subject[:1].upper()}{subject[1:]}",
        "cases": str(count),
        "right": str(len(right)),
        "value error": number(
            None if rows is None else rows.value_error.max(), 2
        ),
        "gradient error": number(
            None if rows is None else rows.gradient_error.max(), 2
        ),
    }


def _by_case(rows: pd.DataFrame) -> dict[str, str]:
    """One case on all its backends; those with another status than the first are named."""
    first = rows.iloc[0]
    others = rows[rows.status != first.status]
    named = [f"{row.backend}: {row.status}" for row in others.itertuples()]
    return {
        "case": first.case,
        "value error": number(rows.value_error.max(), 2),
        "gradient error": number(rows.gradient_error.max(), 2),
        "status": ", ".join([first.status, *named]),
        "note": shorten(first.note, width=90, placeholder=" …"),
    }


if __name__ == "__main__":
    main()
