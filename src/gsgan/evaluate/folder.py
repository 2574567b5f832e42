"""Any method's predictions: a folder of pictures, each matched with what was to be painted."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsgan.data.files import frame_of, read_header, read_with_alpha
from gsgan.data.splits import Item
from gsgan.evaluate.prepare import Prediction
from gsgan.evaluate.split import FULL
from gsgan.scene import Frame
from gsgan.utils.errors import ConfigError, DataError

FIELDS = ("split", "camera", "camera_index", "frame")
SHOWN = 5  # names in a message
WRONG_BACKGROUND = 0.5  # of the background's pixels on the other one: painted on that one
CLOSE = 0.05  # of the range, from where a pixel counts as black or white


@dataclass(frozen=True)
class Pattern:
    """How prediction files are named.

    Args:
        text: relative to the folder, with "{camera}" (name) or "{camera_index}" (place in the
            dataset's cameras, from 0), "{frame}" (number, any zero-padding), and "{split}" or not.

    Raises:
        ConfigError: when a field is unknown, missing or given twice.
    """

    text: str

    def __post_init__(self) -> None:
        found = re.findall(r"\{(.*?)\}", self.text)
        unknown = [name for name in found if name not in FIELDS]
        if unknown:
            raise ConfigError(
                f"predictions_pattern has the field {{{unknown[0]}}}; it may have "
                + ", ".join(f"{{{name}}}" for name in FIELDS)
            )
        cameras = found.count("camera") + found.count("camera_index")
        if found.count("frame") != 1 or cameras != 1 or found.count("split") > 1:
            raise ConfigError(
                f"predictions_pattern={self.text} must have {{frame}} once, {{camera}} or "
                "{camera_index} once, and {split} at most once"
            )

    def path(self, split: str, item: Item, cameras: Sequence[str]) -> str:
        """What the file of an item is called, its frame number padded to six digits."""
        camera, frame = item
        values = {
            "split": split,
            "camera": camera,
            "camera_index": str(cameras.index(camera)),
            "frame": f"{frame:06d}",
        }
        return re.sub(r"\{(.*?)\}", lambda field: values[field[1]], self.text)

    def regex(self, splits: Sequence[str], cameras: Sequence[str]) -> re.Pattern[str]:
        """What the names match."""
        longest = sorted(cameras, key=len, reverse=True)
        digits = "[0-9]+"
        groups = {
            "split": "|".join(map(re.escape, splits)),
            "camera": "|".join(map(re.escape, longest)),
            "camera_index": digits,
            "frame": digits,
        }
        parts = re.split(r"\{(.*?)\}", self.text)
        return re.compile(
            "".join(
                f"(?P<{part}>{groups[part]})" if i % 2 else re.escape(part)
                for i, part in enumerate(parts)
            )
        )


@dataclass(frozen=True)
class Folder:
    """A folder in which every expected picture lies once.

    Args:
        root: the folder.
        files: relative paths by camera and frame.
        extra: files that nothing asks for.
        background: on which opaque pictures are painted.
    """

    root: Path
    files: Mapping[Item, str]
    extra: tuple[str, ...]
    background: str

    def predict(self, frame: Frame, item: Item) -> Prediction:
        """The picture of an item.

        Raises:
            DataError: when it is damaged, not 8-bit RGB, of another size than the truth as scored,
                or on another background than was said.
        """
        path = self.root / self.files[item]
        rgb, alpha = read_with_alpha(path)
        if rgb.shape[:2] != frame.camera.size:
            raise DataError(wrong_size(path, rgb.shape[:2], item, frame.camera.size))
        image = _unit(rgb).permute(2, 0, 1)[None].to(frame.image)
        if alpha is not None:
            cover = _unit(alpha)[None, None].to(frame.image)
            return Prediction({FULL: image * cover}, {FULL: cover})
        self._check_background(path, image, frame.mask)
        return Prediction({FULL: image}, {}, self.background)

    def _check_background(self, path: Path, image: Tensor, mask: Tensor) -> None:
        behind = image.permute(0, 2, 3, 1)[mask[:, 0] == 0]
        if len(behind) == 0:
            return
        black, white = (behind < CLOSE).all(-1), (behind > 1 - CLOSE).all(-1)
        other, name = (white, "white") if self.background == "black" else (black, "black")
        if float(other.float().mean()) > WRONG_BACKGROUND:
            raise DataError(
                f"{path} is painted on {name}, expected: {self.background}; say so with "
                f"predictions_background={name}, or give pictures with alpha"
            )


def wrong_size(path: Path, found: Sequence[int], item: Item, wanted: tuple[int, int]) -> str:
    """The sentence about a picture of another size."""
    return (
        f"{path} (camera {item[0]}, frame {item[1]}) is {found[1]}x{found[0]} pixels (width x "
        f"height), but the truth as scored is {wanted[1]}x{wanted[0]}; predictions are scored at "
        "the size of data.size, data.crop and the protocol, and are never resized"
    )


def _unit(pixels: np.ndarray) -> Tensor:
    return torch.from_numpy(pixels).float() / 255


def read_folder(
    root: Path,
    pattern: Pattern,
    expected: Mapping[str, Sequence[Item]],
    cameras: Sequence[str],
    background: str,
) -> Folder:
    """Finds the file of every expected picture; none is opened.

    Args:
        root: the folder.
        pattern: of the names.
        expected: items by split.
        cameras: the dataset's, in its order.
        background: on which opaque pictures are painted.

    Raises:
        DataError: when the folder is not there, a picture is missing or there twice.
    """
    if not root.is_dir():
        what = "is a file, not a folder" if root.exists() else "does not exist"
        raise DataError(f"predictions={root} {what}; expected the folder of a method's pictures")
    wanted = {item: split for split, items in expected.items() for item in items}
    regex = pattern.regex(tuple(expected), cameras)
    found: dict[Item, str] = {}
    extra = []
    names = _files(root)
    for name in names:
        item, split = _item(regex.fullmatch(name), cameras)
        if item not in wanted or split not in (None, wanted[item]):
            extra.append(name)
            continue
        if item in found:
            raise DataError(
                f"{root} holds camera {item[0]}, frame {item[1]} twice, as {found[item]} and "
                f"{name}; keep one of them"
            )
        found[item] = name
    missing = [item for item in wanted if item not in found]
    if missing:
        raise DataError(_missing(root, pattern, wanted, missing, names, cameras))
    return Folder(root, found, tuple(extra), background)


def _files(root: Path) -> list[str]:
    """All files below a folder, relative, in order; hidden ones left out."""
    found = []
    for folder, subfolders, names in os.walk(root, followlinks=True):
        subfolders[:] = sorted(s for s in subfolders if not s.startswith("."))
        relative = Path(folder).relative_to(root)
        found += [(relative / name).as_posix() for name in names if not name.startswith(".")]
    return sorted(found)


def _item(match: re.Match[str] | None, cameras: Sequence[str]) -> tuple[Item | None, str | None]:
    """Camera, frame and split that a name says; None where it says none."""
    if match is None:
        return None, None
    fields: dict[str, Any] = match.groupdict()
    frame = frame_of(fields["frame"])
    camera = fields.get("camera")
    if camera is None:
        index = frame_of(fields["camera_index"])
        camera = cameras[index] if index is not None and index < len(cameras) else None
    if frame is None or camera is None:
        return None, None
    return (camera, frame), fields.get("split")


def _missing(
    root: Path,
    pattern: Pattern,
    wanted: Mapping[Item, str],
    missing: Sequence[Item],
    names: Sequence[str],
    cameras: Sequence[str],
) -> str:
    camera, frame = missing[0]
    at = pattern.path(wanted[missing[0]], missing[0], cameras)
    text = (
        f"{root} lacks {len(missing)} of {len(wanted)} pictures, the first of them camera "
        f"{camera}, frame {frame}, expected as {at} (predictions_pattern={pattern.text})"
    )
    if len(missing) == len(wanted):
        there = ", ".join(names[:SHOWN]) or "nothing"
        return f"{text}; in the folder there is {there}" + (" …" if len(names) > SHOWN else "")
    return text


def check_headers(folder: Folder, item: Item, wanted: tuple[int, int]) -> None:
    """Refuses a picture of another size or kind by its header, before anything is scored.

    Args:
        folder: of the predictions.
        item: whose file.
        wanted: ``(H, W)`` of the truth as scored.

    Raises:
        DataError: naming the file and the frame.
    """
    path = folder.root / folder.files[item]
    header = read_header(path)
    if header.size != wanted:
        raise DataError(wrong_size(path, header.size, item, wanted))
    if header.depth > 8:
        raise DataError(f"{path} has {header.depth} bits a channel; expected 8 (save it as 8-bit)")
    if header.jpeg and header.channels == 4:
        raise DataError(f"{path} is a CMYK JPEG; expected RGB (convert it to RGB)")
