"""The named settings of a check: how much to look at, and from where on something is wrong."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from gsgan.utils.errors import ConfigError


def _positive(owner: str, record: Any) -> None:
    for field in fields(record):
        value = getattr(record, field.name)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not value > 0:
            raise ConfigError(f"{owner}.{field.name} must be a number above 0, got {value!r}")


@dataclass(frozen=True)
class Sampling:
    """How much of a dataset is looked at: what the check costs.

    Args:
        pictures: decoded in all, evenly over cameras and frames.
        size: pixels, longest side at which masks are measured.
        small: pixels, longest side at which calibrations are tried and hulls carved.
        trials: calibrations tried in all, a camera on another's pictures.
        trial_frames: pictures a camera on which they are tried, where ``trials`` allows.
        tails: files whose last bytes are read, so that one cut off while copying is found.
        size_ratio: times by which a mask file must be smaller or larger than its camera's median
            to be looked at.
        hull_frames: moments at which a visual hull is carved.
        hull_voxel: metres, edge of its voxels.
        lag: frames by which a camera is tried earlier and later.
        shown: pictures a camera in the report.
        tile: pixels, height of those.
        workers: threads that decode.

    Raises:
        ConfigError: when a value is not a number above 0.
    """

    pictures: int = 200
    size: int = 384
    small: int = 128
    trials: int = 6000
    trial_frames: int = 8
    tails: int = 20000
    size_ratio: float = 2.5
    hull_frames: int = 4
    hull_voxel: float = 0.04
    lag: int = 4
    shown: int = 6
    tile: int = 360
    workers: int = 2

    def __post_init__(self) -> None:
        _positive("sampling", self)


@dataclass(frozen=True)
class Limits:
    """From where on something is told; conf/check.yaml gives the reason of each.

    Args:
        joint_tolerance: metres a joint may lie outside the mask.
        pixel_tolerance: the same in pixels of the measured mask; the larger of the two counts.
        flesh: metres of body round every bone, for the silhouette that a skeleton foretells.
        inside_warning, inside_error: share of joints inside the mask, per camera.
        fullness: area of a camera's masks over that of the foretold body, median.
        better_fit, credible_overlap: gain in overlap, and overlap, that another calibration must
            reach to be named.
        shift: metres by which a camera's masks may lie beside its skeleton.
        lag_gain, lag_metres, lag_left: share and amount of the joints' mean distance from the mask
            that a shift in time must remove, and metres that it may leave.
        outside, outside_ratio: metres that a camera's joints may lie outside its masks on the mean,
            and times the other cameras' median; both must be passed.
        outside_all: the same metres for all cameras together.
        hull_warning: share of a mask that the visual hull must fill, per camera.
        hull_gain: gain in that share, when one camera is left out, that names it.
        camera_distance: a camera this many times nearer or farther than the median is in doubt.
        height_warning_low, height_warning_high, height_error_low, height_error_high: metres,
            stature that the limb lengths speak for.
        lean: degrees between the trunk and the up axis, median over frames.
        frame_outside: share of a camera's joints outside the mask that makes a frame doubtful.
        box_reach: metres that the mask's box may differ from the foretold body's.
        area_jump: share by which a mask's area may differ from what the body foretells, set
            against the camera's median.
        joint_jump, jump_ratio: metres from the middle of the joint's neighbours in time, and times
            what is usual (the upper quartile of all joints); both must be passed.
        limb_share, limb_metres: how far a limb's length may be off its median; both must be passed.
        frozen_frames: equal frames in a row.
        rigid_share: a joint whose bones keep their length to this share is a computed one, which
            may stand exactly still.
        seen_share: joints of a frame that must have been seen, of those that any frame has.
        swap_ratio, swap_metres: left and right count as swapped when exchanging them brings a body
            part this many times nearer to, and this much nearer along, its own track.
        mirrored: share of frames that face backwards.
        reprojection_frame, reprojection_joint: distance of joints from their 2D detections, a
            frame's median and one joint's, as a share of the focal length.
        colour_ratio: of a camera's mean colour to the median camera's.
        distrust: share of doubtful frames that is an error.

    Raises:
        ConfigError: when a value is not a number above 0.
    """

    joint_tolerance: float = 0.05
    pixel_tolerance: float = 1.5
    flesh: float = 0.07
    inside_warning: float = 0.9
    inside_error: float = 0.7
    fullness: float = 2.0
    better_fit: float = 0.05
    credible_overlap: float = 0.35
    shift: float = 0.06
    lag_gain: float = 0.3
    lag_metres: float = 0.002
    lag_left: float = 0.01
    outside: float = 0.004
    outside_ratio: float = 3.0
    outside_all: float = 0.008
    hull_warning: float = 0.9
    hull_gain: float = 0.1
    camera_distance: float = 4.0
    height_warning_low: float = 1.2
    height_warning_high: float = 2.1
    height_error_low: float = 0.4
    height_error_high: float = 3.0
    lean: float = 50.0
    frame_outside: float = 0.3
    box_reach: float = 0.4
    area_jump: float = 0.35
    joint_jump: float = 0.2
    jump_ratio: float = 4.0
    limb_share: float = 0.3
    limb_metres: float = 0.06
    frozen_frames: int = 5
    rigid_share: float = 0.05
    seen_share: float = 0.7
    swap_ratio: float = 2.0
    swap_metres: float = 0.06
    mirrored: float = 0.5
    reprojection_frame: float = 0.02
    reprojection_joint: float = 0.05
    colour_ratio: float = 1.15
    distrust: float = 0.5

    def __post_init__(self) -> None:
        _positive("limits", self)
        for low, high in (
            ("inside_error", "inside_warning"),
            ("height_error_low", "height_warning_low"),
            ("height_warning_high", "height_error_high"),
        ):
            if getattr(self, low) > getattr(self, high):
                raise ConfigError(f"limits.{low} must not be above limits.{high}")
