"""Splits a capture by cameras and frames: training, held-out views, held-out poses."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from gsgan.data.layout import Layout
from gsgan.data.protocol import Protocol
from gsgan.data.skeletons import Landmarks
from gsgan.data.validation import spans
from gsgan.skeleton.training_poses import pose_in_pelvis, training_poses
from gsgan.utils.arrays import Ints, evenly_spaced
from gsgan.utils.checks import AUTO, integer
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.frame_files import LARGEST_FRAME
from gsgan.utils.tensors import farthest_points

NameOrNumber = TypeVar("NameOrNumber", int, str)

# first, last and step: "12", "0-55" or "0-55:5"
FRAME_RANGE = re.compile(
    r"\s*(\d{1,18})\s*(?:-\s*(\d{1,18})\s*)?(?::\s*(\d{1,18})\s*)?"
)
# share of the poses, those least like all others, that is not chosen from
OUTLIERS = 0.05
# Bounds the memory that a range from a file can ask for.
MAX_LISTED_FRAMES = 10**7
# training, held-out cameras, held-out frames
SPLITS = ("train", "novel_view", "novel_pose")
# a further split, of frames cut from the training frames, where it is asked for
VALIDATION = "validation"
# what cuts the last share of the training frames
VALIDATION_SHARE = 0.1
# camera name, frame number
Item = tuple[str, int]


class Items(Sequence[Item]):
    """(camera, frame) pairs, camera by camera, stored as arrays like `FrameFiles`.

    Args:
        frames: ``[N]`` frame numbers of each camera.
    """

    def __init__(self, frames: Mapping[str, Ints]) -> None:
        # Cameras without an item are left out.
        self._of = {
            name: numbers for name, numbers in frames.items() if len(numbers)
        }
        # The places at which the cameras' items end, after a leading 0.
        self._ends = np.cumsum([0, *map(len, self._of.values())])

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras that have an item."""
        return tuple(self._of)

    @property
    def frames(self) -> list[int]:
        """The frame numbers, rising, each once."""
        # The empty array is for a split without cameras.
        numbers = [np.empty(0, np.int64), *self._of.values()]
        return np.unique(np.concatenate(numbers)).tolist()

    def __len__(self) -> int:
        return int(self._ends[-1])

    def __getitem__(self, index: int) -> Item:  # type: ignore[override]
        # A range counts negative places from the end, and refuses those beyond it.
        place = range(len(self))[index]

        # The camera among whose items the place lies.
        camera = int(self._ends.searchsorted(place, side="right")) - 1
        name = self.cameras[camera]
        number = self._of[name][place - self._ends[camera]]
        return name, int(number)

    def __iter__(self) -> Iterator[Item]:
        for name, numbers in self._of.items():
            for frame in numbers.tolist():
                yield name, frame

    def index(self, item: Item, *_: int) -> int:  # type: ignore[override]
        """The place of an item; a ValueError if it is not in the split."""
        name, frame = item
        camera = self.cameras.index(name)

        # The place among the camera's own items.
        matches = np.flatnonzero(self._of[name] == frame)
        if not len(matches):
            raise ValueError(f"{item} is not in the split")
        return int(self._ends[camera] + matches[0])


class Sides(NamedTuple, Generic[NameOrNumber]):
    """The cameras or frames for training, and those for tests."""

    train: tuple[NameOrNumber, ...]
    test: tuple[NameOrNumber, ...]


