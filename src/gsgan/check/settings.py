"""The amount of data that is checked, and the thresholds; conf/check.yaml explains every field.

Thresholds that a reader applies as well are those of `gsgan.data.formats.consistency.Consistency`.
"""

from dataclasses import dataclass

from gsgan.utils.checks import positive


@dataclass(frozen=True)
class Sampling:
    """The amount of a dataset that is checked, which decides the cost.

    Raises:
        ConfigError: when a value is not a number above 0.
    """

    images: int  # number that is decoded, evenly over cameras and frames
    size: int  # pixels, longest side at which masks are measured
    shown: int  # images per camera in the report
    workers: int  # threads that decode

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            positive(f"sampling.{name}", value)


@dataclass(frozen=True)
class Limits:
    """Thresholds above, or below, which something is reported.

    Raises:
        ConfigError: when a value is not a number above 0.
    """

    # minimum share of joints inside the masks of a camera
    inside_error: float
    fullness: float  # times the area of the estimated silhouette
    # overlap by which another calibration must fit better
    better_fit: float
    outside: float  # metres, mean of a camera's joints
    frame_outside: float  # share of one image's joints
    area_jump: float  # change of the mask's area over the silhouette's
    # metres from the midpoint of the neighbours in time
    joint_jump: float
    limb_share: float  # share of a limb's median length
    seen_share: float  # minimum share of the joints that are seen
    # of the focal length, a joint from its 2D detections
    reprojection: float
    doubtful: float  # share of the frames

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            positive(f"limits.{name}", value)
