"""The files of a dataset's folder by frame number."""

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import copy
from decimal import Decimal
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

import numpy as np

from gsgan.utils.errors import DataError

DIGITS = re.compile(r"[0-9]+")
# A number with the word before it, such as frame0012, cam_1, or 000012.
WORD_NUMBER = re.compile(r"([^\W\d_]*)[_\- ]?[0-9]+")
FRAME_WORDS = frozenset({"f", "fr", "frame", "frames"})
CAMERA_WORDS = frozenset({"c", "cam", "camera", "view"})
# frame numbers beyond it are dates or damage
LARGEST_FRAME = 10**9


class FrameFiles(Mapping[int, str]):
    """Paths of files by frame number, rising.

    Stored as two arrays: reading Python objects changes their reference counts, so copy-on-write
    would soon duplicate millions of paths in every loading process.

    Args:
        folder: before every name.
        names: of the files, by frame number in any order.
    """

    def __init__(self, folder: str, names: Mapping[int, str]) -> None:
        self.folder = folder
        self.frames = np.array(sorted(names), np.int64)
        # Encoded together, which is faster; no name holds a slash.
        held = [names[frame] for frame in self.frames.tolist()]
        self._names = np.array(
            os.fsencode("/".join(held)).split(b"/")[: len(held)]
        )

    def __getitem__(self, frame: int) -> str:
        # The frames are sorted, so that a binary search finds them.
        place = int(self.frames.searchsorted(frame))
        if place == len(self.frames) or self.frames[place] != frame:
            raise KeyError(frame)
        return f"{self.folder}/{os.fsdecode(self._names[place])}"

    def __iter__(self) -> Iterator[int]:
        return iter(self.frames.tolist())

    def __len__(self) -> int:
        return len(self.frames)

    def without(self, frames: Iterable[int]) -> Self:
        """The paths of all other frames."""
        # The folder is shared, the arrays are cut.
        keep = np.isin(self.frames, np.fromiter(frames, np.int64), invert=True)
        kept = copy(self)
        kept.frames = self.frames[keep]
        kept._names = self._names[keep]
        return kept


def frame_files(
    root: Path,
    folder: str,
    suffixes: tuple[str, ...],
    number: Callable[[str], int | None] | None = None,
) -> FrameFiles:
    """Paths relative to ``root`` of the images in one of its folders, by frame number.

    Args:
        root: the dataset.
        folder: relative to it; empty when it does not exist.
        suffixes: of the files to list, lower case.
        number: frame number of a file's stem; by default the last group of digits that differs
            between the files.

    Raises:
        DataError: when a name has no number, two names have the same, or a link leads to nothing.
    """
    place = root / folder
    names = frozenset(entries(place))
    # The index is cached without its folder, so this camera gets a copy with its own.
    try:
        files = copy(_by_frame(names, suffixes, number))
    except DataError as error:
        raise DataError(f"{place}: {error}") from None
    files.folder = folder
    return files


@lru_cache(maxsize=1)  # cameras mostly have files of the same names
def _by_frame(
    names: frozenset[str],
    suffixes: tuple[str, ...],
    number: Callable[[str], int | None] | None,
) -> FrameFiles:
    """The files with one of the suffixes, by the number that each stem gives."""
    # Hidden files, such as those that macOS makes of every copied file, do not count.
    stems = dict[str, str]()
    for name in sorted(names):
        stem, _, suffix = name.rpartition(".")
        if f".{suffix.lower()}" in suffixes and not name.startswith("."):
            stems[name] = stem

    # Every image needs a number of its own, by which it finds its mask.
    number = number or counting(stems.values())
    files = dict[int, str]()
    for name, stem in stems.items():
        frame = number(stem)
        if frame is None:
            raise DataError(
                f"{name} has no frame number up to {LARGEST_FRAME} in its name; number the "
                f"frames 0, 1, 2 … equally in all cameras, e.g. 000012{Path(name).suffix}"
            )
        if frame in files:
            raise DataError(
                f"{files[frame]} and {name} are both frame {frame} by the last number that differs "
                f"between the names; one number must count the frames, e.g. "
                f"000012{Path(name).suffix}"
            )
        files[frame] = name
    return FrameFiles("", files)