@dataclass(frozen=True)
class Splits:
    """Training and held-out cameras and frames.

    ``train`` is train cameras × train frames, ``novel_view`` test cameras × train frames,
    ``novel_pose`` train cameras × test frames. ``validation``, where it is asked for, is train
    cameras × validation frames, which are no train frames.

    Args:
        items: the existing items, by split.
        reasons: why splits are empty, by the empty split.
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
    train_poses: int | None = None,
    validation_frames: Any = None,
) -> Splits:
    """Splits a capture by cameras and by frames.

    For cameras, and likewise for frames: the config comes first, then meta.json; without both all
    cameras are for training and the last ``test_share`` of the frames is held out. If only one side
    of a pair is given, the other takes the rest.

    Args:
        layout: the capture.
        train_cameras, test_cameras: names, or None.
        train_frames, test_frames: numbers and "a-b" ranges (both ends included), or None.
        test_share: in [0, 1), the share of frames held out by default.
        train_poses: maximum number of train frames, see `spread_frames`; None uses all.
        validation_frames: train frames that become validation frames, as train_frames; "auto" takes
            the last `VALIDATION_SHARE` of them, None none.

    Raises:
        DataError: when a camera does not exist, or nothing is left to train on.
        ConfigError: on a malformed value, or one camera or frame on both sides.
    """
    if not 0 <= test_share < 1:
        raise ConfigError(
            f"data.test_share must be in [0, 1), got {test_share}"
        )

    # By default all cameras train, and the last frames are held out.
    everyone = layout.camera_names
    frames = layout.frames
    cut = len(frames) - int(len(frames) * test_share)

    # The train and test side of both, from the config, meta.json or the default.
    cameras = _sides(
        layout,
        "cameras",
        given=(train_cameras, test_cameras),
        everything=everyone,
        default=(everyone, ()),
        parse=parse_names,
    )
    wanted = _sides(
        layout,
        "frames",
        given=(train_frames, test_frames),
        everything=frames,
        default=(frames[:cut], frames[cut:]),
        parse=parse_frames,
    )

    # Frames that do not exist are only noted, but a wrong camera is a mistake.
    for camera in (*cameras.train, *cameras.test):
        if camera not in layout.cameras:
            raise DataError(
                f"{layout.root} has no camera {camera}; it has {', '.join(everyone)}"
            )

    # Only items that exist.
    usable, notes = _usable(layout, wanted, "of the splits")
    validation: list[int] = []
    if validation_frames is not None:
        validation = _validation(usable.train, validation_frames)
        left = set(usable.train).difference(validation)
        usable = usable._replace(train=tuple(sorted(left)))
    if train_poses is not None:
        maximum = integer("data.train_poses", train_poses, 1)
        spread = spread_frames(layout.landmarks, usable.train, maximum)
        usable = usable._replace(train=tuple(spread))
    items = {
        "train": _items(layout, cameras.train, usable.train),
        "novel_view": _items(layout, cameras.test, usable.train),
        "novel_pose": _items(layout, cameras.train, usable.test),
    }
    if validation:
        items[VALIDATION] = _items(layout, cameras.train, validation)

    # The reasons if one of them is empty.
    reasons = {
        "novel_view": "no camera is held out (data.test_cameras)",
        "novel_pose": "no frame is held out (data.test_frames)",
    }
    return _splits(layout, cameras, usable, items, reasons, notes)


def _validation(train: Sequence[int], given: Any) -> list[int]:
    """The validation frames among the train frames."""
    if given == AUTO:
        count = max(1, int(VALIDATION_SHARE * len(train)))
        return list(train[-count:])
    chosen = parse_frames(given, "data.validation_frames")
    if not set(chosen) <= set(train):
        raise ConfigError(
            "data.validation_frames must be training frames, but "
            f"{min(set(chosen).difference(train))} is none"
        )
    return list(chosen)


def spread_frames(
    landmarks: Landmarks, frames: Sequence[int], maximum: int
) -> list[int]:
    """At most so many frames, rising, whose poses are far from each other.

    The share `OUTLIERS` of the poses that are least like all others is not chosen from: wrong
    landmarks are among them.
    """
    # All frames are used if they are few.
    if len(frames) <= maximum:
        return list(frames)
    p, _ = landmarks.joints(frames)

    # Poses that are not outliers.
    distance = training_poses(p).distance(p)
    usual = (distance <= distance.quantile(1 - OUTLIERS)).nonzero().flatten()

    # Frames of equal poses are chosen once.
    poses = pose_in_pelvis(p[usual])
    chosen = usual[farthest_points(poses, min(maximum, len(usual)))]
    return sorted({frames[i] for i in chosen.tolist()})


def spread_items(items: Sequence[Item], count: int) -> list[int]:
    """The places, rising, of at most ``count`` items: an image of every frame first, then a second
    image of every frame, and so on. Cameras take turns from frame to frame."""
    # The places of each frame's items, beginning with another camera in each.
    by_frame: dict[int, list[int]] = {}
    for place, (_, frame) in enumerate(items):
        by_frame.setdefault(frame, []).append(place)
    turned = []
    for i, frame in enumerate(sorted(by_frame)):
        frame_items = by_frame[frame]
        first = i % len(frame_items)
        turned.append(frame_items[first:] + frame_items[:first])

    # Rounds over all frames; the last one takes some of them, evenly spaced.
    chosen: list[int] = []
    for nth in range(max(map(len, turned), default=0)):
        places = [
            frame_items[nth] for frame_items in turned if nth < len(frame_items)
        ]
        left = min(count - len(chosen), len(places))
        if left > 0:
            chosen += [places[i] for i in evenly_spaced(len(places), left)]
    return sorted(chosen)


def _usable(
    layout: Layout, frames: Sides[int], whose: str
) -> tuple[Sides[int], tuple[str, ...]]:
    """The train and test frames that the capture has, and a note on the others."""
    # Frames that were dropped, or never existed.
    available = set(layout.frames)
    usable = Sides(
        train=tuple(frame for frame in frames.train if frame in available),
        test=tuple(frame for frame in frames.test if frame in available),
    )
    missing = sorted({*frames.train, *frames.test} - available)
    if not missing:
        return usable, ()
    note = f"{len(missing)} frames {whose} are not usable or do not exist: {spans(missing)}"
    return usable, (note,)


def _splits(
    layout: Layout,
    cameras: Sides[str],
    frames: Sides[int],
    items: dict[str, Items],
    reasons: dict[str, str],
    notes: tuple[str, ...],
) -> Splits:
    """The splits, with the reasons of the empty ones; the training split must not be empty."""
    # Held-out splits may be empty.
    if not items["train"]:
        raise DataError(
            f"{layout.root}: nothing to train on with cameras {', '.join(cameras.train) or 'none'} "
            f"and {len(frames.train)} train frames; the capture has cameras "
            f"{', '.join(layout.camera_names)} and frames {spans(list(layout.frames))}"
        )
    return Splits(
        train_cameras=cameras.train,
        test_cameras=cameras.test,
        train_frames=frames.train,
        test_frames=frames.test,
        items=items,
        reasons={name: why for name, why in reasons.items() if not items[name]},
        notes=notes,
    )


def _items(
    layout: Layout, cameras: Sequence[str], frames: Sequence[int]
) -> Items:
    """The cameras' images of the frames, those that exist."""
    # Both arrays are without repetitions.
    wanted = np.array(frames, np.int64)
    items = {}
    for camera in cameras:
        stored = layout.images[camera].frames
        items[camera] = np.intersect1d(wanted, stored, assume_unique=True)
    return Items(items)


