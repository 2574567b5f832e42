"""Splits a capture by cameras and frames: training, held-out views, held-out poses."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np

from gsgan.data.files import LARGEST_FRAME
from gsgan.data.layout import Layout
from gsgan.data.protocol import Protocol
from gsgan.data.validation import spans
from gsgan.utils.arrays import Ints
from gsgan.utils.errors import ConfigError, DataError

T = TypeVar("T", int, str)

FRAME_RANGE = re.compile(
    r"\s*(\d{1,18})\s*(?:-\s*(\d{1,18})\s*)?(?::\s*(\d{1,18})\s*)?"
)
MOST_FRAMES = 10**7  # bounds the memory that a range from a file can ask for
SPLITS = ("train", "novel_view", "novel_pose")
SIDES: tuple[Literal["train", "test"], ...] = ("train", "test")
Item = tuple[str, int]  # camera name, frame number


class Items(Sequence[Item]):
    """(camera, frame) pairs, camera by camera; kept in arrays like `FrameFiles`.

    Args:
        frames: ``[N]`` of each camera.
    """

    def __init__(self, frames: Mapping[str, Ints]) -> None:
        self._of = {name: numbers for name, numbers in frames.items() if len(numbers)}
        self._ends = np.cumsum([0, *map(len, self._of.values())])

    @property
    def cameras(self) -> tuple[str, ...]:
        """Those with an item."""
        return tuple(self._of)

    @property
    def frames(self) -> list[int]:
        """The frame numbers, rising, each once."""
        return np.unique(
            np.concatenate([*self._of.values(), np.empty(0, np.int64)])
        ).tolist()

    def __len__(self) -> int:
        return int(self._ends[-1])

    def __getitem__(self, index: int) -> Item:  # type: ignore[override]
        place = range(len(self))[index]
        camera = int(self._ends.searchsorted(place, side="right")) - 1
        name = self.cameras[camera]
        return name, int(self._of[name][place - self._ends[camera]])

    def __iter__(self) -> Iterator[Item]:
        return ((name, f) for name, frames in self._of.items() for f in frames.tolist())

    def index(self, item: Item, *_: int) -> int:  # type: ignore[override]
        """The place of an item; a ValueError where it is none."""
        camera = self.cameras.index(item[0])
        found = np.flatnonzero(self._of[item[0]] == item[1])
        if not len(found):
            raise ValueError(f"{item} is not in the split")
        return int(self._ends[camera] + found[0])


@dataclass(frozen=True)
class Splits:
    """Training and held-out cameras and frames.

    ``train`` is train cameras × train frames, ``novel_view`` test cameras × train frames,
    ``novel_pose`` train cameras × test frames.

    Args:
        items: those that exist, by split.
        reasons: why a split is empty, for those that are.
        notes: requested frames that the capture lacks.
    """

    train_cameras: tuple[str, ...]
    test_cameras: tuple[str, ...]
    train_frames: tuple[int, ...]
    test_frames: tuple[int, ...]
    items: dict[str, Items]
    reasons: dict[str, str]
    notes: tuple[str, ...] = ()


def make_splits(
    layout: Layout,
    train_cameras: Any = None,
    test_cameras: Any = None,
    train_frames: Any = None,
    test_frames: Any = None,
    test_share: float = 0.2,
) -> Splits:
    """Splits a capture by cameras and by frames.

    For cameras, and likewise for frames: the config comes first, then meta.json; without both all
    cameras are for training and the last ``test_share`` of the frames is held out. Where only one
    side of a pair is given, the other takes the rest.

    Args:
        layout: the capture.
        train_cameras, test_cameras: names, or None.
        train_frames, test_frames: numbers and "a-b" ranges (both ends included), or None.
        test_share: in [0, 1), the share of frames held out by default.

    Raises:
        DataError: when a camera does not exist, or nothing is left to train on.
        ConfigError: on a malformed value, or one camera or frame on both sides.
    """
    if not 0 <= test_share < 1:
        raise ConfigError(f"data.test_share must be in [0, 1), got {test_share}")
    given = {
        "cameras": (train_cameras, test_cameras),
        "frames": (train_frames, test_frames),
    }
    cut = len(layout.frames) - int(len(layout.frames) * test_share)
    everyone = layout.camera_names
    default = (layout.frames[:cut], layout.frames[cut:])
    cameras = _pair(layout, "cameras", given, everyone, (everyone, ()), parse_names)
    frames = _pair(layout, "frames", given, layout.frames, default, parse_frames)
    for camera in (*cameras[0], *cameras[1]):
        if camera not in layout.cameras:
            raise DataError(
                f"{layout.root} has no camera {camera}; it has {', '.join(everyone)}"
            )
    train, test, notes = _usable(layout, frames, "of the splits")
    items = {
        "train": _items(layout, cameras[0], train),
        "novel_view": _items(layout, cameras[1], train),
        "novel_pose": _items(layout, cameras[0], test),
    }
    reasons = {
        "novel_view": "no camera is held out (data.test_cameras)",
        "novel_pose": "no frame is held out (data.test_frames)",
    }
    return _splits(layout, cameras, (train, test), items, reasons, notes)


def _usable(
    layout: Layout, frames: Sequence[Sequence[int]], whose: str
) -> tuple[tuple[int, ...], tuple[int, ...], tuple[str, ...]]:
    """The train and test frames that the capture has, and a note on the others."""
    known = set(layout.frames)
    train, test = (tuple(f for f in side if f in known) for side in frames)
    missing = sorted({f for side in frames for f in side} - known)
    if not missing:
        return train, test, ()
    note = f"{len(missing)} frames {whose} are not usable or do not exist: {spans(missing)}"
    return train, test, (note,)


def _splits(
    layout: Layout,
    cameras: tuple[tuple[str, ...], tuple[str, ...]],
    frames: tuple[tuple[int, ...], tuple[int, ...]],
    items: dict[str, Items],
    reasons: dict[str, str],
    notes: tuple[str, ...],
) -> Splits:
    """The splits, with the reasons of those that are empty; training must not be."""
    if not items["train"]:
        raise DataError(
            f"{layout.root}: nothing to train on with cameras {', '.join(cameras[0]) or 'none'} "
            f"and {len(frames[0])} train frames; the capture has cameras "
            f"{', '.join(layout.camera_names)} and frames {spans(list(layout.frames))}"
        )
    reasons = {name: why for name, why in reasons.items() if not items[name]}
    return Splits(*cameras, *frames, items, reasons, notes)


def _items(layout: Layout, cameras: Sequence[str], frames: Sequence[int]) -> Items:
    some = np.array(frames, np.int64)
    return Items(
        {c: np.intersect1d(some, layout.images[c].frames, True) for c in cameras}
    )


def protocol_splits(layout: Layout, protocol: Protocol) -> Splits:
    """Splits a capture as a published protocol does.

    Train cameras × train frames are for training; test cameras × test frames are held out: as
    ``novel_view`` where the frame is also a training frame (of other cameras), else ``novel_pose``.

    Args:
        layout: the capture.
        protocol: its cameras are names, or indices into `Layout.camera_names`.

    Raises:
        DataError: when a camera does not exist, or nothing is left to train on.
        ConfigError: when an image is in both splits, or a value is malformed.
    """
    sides = (
        None
        if side is None
        else tuple(camera_name(layout, c, protocol.name) for c in side)
        for side in (protocol.train_cameras, protocol.test_cameras)
    )
    train_cameras, test_cameras = _complete(layout.camera_names, *sides)
    frames = [
        parse_frames(protocol.frames(side), f"protocol.{side}_frames") for side in SIDES
    ]
    train, test, notes = _usable(layout, frames, f"of protocol {protocol.name}")
    trained = set(train)
    both = set(train_cameras) & set(test_cameras)
    if both and trained & set(test):
        raise ConfigError(
            f"protocol {protocol.name}: frame {min(trained & set(test))} of camera {min(both)} is "
            "in both splits; test images must not be used for training"
        )
    items = {
        "train": _items(layout, train_cameras, train),
        "novel_view": _items(layout, test_cameras, [f for f in test if f in trained]),
        "novel_pose": _items(
            layout, test_cameras, [f for f in test if f not in trained]
        ),
    }
    reasons = dict.fromkeys(SPLITS[1:], f"protocol {protocol.name} has none")
    cameras = train_cameras, test_cameras
    return _splits(layout, cameras, (train, test), items, reasons, notes)


def _complete(
    everything: tuple[T, ...], train: tuple[T, ...] | None, test: tuple[T, ...] | None
) -> tuple[tuple[T, ...], tuple[T, ...]]:
    """Both sides; one that is None takes everything outside the other."""
    if train is None:
        train = tuple(x for x in everything if x not in (test or ()))
    if test is None:
        test = tuple(x for x in everything if x not in train)
    return train, test


def camera_name(layout: Layout, camera: str | int, protocol: str) -> str:
    """The name of a camera given by name or by its index in `Layout.camera_names`."""
    names = layout.camera_names
    if isinstance(camera, int) and 0 <= camera < len(names):
        return names[camera]
    if camera in layout.cameras:
        return str(camera)
    raise DataError(
        f"{layout.root}: protocol {protocol} requests camera {camera}; the capture has "
        f"{len(names)}: {', '.join(names)}"
    )


def _pair(
    layout: Layout,
    name: str,
    given: Mapping[str, tuple[Any, Any]],
    everything: tuple[T, ...],
    default: tuple[tuple[T, ...], tuple[T, ...]],
    parse: Callable[[Any, str], tuple[T, ...]],
) -> tuple[tuple[T, ...], tuple[T, ...]]:
    """The train and test side of ``name``, cameras or frames, from the first source of both."""
    meta = tuple(layout.meta.splits.get(f"{side}_{name}") for side in SIDES)
    for values, where in ((given[name], "data."), (meta, "meta.json, splits.")):
        train, test = (
            None if value is None else parse(value, f"{where}{side}_{name}")
            for value, side in zip(values, SIDES, strict=True)
        )
        if train is None and test is None:
            continue
        train, test = _complete(everything, train, test)
        if both := sorted(set(train) & set(test)):
            raise ConfigError(
                f"{where}train_{name} and {where}test_{name} share {both[0]}; test images must "
                "not be used for training"
            )
        return train, test
    return default


def parse_names(value: Any, where: str) -> tuple[str, ...]:
    """Camera names from a list or a comma-separated string.

    Raises:
        ConfigError: when it is neither.
    """
    if isinstance(value, str):
        return tuple(name.strip() for name in value.split(",") if name.strip())
    if isinstance(value, int):
        return (str(value),)
    if not isinstance(value, Iterable):
        raise ConfigError(f"{where} must be a list of camera names, got {value!r}")
    return tuple(dict.fromkeys(str(name) for name in value))


def parse_frames(value: Any, where: str) -> tuple[int, ...]:
    """Frame numbers from numbers, ranges and lists of them, rising.

    A range is "a-b", both ends included, or "a-b:n" for every n-th of it.

    Raises:
        ConfigError: when a part is neither.
    """
    parts = value.split(",") if isinstance(value, str) else value
    frames: set[int] = set()
    for part in parts if isinstance(parts, Iterable) else (parts,):
        match = FRAME_RANGE.fullmatch(str(part))
        first, last, step = (
            (match[1], match[2] or match[1], match[3] or 1) if match else (1, 0, 1)
        )
        some = range(int(first), int(last) + 1, int(step) or 1)
        if not some or int(step) < 1:
            raise ConfigError(
                f"{where} must be frame numbers or ranges such as 0-55, got {part!r}"
            )
        if len(some) + len(frames) > MOST_FRAMES:
            raise ConfigError(f"{where} names more than {MOST_FRAMES} frames")
        if some[-1] > LARGEST_FRAME:
            raise ConfigError(
                f"{where} names frame {some[-1]}; frame numbers end at {LARGEST_FRAME}"
            )
        frames.update(some)
    return tuple(sorted(frames))
