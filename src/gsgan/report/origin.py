"""Where rows come from: seeds, data, protocol, commit; marks; and the list of all runs."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from gsgan.report.grid import NO_RUN, Cell, Grid, Row, common
from gsgan.report.mixing import data_name, differing
from gsgan.report.scored import Run

UNKNOWN = "unknown"
MOST_SETTINGS = 6  # named in a note
HEADER = (
    "row", "seed", "data", "fingerprint", "protocol", "commit", "version", "iterations",
    "trained", "device", "torch", "date",
)  # fmt: skip


def provenance(runs: Sequence[Run], counts: Collection[int]) -> tuple[str, ...]:
    """A row's ``PROVENANCE``.

    Args:
        runs: that it shows.
        counts: of seeds, one a column.
    """
    if not runs:
        return ("0", NO_RUN, NO_RUN, NO_RUN)
    seeds = " to ".join(map(str, dict.fromkeys((min(counts), max(counts))))) if counts else ""
    data = common(map(data_name, runs))
    roots = {run.data.get("root") for run in runs}
    if len(roots) > 1:
        data = f"{runs[0].data['name']}, {len(roots)} subjects"
    return (seeds, data, common(run.protocol or "none" for run in runs), common(map(commit, runs)))


def commit(run: Run) -> str:
    """The code a run is of."""
    name = run.facts.get("commit")
    if not name:
        return UNKNOWN
    short = name[:9] if len(name) == 40 else name
    return f"{short} + changes" if run.facts.get("dirty") else str(short)


def marks(runs: Sequence[Run], split: str) -> tuple[str, ...]:
    """Marks and departures that a row must carry."""
    found: dict[str, None] = {}
    for run in runs:
        for scores in run.scores.get(split, {}).values():
            found |= dict.fromkeys(f"marked: {mark}" for mark in scores.get("marks", []))
        if record := run.protocol_record(split):
            for told in record.get("departures", []):
                found[f"departs from {record['name']}: {told}"] = None
    return tuple(found)


def changes(runs: Sequence[Run], reference: Sequence[Run], name: str) -> tuple[str, ...]:
    """In which settings a row differs from the reference: an ablation in a part, or in more."""
    if not runs or not reference or runs[0].name == reference[0].name:
        return ()
    mine, theirs = runs[0].settings, reference[0].settings
    if mine is None or theirs is None:
        return ()
    found = list(dict.fromkeys(_part(key) for key in differing(theirs, mine)))
    told = ", ".join(found[:MOST_SETTINGS]) + (" …" if len(found) > MOST_SETTINGS else "")
    return (f"{runs[0].name} differs from {name} in {told or 'no setting'}",)


def _part(key: str) -> str:
    """A part of the model as a whole, other settings in full."""
    return ".".join(key.split(".")[:2]) if key.startswith("model.") else key


def runs_grid(runs: Sequence[Run], names: Mapping[Path, str]) -> Grid:
    """One row a run, its folder by the name given."""
    rows = []
    for run in runs:
        facts = run.facts
        seconds = facts.get("train_seconds")
        texts = [
            run.name, run.seed, data_name(run), run.data.get("fingerprint"),
            run.protocol or "none", commit(run), facts.get("version"), facts.get("iterations"),
            None if seconds is None else f"{seconds / 60:.1f} min",
            facts.get("device"), facts.get("torch"), facts.get("date"),
        ]  # fmt: skip
        cells = [Cell(UNKNOWN if text is None else str(text)) for text in texts]
        rows.append(Row(names[run.folder], cells))
    return Grid("Runs", HEADER, rows, first="folder", words=True)


def names_of(folders: Sequence[Path]) -> dict[Path, str]:
    """Folders as short as tells them apart: from below what all of them share."""
    if not folders:
        return {}
    shared = os.path.commonpath([folder.parent for folder in folders])
    return {folder: os.path.relpath(folder, shared) for folder in folders}