def protocol_splits(layout: Layout, protocol: Protocol) -> Splits:
    """Splits a capture as a published protocol does.

    Train cameras × train frames are for training; test cameras × test frames are held out: as
    ``novel_view`` if the frame is also a training frame (of other cameras), else ``novel_pose``.

    Args:
        layout: the capture.
        protocol: its cameras are names, or indices into `Layout.camera_names`.

    Raises:
        DataError: when a camera does not exist, or nothing is left to train on.
        ConfigError: when an image is in both splits, or a value is malformed.
    """
    # Names of the cameras; a side that the protocol leaves out takes the rest.
    train = _protocol_cameras(layout, protocol.train_cameras, protocol.name)
    test = _protocol_cameras(layout, protocol.test_cameras, protocol.name)
    cameras = _complete(layout.camera_names, train, test)

    # Frames that the capture has.
    wanted = Sides(
        parse_frames(protocol.frames("train"), "protocol.train_frames"),
        parse_frames(protocol.frames("test"), "protocol.test_frames"),
    )
    frames, notes = _usable(layout, wanted, f"of protocol {protocol.name}")

    # No image may be in both splits.
    trained = set(frames.train)
    seen = [frame for frame in frames.test if frame in trained]
    shared = set(cameras.train) & set(cameras.test)
    if shared and seen:
        raise ConfigError(
            f"protocol {protocol.name}: frame {min(seen)} of camera {min(shared)} is "
            "in both splits; test images must not be used for training"
        )

    # A test frame is a new pose unless other cameras train on it.
    new = [frame for frame in frames.test if frame not in trained]
    items = {
        "train": _items(layout, cameras.train, frames.train),
        "novel_view": _items(layout, cameras.test, seen),
        "novel_pose": _items(layout, cameras.test, new),
    }
    reasons = dict.fromkeys(SPLITS[1:], f"protocol {protocol.name} has none")
    return _splits(layout, cameras, frames, items, reasons, notes)


def _protocol_cameras(
    layout: Layout, cameras: Sequence[str | int] | None, protocol: str
) -> tuple[str, ...] | None:
    """The names of one side's cameras; None if the protocol leaves the side out."""
    if cameras is None:
        return None
    return tuple(camera_name(layout, camera, protocol) for camera in cameras)


