"""Any method's predictions: a folder of images, each matched with its camera and frame."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from glob import glob
from pathlib import Path

import torch
from torch import Tensor

from gsgan.data.files import check_picture, read_with_alpha
from gsgan.data.splits import Item
from gsgan.evaluate.prepare import FULL, Prediction
from gsgan.scene import Frame
from gsgan.utils.errors import ConfigError, DataError

NO_PARTS = "predictions are pictures, not a segmentation"
FIELDS = ("split", "camera", "camera_index", "frame")
FIELD = re.compile(r"\{(.*?)\}")
WRONG_BACKGROUND = 0.5  # share of the background's pixels that have the other background's colour
CLOSE = 0.05  # of the range: below it a pixel counts as black, within it of 1 as white


@dataclass(frozen=True)
class PredictionFolder:
    """A folder that holds every expected image once.

    Args:
        root: the folder.
        files: relative paths by camera and frame.
        background: of opaque images, "black" or "white".
    """

    root: Path
    files: Mapping[Item, str]
    background: str

    def predict(self, frame: Frame, item: Item) -> Prediction:
        """The image of an item.

        Raises:
            DataError: when it is damaged, not 8-bit RGB, or on another background than
                ``background``.
        """
        path = self.root / self.files[item]
        rgb, alpha = read_with_alpha(path)
        image = (torch.from_numpy(rgb).float() / 255).permute(2, 0, 1)[None].to(frame.image)
        if alpha is not None:
            cover = (torch.from_numpy(alpha).float() / 255)[None, None].to(frame.image)
            return Prediction({FULL: image * cover}, {FULL: cover}, no_parts=NO_PARTS)
        self._check_background(path, image, frame.mask)
        return Prediction({FULL: image}, {}, self.background, no_parts=NO_PARTS)

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


def read_folder(
    root: Path,
    pattern: str,
    expected: Mapping[str, Mapping[Item, tuple[int, int]]],
    cameras: Sequence[str],
    background: str,
) -> PredictionFolder:
    """Finds the file of every expected image and checks its header; other files are ignored.

    Args:
        root: the folder.
        pattern: of the names, relative to the folder, with "{camera}" (name) or "{camera_index}"
            (index into ``cameras``), "{frame}" (number, any zero-padding), optionally "{split}".
        expected: by split, camera and frame: ``(H, W)`` of the ground truth as scored.
        cameras: of the dataset, in its order.
        background: of opaque images.

    Raises:
        ConfigError: when a field of the pattern is unknown or missing.
        DataError: when the folder does not exist, or an image is missing, is there twice,
            or has another size or more than 8 bits per channel.
    """
    fields = set(FIELD.findall(pattern))
    if not ("frame" in fields <= set(FIELDS) and fields & {"camera", "camera_index"}):
        raise ConfigError(
            f"predictions_pattern={pattern} must have {{frame}} and {{camera}} or "
            "{camera_index}, may have {split}, and no other field"
        )
    if not root.is_dir():
        raise DataError(f"predictions={root} is not a folder; give that of a method's images")
    stored: dict[str, list[str]] = {}
    for name in sorted(glob("**", root_dir=root, recursive=True)):
        stored.setdefault(_unpadded(name), []).append(name)
    files, missing = {}, []
    for split, sizes in expected.items():
        for (camera, frame), size in sizes.items():
            what = f"camera {camera}, frame {frame}"
            values = (split, camera, str(cameras.index(camera)), f"{frame:06d}")
            name = _filled(pattern, dict(zip(FIELDS, values, strict=True)))
            found = stored.get(_unpadded(name), [])
            if not found:
                missing.append(f"{what}, expected as {name}")
                continue
            if len(found) > 1:
                raise DataError(
                    f"{root} holds {what} twice, as {found[0]} and {found[1]}; keep one of them"
                )
            files[camera, frame] = found[0]
            check_picture(root / found[0], "image", size, f"the ground truth of {what}, as scored,")
    if missing:
        raise DataError(
            f"{root} lacks {len(missing)} of {len(missing) + len(files)} images; the first is "
            f"{missing[0]} (predictions_pattern={pattern})"
        )
    return PredictionFolder(root, files, background)


def _filled(pattern: str, values: Mapping[str, str]) -> str:
    return FIELD.sub(lambda field: values[field[1]], pattern)


def _unpadded(name: str) -> str:
    """The name with every number stripped of leading zeros."""
    return re.sub("[0-9]+", lambda digits: digits[0].lstrip("0") or "0", name)
