"""How much is checked, and the thresholds; conf/check.yaml gives the reason for each value.

Thresholds that a reader applies as well are those of `gsgan.data.formats.trust.Trust`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from gsgan.utils.errors import ConfigError


def _check_positive(owner: str, record: Any) -> None:
    for field in fields(record):
        value = getattr(record, field.name)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not value > 0:
            raise ConfigError(f"{owner}.{field.name} must be a number above 0, got {value!r}")


@dataclass(frozen=True)
class Sampling:
    """How much of a dataset is checked: the cost.

    Args:
        pictures: images decoded in all, evenly over cameras and frames.
        size: pixels, longest side at which masks are measured.
        trials: other calibrations tried in all.
        size_ratio: a mask file this many times smaller or larger than its camera's median is
            decoded as well.
        hull_frames: moments at which a visual hull is carved.
        lag: frames by which a camera is tried earlier and later.
        shown: images per camera in the report.
        tile: pixels, height of those.
        workers: threads that decode.

    Raises:
        ConfigError: when a value is not a number above 0.
    """

    pictures: int = 200
    size: int = 384
    trials: int = 6000
    size_ratio: float = 2.5
    hull_frames: int = 4
    lag: int = 4
    shown: int = 6
    tile: int = 360
    workers: int = 2

    def __post_init__(self) -> None:
        _check_positive("sampling", self)


@dataclass(frozen=True)
class Limits:
    """Thresholds above, or below, which something is reported.

    Args:
        inside_error: share of a camera's joints inside its masks.
        fullness: area of a camera's masks over that of the estimated silhouette, median.
        better_fit: gain in overlap by which another calibration, or a shift, must fit better.
        shift: metres by which a camera's masks may lie beside its skeleton.
        lag_gain: share of the joints' mean distance from the mask that a shift in time removes.
        outside, outside_all: metres that the joints of one camera, and of all cameras, may lie
            outside the masks on average.
        hull_warning: share of a mask that the visual hull must fill, per camera.
        height_warning_low, height_warning_high: metres, stature estimated from limb lengths.
        lean: degrees between the trunk and the up axis, median over frames.
        frame_outside: share of joints outside the mask that makes an image doubtful.
        box_reach: metres by which the boxes of mask and estimated silhouette may differ.
        area_jump: share by which a mask's area relative to the silhouette's may differ from the
            camera's median.
        joint_jump: metres from the midpoint of the joint's neighbours in time.
        limb_share: share by which a limb's length may differ from its median.
        frozen_frames: identical frames in a row.
        seen_share: share of the joints that any frame has which a frame must have.
        reprojection_frame, reprojection_joint: distance of joints from their 2D detections, a
            frame's median and a single joint, as a share of the focal length.
        colour_ratio: of a camera's mean colour to the median camera's.
        distrust: share of doubtful frames that is an error.

    Raises:
        ConfigError: when a value is not a number above 0.
    """

    inside_error: float = 0.7
    fullness: float = 2.0
    better_fit: float = 0.05
    shift: float = 0.06
    lag_gain: float = 0.3
    outside: float = 0.004
    outside_all: float = 0.008
    hull_warning: float = 0.9
    height_warning_low: float = 1.2
    height_warning_high: float = 2.1
    lean: float = 50.0
    frame_outside: float = 0.3
    box_reach: float = 0.4
    area_jump: float = 0.35
    joint_jump: float = 0.2
    limb_share: float = 0.3
    frozen_frames: int = 5
    seen_share: float = 0.7
    reprojection_frame: float = 0.02
    reprojection_joint: float = 0.05
    colour_ratio: float = 1.15
    distrust: float = 0.5

    def __post_init__(self) -> None:
        _check_positive("limits", self)
