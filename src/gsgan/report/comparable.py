"""Which runs may stand together in one row, one column or one figure."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import torch

from gsgan.report.runs import Run
from gsgan.report.spec import FLOOR, PAINTED
from gsgan.scene import Frame
from gsgan.utils.errors import ConfigError

FLOOR_TOLERANCE = 1e-3  # dB between all-background images of the same data, for rounding
PER_SUBJECT = ("subject", "train_frames", "test_frames")  # of a protocol, differ by subject
DATA = "cameras, frames, split, image size, crop or fitted landmarks"


def check_row(runs: Sequence[Run], split: str, where: str) -> None:
    """The runs of one row may differ in their seed only.

    Args:
        runs: of one row and data set.
        split: whose scores are shown.
        where: name of the table, for the message.

    Raises:
        ConfigError: naming two runs and what differs.
    """
    for a, b in combinations(runs, 2):
        if a.seed == b.seed:
            raise _refusal(where, a, b, "have the same row and seed")
        if (a.seed is None) != (b.seed is None):
            raise _refusal(where, a, b, "are a model trained here and a method's predictions")
        changed = differing(a.settings, b.settings) if a.settings and b.settings else []
        if changed:
            raise _refusal(where, a, b, f"differ in more than the seed: {', '.join(changed[:3])}")
        done = [run.facts.get("iterations") for run in (a, b)]
        if None not in done and done[0] != done[1]:
            raise _refusal(where, a, b, f"trained {done[0]} and {done[1]} iterations")
        marks = ["; ".join(run.of(split, PAINTED).get("marks", [])) for run in (a, b)]
        if marks[0] != marks[1]:
            text = " and ".join(mark or "unmarked" for mark in marks)
            raise _refusal(where, a, b, f"have different marks: {text}")


def check_column(
    runs: Sequence[Run], split: str, where: str, *, allow_dirty: bool, subjects: bool = False
) -> None:
    """The runs of one column must be of the same data, protocol and LPIPS.

    Args:
        runs: of the column; those without an image of the split are passed over.
        split: whose scores are shown.
        where: name of the table, for the message.
        allow_dirty: let runs of uncommitted code stand beside others.
        subjects: the column is a mean over subjects, whose data differ by design.

    Raises:
        ConfigError: naming two runs and what differs.
    """
    scored = [run for run in runs if run.images(split)]
    for run in scored[1:]:
        if not subjects:
            _check_images(scored[0], run, split, where)
        names = [r.protocol(split)["name"] for r in (scored[0], run)]
        keys = differing(*(r.protocol(split) for r in (scored[0], run)))
        if names[0] != names[1]:
            text = f"{names[0]} and {names[1]}"
            raise _refusal(where, scored[0], run, f"were scored by different protocols: {text}")
        if keys := [key for key in keys if not subjects or key not in PER_SUBJECT]:
            text = f"{names[0]} with different {', '.join(keys)}"
            raise _refusal(where, scored[0], run, f"were scored by different protocols: {text}")
    lpips = {name: run for run in scored if (name := lpips_name(run, split))}
    if len(lpips) > 1:
        first, second, *_ = lpips.values()
        raise _refusal(where, first, second, f"have {' and '.join(lpips)}")
    code = {bool(run.facts.get("dirty")): run for run in scored}
    if len(code) > 1 and not allow_dirty:
        what = "are of a commit and of uncommitted changes (allow_dirty=true allows both)"
        raise _refusal(where, code[False], code[True], what)


def check_data(a: Run, b: Run, where: str) -> None:
    """Two runs must be of the same data and splits.

    Raises:
        ConfigError: naming both.
    """
    if a.data.get("fingerprint") != b.data.get("fingerprint"):
        names = [run.data_name for run in (a, b)]
        text = " and ".join(names) if names[0] != names[1] else f"two sets of {names[0]} ({DATA})"
        raise _refusal(where, a, b, f"are of different data: {text}")


def check_frame(a: Run, b: Run, name: str, frames: tuple[Frame, Frame]) -> None:
    """An image shown for two runs must be the same in the data of both.

    Args:
        a, b: the runs.
        name: of the image.
        frames: the ground truth in each run's own data.

    Raises:
        ConfigError: naming both runs and the image.
    """
    x, y = frames
    for what, same in (
        ("image", torch.equal(x.image, y.image)),
        ("camera", torch.equal(x.camera.K, y.camera.K)),
        ("skeleton", torch.equal(x.skeleton, y.skeleton)),
    ):
        if not same:
            raise _refusal("figures", a, b, f"have a different {what} {name}")


def _check_images(a: Run, b: Run, split: str, where: str) -> None:
    check_data(a, b, where)
    counts = [run.images(split) for run in (a, b)]
    if counts[0] != counts[1]:
        raise _refusal(where, a, b, f"were scored on {counts[0]} and {counts[1]} images")
    low, high = (run.of(split, FLOOR).get("psnr") for run in (a, b))
    if low is not None and high is not None and abs(low - high) > FLOOR_TOLERANCE:
        text = f"an all-background image has {low:.3f} and {high:.3f} dB"
        raise _refusal(where, a, b, f"were scored against different images: {text}")


def differing(a: dict[str, Any], b: dict[str, Any]) -> list[str]:
    """Keys whose values differ; a key that an older config lacks counts as null."""
    return sorted(key for key in a.keys() | b.keys() if a.get(key) != b.get(key))


def lpips_name(run: Run, split: str) -> str | None:
    """Backbone and range of a run's LPIPS, where it has one."""
    scores = run.scores.get(split, {}).values()
    return next((s.get("lpips_name") for s in scores if s.get("lpips") is not None), None)


def _refusal(where: str, a: Run, b: Run, what: str) -> ConfigError:
    return ConfigError(f"{where}: {a} and {b} {what}; leave one of them out")
