"""Run folders written by hand: known scores, real files."""

import json
from pathlib import Path
from typing import Any

from gsgan.metrics.names import METRICS
from gsgan.report.paper import read_paper
from gsgan.report.runs import find_runs, read_runs
from gsgan.report.spec import TableSpec
from gsgan.report.table import build
from gsgan.report.write import Grid, Report, Row

FLOOR = {
    "psnr": 15.5,
    "ssim": 0.8,
    "miou_reason": "an all-background image has no parts",
}
NO_LPIPS = "left out by lpips.nets"


def variant(images: int = 3, **held: Any) -> dict[str, Any]:
    """Scores of one variant; a metric that is not given is null."""
    scores: dict[str, Any] = dict.fromkeys(METRICS)
    scores |= {
        "lpips_vgg_reason": NO_LPIPS,
        "images": images,
        "marks": [],
        "cameras": {},
    }
    return scores | held


def protocol(name: str, **held: Any) -> dict[str, Any]:
    """A protocol's record, as it stands beside scores."""
    return {
        "name": name,
        "subject": None,
        "scale": 0.5,
        "departures": [],
        **held,
    }


def write_run(
    folder: Path,
    model: str | None = "full",
    seed: int | None = 0,
    *,
    splits: tuple[str, ...] = ("novel_pose",),
    record: dict[str, Any] | None = None,
    data: dict[str, Any] | None = None,
    facts: dict[str, Any] | None = None,
    splat: dict[str, Any] | None = None,
    floor: dict[str, Any] | None = None,
    images: int = 3,
    **scores: Any,
) -> Path:
    """A scored run folder with ``metrics.json`` and ``facts.json``."""
    variants = {
        "full": variant(images, protocol=record, **scores),
        "floor": variant(images, protocol=record, **(FLOOR | (floor or {}))),
    }
    if splat is not None:
        variants["splat"] = variant(images, protocol=record, **splat)
    held = {
        "version": "0.1.0", "commit": "abc123", "dirty": False, "method": "gsgan",
        "date": "2026-11-21T07:00:00+00:00", "model": model, "protocol": record and record["name"],
        "data": data or {"name": "synthetic", "root": "person", "fingerprint": "f00d"},
        "seed": seed, "iterations": 7000, "train_seconds": 600.0, "device": "cpu", "torch": "2",
    }  # fmt: skip
    folder.mkdir(parents=True)
    (folder / "metrics.json").write_text(
        json.dumps(dict.fromkeys(splits, variants))
    )
    (folder / "facts.json").write_text(json.dumps(held | (facts or {})))
    return folder


def zju(subject: int) -> dict[str, Any]:
    """Data facts of a subject of ZJU-MoCap."""
    return {
        "name": "zju_mocap",
        "root": f"CoreView_{subject}",
        "fingerprint": f"f{subject}",
    }


def report_of(
    spec: TableSpec, *folders: Path, allow_dirty: bool = False
) -> Report:
    """The table of run folders."""
    runs, out = read_runs(find_runs([str(folder) for folder in folders]))
    paper = None if spec.paper is None else read_paper(spec.paper)
    return build(spec, runs, out, paper, allow_dirty=allow_dirty)


def table(**held: Any) -> TableSpec:
    """A small table: PSNR and LPIPS on held-out poses."""
    given = {
        "name": "t",
        "title": "T",
        "metrics": ["psnr", "lpips_vgg"],
        "splits": ["novel_pose"],
    }
    return TableSpec(**(given | held))


def row(grid: Grid, label: str) -> Row:
    """The row with this label."""
    return next(row for row in grid.rows if row.label == label)


def texts(row: Row) -> list[str]:
    """A row's cells."""
    return [cell.text for cell in row.cells]