def _complete(
    everything: tuple[NameOrNumber, ...],
    train: tuple[NameOrNumber, ...] | None,
    test: tuple[NameOrNumber, ...] | None,
) -> Sides[NameOrNumber]:
    """Both sides; a side that is None takes everything outside the other."""
    # With both sides missing, all of them train.
    if train is None:
        train = tuple(x for x in everything if x not in (test or ()))
    if test is None:
        test = tuple(x for x in everything if x not in train)
    return Sides(train, test)


def camera_name(layout: Layout, camera: str | int, protocol: str) -> str:
    """The name of a camera given by name or by its index in `Layout.camera_names`."""
    # An index, else a name; a name may be a number as well.
    names = layout.camera_names
    if isinstance(camera, int) and 0 <= camera < len(names):
        return names[camera]
    if camera in layout.cameras:
        return str(camera)
    raise DataError(
        f"{layout.root}: protocol {protocol} requests camera {camera}; the capture has "
        f"{len(names)}: {', '.join(names)}"
    )


def _sides(
    layout: Layout,
    name: str,
    given: tuple[Any, Any],
    everything: tuple[NameOrNumber, ...],
    default: tuple[tuple[NameOrNumber, ...], tuple[NameOrNumber, ...]],
    parse: Callable[[Any, str], tuple[NameOrNumber, ...]],
) -> Sides[NameOrNumber]:
    """The train and test side of ``name``, cameras or frames, from the first source that has one:
    the config's ``given`` values, meta.json, else the default."""
    stored = layout.meta.splits
    in_meta = (stored.get(f"train_{name}"), stored.get(f"test_{name}"))
    for values, where in ((given, "data."), (in_meta, "meta.json, splits.")):
        train_value, test_value = values
        if train_value is None and test_value is None:
            continue

        # The values as names or numbers; a missing side takes the rest.
        train = test = None
        if train_value is not None:
            train = parse(train_value, f"{where}train_{name}")
        if test_value is not None:
            test = parse(test_value, f"{where}test_{name}")
        sides = _complete(everything, train, test)

        # What is tested must not be trained on.
        both = sorted(set(sides.train) & set(sides.test))
        if both:
            raise ConfigError(
                f"{where}train_{name} and {where}test_{name} share {both[0]}; test images must "
                "not be used for training"
            )
        return sides

    # Neither source has any.
    return Sides(*default)


def parse_names(value: Any, where: str) -> tuple[str, ...]:
    """Camera names from a list or a comma-separated string.

    Raises:
        ConfigError: when it is neither.
    """
    # A list in a config may be written as one text.
    if isinstance(value, str):
        names = [name.strip() for name in value.split(",")]
        return tuple(filter(None, names))
    # A camera's name may be a number.
    if isinstance(value, int):
        return (str(value),)
    if not isinstance(value, Iterable):
        raise ConfigError(
            f"{where} must be a list of camera names, got {value!r}"
        )
    return tuple(dict.fromkeys(map(str, value)))


def parse_frames(value: Any, where: str) -> tuple[int, ...]:
    """Frame numbers from numbers, ranges and lists of them, rising.

    A range is "a-b", both ends included, or "a-b:n" for every n-th of it.

    Raises:
        ConfigError: when a part is neither.
    """
    # A list, a text of several parts, or a single number.
    parts = value.split(",") if isinstance(value, str) else value
    if not isinstance(parts, Iterable):
        parts = (parts,)

    frames: set[int] = set()
    for part in parts:
        # A range such as "0-55:5"; a single number is a range of one frame.
        match = FRAME_RANGE.fullmatch(str(part))
        numbers = range(0)
        if match:
            # A step of 0 would be endless.
            first, last, step = match.groups()
            step = int(step or 1)
            if step > 0:
                numbers = range(int(first), int(last or first) + 1, step)
        if not numbers:
            raise ConfigError(
                f"{where} must be frame numbers or ranges such as 0-55, got {part!r}"
            )

        # Bounds, checked before the numbers take memory.
        if len(numbers) + len(frames) > MAX_LISTED_FRAMES:
            raise ConfigError(
                f"{where} names more than {MAX_LISTED_FRAMES} frames"
            )
        if numbers[-1] > LARGEST_FRAME:
            raise ConfigError(
                f"{where} names frame {numbers[-1]}; frame numbers end at {LARGEST_FRAME}"
            )
        frames.update(numbers)
    return tuple(sorted(frames))
