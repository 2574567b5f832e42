"""What may not stand in one column: other data, protocols or code, and one seed twice."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

from gsgan.report.scored import Run
from gsgan.report.spec import FLOOR, PAINTED
from gsgan.utils.errors import ConfigError

# dB of an all-background picture: the same on every device, less rounding.
FLOOR_TOLERANCE = 1e-3
# Of a protocol, what differs between the subjects of one table.
PER_SUBJECT = ("subject", "train_frames", "test_frames")


def refuse_twice(runs: Sequence[Run]) -> None:
    """One run for each row, seed and subject.

    Raises:
        ConfigError: naming both runs.
    """
    for first, run in combinations(runs, 2):
        alike = (first.name, first.seed) == (run.name, run.seed)
        if alike and same_data(first, run) is not False:
            raise ConfigError(
                f"{first.said} and {run.folder} are one row's same seed; give one of them"
            )


def refuse_other_settings(runs: Sequence[Run], split: str, table: str) -> None:
    """Seeds of one row are of one thing: a mean of two would be of neither.

    Raises:
        ConfigError: naming two runs and a setting in which they differ.
    """
    where = f"{table}, {split}"
    for first, run in combinations(runs, 2):
        if (first.seed is None) != (run.seed is None):
            raise _mixture(where, first, run, "are a model trained here and a method's predictions")
        known = first.settings is not None and run.settings is not None
        changed = differing(first.settings or {}, run.settings or {}) if known else []
        if changed:
            shown = ", ".join(changed[:3]) + (" …" if len(changed) > 3 else "")
            raise _mixture(where, first, run, f"differ in more than the seed: {shown}")
        done = [r.facts.get("iterations") for r in (first, run)]
        if None not in done and done[0] != done[1]:
            raise _mixture(where, first, run, f"trained {done[0]} and {done[1]} iterations")
        marks = [(r.of(split, PAINTED) or {}).get("marks") for r in (first, run)]
        if None not in marks and marks[0] != marks[1]:
            told = " and ".join("; ".join(m or ["unmarked"]) for m in marks)
            raise _mixture(where, first, run, f"carry other marks: {told}")


def refuse_mixture(
    runs: Sequence[Run], split: str, table: str, *, allow_dirty: bool, subjects: bool = False
) -> None:
    """Whether the runs of one column may stand there together.

    Args:
        runs: all of the column's.
        split: whose scores it shows.
        table: its name, for the sentence.
        allow_dirty: let runs of code with uncommitted changes stand beside others.
        subjects: the runs are of several subjects, for their mean: the data differ by design.

    Raises:
        ConfigError: naming two runs and what differs.
    """
    where = f"{table}, {split}"
    scored = [run for run in runs if _images(run, split)]
    for run in scored[1:]:
        first = scored[0]
        if not subjects:
            _refuse_other_data(first, run, split, where)
        if told := protocols_differ(first, run, split, subjects=subjects):
            raise _mixture(where, first, run, f"were scored by other protocols: {told}")
        _refuse_other_lpips(scored[: scored.index(run)], run, split, where)
    if not allow_dirty:
        clean = next((run for run in scored if run.facts.get("dirty") is False), None)
        dirty = next((run for run in scored if run.facts.get("dirty")), None)
        if clean and dirty:
            raise _mixture(
                where, clean, dirty, "are of a commit and of uncommitted changes "
                "(allow_dirty=true lets them stand together)",
            )  # fmt: skip


def same_data(a: Run, b: Run) -> bool | None:
    """Whether two runs are of the same data and split; None where their folders cannot tell."""
    if a.data.get("name") != b.data.get("name"):
        return False
    prints = [run.data.get("fingerprint") for run in (a, b)]
    if None not in prints:
        return prints[0] == prints[1]
    roots = [run.data.get("root") for run in (a, b)]
    if None not in roots and roots[0] != roots[1]:
        return False
    settings = [run.data_settings() for run in (a, b)]
    if settings[0] is None or settings[1] is None:
        return None
    return not differing(settings[0], settings[1])


def protocols_differ(a: Run, b: Run, split: str, *, subjects: bool = False) -> str:
    """In what two runs' protocols differ, or an empty text."""
    records = [run.protocol_record(split) or {"name": None} for run in (a, b)]
    names = [record["name"] for record in records]
    if names[0] != names[1]:
        return f"{names[0] or 'none'} and {names[1] or 'none'}"
    keys = differing(*records)
    if subjects:
        keys = [key for key in keys if key not in PER_SUBJECT]
    return f"{names[0]}, with other {', '.join(keys)}" if keys else ""


def differing(a: dict[str, Any], b: dict[str, Any]) -> list[str]:
    """Keys whose values differ; one that a run of an older config lacks is null there."""
    return sorted(key for key in a.keys() | b.keys() if a.get(key) != b.get(key))


def _refuse_other_data(first: Run, run: Run, split: str, where: str) -> None:
    same = same_data(first, run)
    if same is None:
        raise _mixture(where, first, run, "cannot be shown to be of the same data (facts.json is "
                       "missing: gsgan.evaluate writes it)")  # fmt: skip
    if not same:
        names = [data_name(r) for r in (first, run)]
        told = f"{names[0]} and {names[1]}"
        if names[0] == names[1]:
            what = "cameras, frames, split, picture size, crop or fitted landmarks"
            told = f"two sets of {names[0]} ({what})"
        raise _mixture(where, first, run, f"are of different data: {told}")
    counts = [_images(r, split) for r in (first, run)]
    if counts[0] != counts[1]:
        raise _mixture(where, first, run, f"were scored on {counts[0]} and {counts[1]} pictures")
    low, high = ((r.of(split, FLOOR) or {}).get("psnr") for r in (first, run))
    if low is not None and high is not None and abs(low - high) > FLOOR_TOLERANCE:
        raise _mixture(
            where, first, run, "were scored against different pictures: an all-background "
            f"picture has {low:.3f} and {high:.3f} dB",
        )  # fmt: skip


def _refuse_other_lpips(before: Sequence[Run], run: Run, split: str, where: str) -> None:
    for first in before:
        names = {r.folder: lpips_name(r, split) for r in (first, run)}
        if None not in names.values() and len(set(names.values())) > 1:
            raise _mixture(where, first, run, f"have {' and '.join(map(str, names.values()))}")


def lpips_name(run: Run, split: str) -> str | None:
    """Backbone and range of a run's LPIPS, where it has one."""
    scores = run.scores.get(split, {}).values()
    return next((s.get("lpips_name") for s in scores if s.get("lpips") is not None), None)


def data_name(run: Run) -> str:
    """The data set in a word or two."""
    root = run.data.get("root")
    name = str(run.data.get("name") or "unknown")
    return f"{name}, {root}" if root else name


def _images(run: Run, split: str) -> int:
    return max((int(v["images"]) for v in run.scores.get(split, {}).values()), default=0)


def _mixture(where: str, a: Run, b: Run, what: str) -> ConfigError:
    return ConfigError(f"table {where}: {a.said} and {b.said} {what}; leave one out of runs")
