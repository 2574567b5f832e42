"""Any method's predictions: a folder of images, each matched with its camera and frame."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsgan.data.files import check_picture, read_header, read_with_alpha
from gsgan.data.splits import Item
from gsgan.evaluate.prepare import Prediction
from gsgan.evaluate.split import FULL
from gsgan.scene import Frame
from gsgan.utils.errors import ConfigError, DataError

FIELDS = ("split", "camera", "camera_index", "frame")
FIELD = re.compile(r"\{(.*?)\}")
SHOWN = 5  # names in a message
WRONG_BACKGROUND = 0.5  # share of the background's pixels that have the other background's colour
CLOSE = 0.05  # of the range: below it a pixel counts as black, within it of 1 as white


@dataclass(frozen=True)
class Pattern:
    """How prediction files are named.

    Args:
        text: relative to the folder, with "{camera}" (name) or "{camera_index}" (index into the
            dataset's cameras, from 0), "{frame}" (number, any zero-padding), optionally "{split}".

    Raises:
        ConfigError: when a field is unknown, missing or given twice.
    """

    text: str

    def __post_init__(self) -> None:
        found = FIELD.findall(self.text)
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

    def name(self, split: str, item: Item, cameras: Sequence[str]) -> str:
        """The file name of an item, its frame number padded to six digits."""
        camera, frame = item
        index = str(cameras.index(camera))
        values = dict(zip(FIELDS, (split, camera, index, f"{frame:06d}"), strict=True))
        return FIELD.sub(lambda field: values[field[1]], self.text)


@dataclass(frozen=True)
class PredictionFolder:
    """A folder that holds every expected image once.

    Args:
        root: the folder.
        files: relative paths by camera and frame.
        extra: files that match no expected image.
        background: of opaque images, "black" or "white".
    """

    root: Path
    files: Mapping[Item, str]
    extra: tuple[str, ...]
    background: str

    def check(self, item: Item, size: tuple[int, int]) -> None:
        """Checks the header of an item's file.

        Args:
            item: camera and frame.
            size: ``(H, W)`` of the ground truth as scored.

        Raises:
            DataError: when the file has another size, or is not an 8-bit RGB image.
        """
        path = self.root / self.files[item]
        found = read_header(path).size
        if found != size:
            raise DataError(
                f"{path} (camera {item[0]}, frame {item[1]}) is {found[1]}x{found[0]} pixels "
                f"(width x height), but the ground truth as scored is {size[1]}x{size[0]}; "
                "predictions are scored at the size given by data.size, data.crop and the "
                "protocol, and are never resized"
            )
        check_picture(path, "image", size, "the ground truth")

    def predict(self, frame: Frame, item: Item) -> Prediction:
        """The image of an item.

        Raises:
            DataError: when it is damaged, not 8-bit RGB, of another size than the ground truth as
                scored, or on another background than ``background``.
        """
        self.check(item, frame.camera.size)
        path = self.root / self.files[item]
        rgb, alpha = read_with_alpha(path)
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
                f"{path} has a {name} background, expected {self.background}; set "
                f"predictions_background={name}, or give images with alpha"
            )


def _unit(pixels: np.ndarray) -> Tensor:
    return torch.from_numpy(pixels).float() / 255


def read_folder(
    root: Path,
    pattern: Pattern,
    expected: Mapping[str, Sequence[Item]],
    cameras: Sequence[str],
    background: str,
) -> PredictionFolder:
    """Finds the file of every expected image without opening it.

    Args:
        root: the folder.
        pattern: of the names.
        expected: items by split.
        cameras: of the dataset, in its order.
        background: of opaque images.

    Raises:
        DataError: when the folder does not exist, or an image is missing or there twice.
    """
    if not root.is_dir():
        what = "is a file, not a folder" if root.exists() else "does not exist"
        raise DataError(f"predictions={root} {what}; expected the folder of a method's images")
    files: dict[str, list[str]] = {}
    names = _files(root)
    for name in names:
        files.setdefault(_unpadded(name), []).append(name)
    expected_as = {
        item: pattern.name(split, item, cameras)
        for split, items in expected.items()
        for item in items
    }
    found = {item: files.get(_unpadded(name), []) for item, name in expected_as.items()}
    for (camera, frame), several in found.items():
        if len(several) > 1:
            raise DataError(
                f"{root} holds camera {camera}, frame {frame} twice, as {several[0]} and "
                f"{several[1]}; keep one of them"
            )
    missing = [item for item, hits in found.items() if not hits]
    if missing:
        camera, frame = missing[0]
        message = (
            f"{root} lacks {len(missing)} of {len(found)} images; the first is camera {camera}, "
            f"frame {frame}, expected as {expected_as[missing[0]]} "
            f"(predictions_pattern={pattern.text})"
        )
        if len(missing) == len(found):
            message += f"; the folder contains {some(names) or 'nothing'}"
        raise DataError(message)
    used = {item: hits[0] for item, hits in found.items()}
    taken = set(used.values())
    extra = tuple(name for name in names if name not in taken)
    return PredictionFolder(root, used, extra, background)


def some(names: Sequence[str]) -> str:
    """The first names, for a message."""
    return ", ".join(names[:SHOWN]) + (" …" if len(names) > SHOWN else "")


def _files(root: Path) -> list[str]:
    """All files below a folder except hidden ones, relative and sorted."""
    found = []
    for folder, subfolders, names in os.walk(root, followlinks=True):
        subfolders[:] = [s for s in subfolders if not s.startswith(".")]
        relative = Path(folder).relative_to(root)
        found += [(relative / name).as_posix() for name in names if not name.startswith(".")]
    return sorted(found)


def _unpadded(name: str) -> str:
    """The name with every number stripped of leading zeros."""
    return re.sub("[0-9]+", lambda digits: digits[0].lstrip("0") or "0", name)
