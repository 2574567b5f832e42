"""What a dataset contains: counts, splits, missing files; and the files of one that is refused."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from gsgan.check.frames import shortened
from gsgan.check.report import Finding, Section, Table, counted
from gsgan.check.views import Broken, Subject
from gsgan.data.checks import spans
from gsgan.utils.errors import DataError

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData

LISTED_FOLDERS = 60  # of a dataset that cannot be read
LISTED_BROKEN = 6


def contents(data: GsganData, subject: Subject) -> Section:
    """Counts, splits and missing images of a dataset that could be read."""
    layout, splits, names = data.layout, data.splits, subject.template.names
    frames = [int(f) for f in subject.frames]
    images = sum(len(files) for files in subject.pairs.values())
    labels = sum(len(files) for files in layout.labels.values())
    unseen = [n for n, seen in zip(names, subject.visible.sum(0), strict=True) if not seen]
    skeleton = (
        f"{len(names)} joints, {layout.meta.skeleton_source}; {subject.visible.mean():.1%} seen"
        + f"; never seen: {', '.join(unseen)}" * bool(unseen)
    )
    rows = [
        ("layout", layout.meta.layout),
        ("cameras", f"{len(subject.cameras)}: {', '.join(subject.cameras)}"),
        ("frames", f"{len(frames)}: {shortened(frames)}"),
        ("images", f"{images} of {len(frames) * len(subject.cameras)} (all with a mask)"),
        ("part labels", f"{labels} images" if labels else "none"),
        ("body poses", "none" if layout.poses is None else f"{len(layout.poses.theta)} frames"),
        ("skeleton", skeleton),
        *((f"split {name}", _split(data, name)) for name in splits.items),
    ]
    if data.protocol is not None:
        rows.append(("protocol", data.protocol.name))
    return Section(
        "Contents",
        text=tuple(f"Note of the reader: {note}." for note in (*layout.notes, *splits.notes)),
        tables=(Table(("what", "how much"), tuple(rows)),),
        findings=tuple(missing_images(subject)),
    )


def _split(data: GsganData, name: str) -> str:
    items = data.splits.items[name]
    if not items:
        return f"empty: {data.splits.reasons.get(name, '')}"
    cameras, frames = {camera for camera, _ in items}, {frame for _, frame in items}
    count, views = counted(len(items), "image"), counted(len(cameras), "camera")
    return f"{count}: {views}, frames {shortened(sorted(frames))}"


def missing_images(subject: Subject) -> list[Finding]:
    """The frames that some cameras lack."""
    every = [int(f) for f in subject.frames]
    texts = []
    for name, files in subject.pairs.items():
        if lacking := sorted(set(every) - set(files)):
            count = f"{len(lacking)} of the {len(every)} frames"
            texts.append(f"camera {name} lacks {count}: {shortened(lacking)}")
    if holes := sorted(set(range(every[0], every[-1] + 1, subject.step)) - set(every)):
        text = f"no camera has a usable image of {len(holes)} frames in between"
        texts.append(f"{text}: {shortened(holes)}")
    return [Finding("warning", "files", text) for text in texts]


def broken_images(broken: list[Broken]) -> list[Finding]:
    """The message of every image that could not be read, a long list cut."""
    found = [Finding("error", "files", b.message) for b in broken[:LISTED_BROKEN]]
    if len(broken) > LISTED_BROKEN:
        rest = ", ".join(
            f"{camera} {spans([b.frame for b in broken if b.camera == camera])}"
            for camera in dict.fromkeys(b.camera for b in broken)
        )
        text = f"{len(broken)} sampled images cannot be read: {rest}"
        found.append(Finding("error", "files", text))
    return found


def unreadable(root: str | None, error: DataError) -> Section:
    """Why the reader refuses a dataset, and the files of its folder."""
    folder = None if root is None else Path(root).expanduser()
    return Section(
        "The dataset cannot be read",
        text=("Nothing further could be checked. Correct this, then check again.",),
        tables=(inventory(folder),) if folder is not None and folder.is_dir() else (),
        findings=(Finding("error", "reading", str(error)),),
    )


def inventory(root: Path) -> Table:
    """The files of a folder and of two levels of folders below it, counted by suffix."""
    below = [p for p in sorted((*root.glob("*/"), *root.glob("*/*/"))) if p.is_dir()]
    rows = []
    for folder in [root, *(p for p in below if not p.name.startswith("."))][:LISTED_FOLDERS]:
        try:
            kinds = Counter(p.suffix.lower() or p.name for p in folder.iterdir() if p.is_file())
            text = ", ".join(f"{n} × {kind}" for kind, n in sorted(kinds.items())) or "no files"
        except OSError as error:
            text = f"cannot be read: {error.strerror}"
        rows.append((str(folder.relative_to(root)), text))
    return Table(("folder", "files"), tuple(rows), title="Files of the folder")
