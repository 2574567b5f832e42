"""Which calibrated camera took which video: by name, never by position."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from gsgan.data.cameras import CameraEntry
from gsgan.utils.errors import DataError


def pair_cameras(
    sources: Sequence[str], cameras: Sequence[str], given: Mapping[str, object]
) -> dict[str, str]:
    """The calibrated camera of each source.

    Convention: what ``given`` says; else the same name, upper or lower case; else the one camera
    whose name stands between separators in the source's name ("Miqus_5_21474": 21474).

    Args:
        sources: names of videos or picture folders.
        cameras: names in the calibration.
        given: source name to camera name.

    Raises:
        DataError: when a source has no camera or two have the same, listing both sides.
    """
    both = f"videos: {', '.join(sources)}; calibration: {', '.join(cameras)}"
    for source, camera in given.items():
        if str(source) not in sources or str(camera) not in cameras:
            raise DataError(f"cameras={{{source}: {camera}}} names what is not there ({both})")
    pairs = {str(source): str(camera) for source, camera in given.items()}
    for source in sources:
        if source not in pairs:
            fitting = _fitting(source, cameras)
            if len(fitting) != 1:
                raise DataError(
                    f"no one camera of the calibration fits the video {source} ({both}); say which "
                    f"with cameras={{{source}: <calibration name>, …}}"
                )
            pairs[source] = fitting[0]
    taken = list(pairs.values())
    if twice := sorted({camera for camera in taken if taken.count(camera) > 1}):
        raise DataError(
            f"the camera {twice[0]} of the calibration fits more than one video ({both}); say "
            "which with cameras={video: calibration name, …}"
        )
    return {source: pairs[source] for source in sources}


def _fitting(source: str, cameras: Sequence[str]) -> list[str]:
    if source in cameras:
        return [source]
    alike = [camera for camera in cameras if camera.lower() == source.lower()]
    if alike:
        return alike
    words = re.split(r"[^0-9a-z]+", source.lower())
    return [camera for camera in cameras if camera.lower() in words]


def fit_size(
    camera: CameraEntry, name: str, size: tuple[int, int], crop_px: int, where: Path
) -> tuple[CameraEntry, str | None]:
    """A camera with its source's name and picture size, and a note when the sizes differ.

    Convention: a few missing columns or rows were cut off at the right or bottom, where codecs cut,
    so K stays.

    Args:
        camera: as calibrated; a size of (0, 0) is unknown.
        name: of the source.
        size: ``(H, W)`` of its pictures.
        crop_px: most pixels that may be missing.
        where: the calibration file.

    Raises:
        DataError: when the sizes differ by more: the calibration is another resolution's.
    """
    fitted = replace(camera, name=name, size=size)
    if camera.size in (size, (0, 0)):
        return fitted, None
    (h, w), (H, W) = size, camera.size
    if max(abs(H - h), abs(W - w)) > crop_px:
        raise DataError(
            f"{where}: the camera {camera.name} is calibrated for {W}x{H} pixels, but the pictures "
            f"of {name} have {w}x{h}; calibrate at that size, or convert the video back"
        )
    return fitted, (
        f"{name}: {w}x{h} pixels, calibrated as {W}x{H}; taken as cut at the right and bottom"
    )