def entries(folder: Path) -> list[str]:
    """The names in a dataset's folder, none if it does not exist. Links are followed: the dataset
    is the user's own.

    Raises:
        DataError: if the folder or an entry is a link to nothing.
    """
    # Only links are looked up: folders may hold millions of files.
    names = []
    links = [folder] if folder.is_symlink() else []
    if folder.is_dir():
        with os.scandir(folder) as scanned:
            for entry in scanned:
                names.append(entry.name)
                hidden = entry.name.startswith(".")
                if entry.is_symlink() and not hidden:
                    links.append(Path(entry))
    for link in links:
        if not link.exists():
            raise DataError(
                f"{link} is a link to {link.readlink()}, which does not exist; is its disk mounted?"
            )
    return names


def find_shifts(
    images: Iterable[int],
    others: Mapping[str, Iterable[int]],
    which: str = "images",
) -> list[str]:
    """Notes on files whose numbers are those of the images but for their start.

    Args:
        images: their frame numbers.
        others: those of other files, by what they are.
        which: the images, in words.
    """
    given = sorted(images)
    notes = []
    for what, numbers in others.items():
        ordered = sorted(numbers)
        if len(ordered) != len(given) or ordered == given:
            continue
        first, other = given[0], ordered[0]
        if [frame - first for frame in given] == [n - other for n in ordered]:
            notes.append(
                f"doubtful: {which} are numbered from {first}, {what} from {other}: number both "
                "alike, or every image gets what belongs to another moment"
            )
    return notes


def counting(stems: Iterable[str]) -> Callable[[str], int | None]:
    """The function that gives the frame number of each of these stems.

    It is the last group of digits that differs between the stems: ``000012_0``. Words come first:
    ``frame`` names the number, and ``cam`` another one, as in ``frame0012_cam1``. Names often have
    other numbers in front, such as a date; numbers too large for frames, such as times, do not
    count where another one differs: ``000012_1698765432``.
    """
    stems = list(stems)
    groups = [DIGITS.findall(stem) for stem in stems]
    place = -1
    if len({len(group) for group in groups}) == 1:
        differing = []
        for i, values in enumerate(zip(*groups, strict=True)):
            if len(set(values)) > 1:
                differing.append(i)
        usable = [
            i
            for i in differing
            if all(frame_of(group[i]) is not None for group in groups)
        ]
        words = [WORD_NUMBER.findall(stem.lower()) for stem in stems]
        places = usable or differing or list(range(len(groups[0])))
        place = _by_word(places, words)

    def number(stem: str) -> int | None:
        digits = DIGITS.findall(stem)
        return frame_of(digits[place]) if digits else None

    return number


def _by_word(places: Sequence[int], words: Sequence[Sequence[str]]) -> int:
    """The last of some groups of digits that follows a word for frames, else no word for cameras,
    else the last one; -1 without groups.

    Args:
        places: of the groups.
        words: by stem, the word before each of its groups.
    """
    for allowed in (FRAME_WORDS.__contains__, lambda w: w not in CAMERA_WORDS):
        for place in reversed(places):
            if all(allowed(before[place]) for before in words):
                return place
    return places[-1] if places else -1


def last_number(stem: str) -> int | None:
    """The last group of digits in a file's stem; None above `LARGEST_FRAME`."""
    digits = DIGITS.findall(stem)
    return frame_of(digits[-1]) if digits else None


def frame_of(digits: str) -> int | None:
    """The frame number in a group of digits; None above `LARGEST_FRAME`."""
    digits = digits.lstrip("0") or "0"
    # int() refuses very long numbers.
    if len(digits) > len(str(LARGEST_FRAME)):
        return None
    number = int(digits)
    return number if number <= LARGEST_FRAME else None


def natural_order(name: str) -> list[Any]:
    """Sort key: ``Camera_B2`` before ``Camera_B10``, ``rate -1e-3`` before ``rate 0.5``."""
    # Numbers after a space, such as values of settings, may have a sign and decimals. Decimal
    # keeps all digits. The pattern's matches have odd places.
    parts: list[Any] = re.split(
        r"((?<= )-?\d+(?:\.\d+)?(?:e[+-]?\d{1,3})?|\d+)", name
    )
    parts[1::2] = map(Decimal, parts[1::2])
    return parts
