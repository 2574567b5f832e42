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

    images: int = 200  # number that is decoded, evenly over cameras and frames
    size: int = 384  # pixels, longest side at which masks are measured
    shown: int = 6  # images per camera in the report
    workers: int = 2  # threads that decode

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
    inside_error: float = 0.7
    fullness: float = 2.0  # times the area of the estimated silhouette
    # overlap by which another calibration must fit better
    better_fit: float = 0.05
    outside: float = 0.004  # metres, mean of a camera's joints
    frame_outside: float = 0.3  # share of one image's joints
    area_jump: float = 0.35  # change of the mask's area over the silhouette's
    # metres from the midpoint of the neighbours in time
    joint_jump: float = 0.2
    limb_share: float = 0.3  # share of a limb's median length
    seen_share: float = 0.7  # minimum share of the joints that are seen
    # of the focal length, a joint from its 2D detections
    reprojection: float = 0.05
    doubtful: float = 0.5  # share of the frames

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            positive(f"limits.{name}", value)
