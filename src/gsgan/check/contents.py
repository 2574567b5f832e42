"""What is there: counts, splits, files that are missing; and what lies in a folder that fails."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from gsgan.check.distrust import shortened
from gsgan.check.findings import Finding, Section, Table, counted
from gsgan.check.looking import Broken
from gsgan.check.subject import Subject
from gsgan.data.checks import spans
from gsgan.utils.errors import DataError

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData

LISTED_FOLDERS = 60  # of a dataset that cannot be read
LISTED_BROKEN = 6
DEPTH = 2  # folders below the root


def contents(data: GsganData, subject: Subject) -> Section:
    """Counts, splits and missing pictures of a dataset that could be read."""
    layout, splits = data.layout, data.splits
    frames = [int(f) for f in subject.frames]
    pictures = sum(len(files) for files in subject.pairs.values())
    labels = sum(len(files) for files in layout.labels.values())
    unseen = [
        name
        for name, seen in zip(subject.template.names, subject.visible.sum(0), strict=True)
        if not seen
    ]
    rows = [
        ("layout", layout.meta.layout),
        ("cameras", f"{len(subject.cameras)}: {', '.join(subject.cameras)}"),
        ("frames", f"{len(frames)}: {shortened(frames)}"),
        ("pictures", f"{pictures} of {len(frames) * len(subject.cameras)} (every one has a mask)"),
        ("part labels", f"{labels} pictures" if labels else "none"),
        ("body poses", "none" if layout.poses is None else f"{len(layout.poses.theta)} frames"),
        (
            "skeleton",
            f"{len(subject.template.names)} joints, {layout.meta.skeleton_source}; "
            f"{subject.visible.mean():.1%} seen"
            + (f"; never seen: {', '.join(unseen)}" if unseen else ""),
        ),
        *((f"split {name}", _split(data, name)) for name in splits.items),
    ]
    if data.protocol is not None:
        rows.append(("protocol", data.protocol.name))
    return Section(
        "Contents",
        text=tuple(f"Note of the reader: {note}." for note in (*layout.notes, *splits.notes)),
        tables=(Table(("what", "how much"), tuple(rows)),),
        findings=tuple(missing_pictures(subject)),
    )


def _split(data: GsganData, name: str) -> str:
    items = data.splits.items[name]
    if not items:
        return f"empty: {data.splits.reasons.get(name, '')}"
    cameras, frames = {camera for camera, _ in items}, {frame for _, frame in items}
    return (
        f"{counted(len(items), 'picture')}: {counted(len(cameras), 'camera')}, frames "
        f"{shortened(sorted(frames))}"
    )


def missing_pictures(subject: Subject) -> list[Finding]:
    """The frames that some cameras lack."""
    every = [int(f) for f in subject.frames]
    found = []
    for name, files in subject.pairs.items():
        lacking = sorted(set(every) - set(files))
        if lacking:
            found.append(
                Finding(
                    "warning", "files",
                    f"camera {name} lacks {len(lacking)} of the {len(every)} frames: "
                    f"{shortened(lacking)}",
                )
            )  # fmt: skip
    holes = sorted(set(range(every[0], every[-1] + 1, subject.step)) - set(every))
    if holes:
        found.append(
            Finding(
                "warning", "files",
                f"no camera has a usable picture of {len(holes)} frames in between: "
                f"{shortened(holes)}",
            )
        )  # fmt: skip
    return found


def broken_pictures(broken: list[Broken]) -> list[Finding]:
    """The sentence of every picture that could not be read, a long list cut."""
    found = [Finding("error", "files", b.sentence) for b in broken[:LISTED_BROKEN]]
    if len(broken) > LISTED_BROKEN:
        rest = ", ".join(
            f"{camera} {spans(sorted({b.frame for b in broken if b.camera == camera}))}"
            for camera in dict.fromkeys(b.camera for b in broken)
        )
        found.append(
            Finding("error", "files", f"{len(broken)} sampled pictures cannot be read: {rest}")
        )
    return found


def unreadable(root: str | None, error: DataError) -> Section:
    """What is said of a dataset that its reader refuses: why, and what lies in the folder."""
    folder = None if root is None else Path(root).expanduser()
    listing = () if folder is None or not folder.is_dir() else (inventory(folder),)
    return Section(
        "The dataset cannot be read",
        text=("Nothing further could be checked. Put this right, then check again.",),
        tables=listing,
        findings=(Finding("error", "reading", str(error)),),
    )


def inventory(root: Path) -> Table:
    """The files of a folder and the folders below it, counted by the ending of their names."""
    rows = []
    for folder in [root, *_folders(root, DEPTH)][:LISTED_FOLDERS]:
        try:
            files = [path for path in folder.iterdir() if path.is_file()]
        except OSError as error:
            rows.append((_relative(folder, root), f"cannot be read: {error.strerror}"))
            continue
        kinds = Counter(path.suffix.lower() or path.name for path in files)
        text = ", ".join(f"{n} × {kind}" for kind, n in sorted(kinds.items())) or "no files"
        rows.append((_relative(folder, root), text))
    return Table(("folder", "files"), tuple(rows), title="What lies there")


def _folders(root: Path, depth: int) -> list[Path]:
    if depth == 0:
        return []
    try:
        below = sorted(p for p in root.iterdir() if p.is_dir() and not p.name.startswith("."))
    except OSError:
        return []
    return [folder for path in below for folder in (path, *_folders(path, depth - 1))]


def _relative(folder: Path, root: Path) -> str:
    return "." if folder == root else str(folder.relative_to(root))
