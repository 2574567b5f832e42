"""The scored region of an image and the variants of the metrics in published evaluations."""

from dataclasses import dataclass
from typing import Any, Literal

from gsgan.utils.errors import ConfigError

# Allowed values of the fields below.
CHOICES: dict[str, tuple[Any, ...]] = {
    "region": ("full", "body_box_cleared", "body_box"),
    "background": ("black", "white"),
    "lpips_region": ("full", "mask_crop_512"),
    "lpips_range": ((-1.0, 1.0), (0.0, 1.0)),
    "lpips_channels": ("rgb", "bgr"),
    "ssim_window": ("gaussian", "uniform"),
    "ssim_range": (1.0, 2.0),
    "psnr_pooling": ("image", "channels"),
    "eight_bits": ("none", "rounded", "cut"),
    "truth_outline": ("soft", "hard"),
}


@dataclass(frozen=True)
class MetricVariants:
    """The scored region of an image, and the variants of the metrics.

    Args:
        region: "full" image; "body_box_cleared", the full image with the prediction cleared to
            the background outside the body's projected 3D box; "body_box", PSNR inside that box
            only and SSIM on the rectangle around it, both images cleared outside.
        background: on which ground truth and prediction are compared.
        lpips_region: "full" image, or "mask_crop_512": the true mask and 50 px, in a square of
            the background, resized to 512.
        lpips_range: range of the backbone's input: [-1, 1] as it expects, or [0, 1] unscaled,
            which gives smaller values.
        lpips_channels: their order; "bgr" as in scripts that read images with OpenCV.
        ssim_window: "gaussian" of 11 pixels, or "uniform" of 7, scikit-image's default.
        ssim_range: of the values, as passed to SSIM: 1, or 2 as tools assume for floats in [-1, 1],
            which gives higher values.
        psnr_pooling: "image", one error for all channels; "channels", the mean of their PSNRs.
        eight_bits: whether predictions are "rounded" or "cut" to 8 bits first.
        truth_outline: "soft", composed on the background with its mask as alpha; "hard", the image
            where the mask is at least one half, and the background elsewhere.

    Raises:
        ConfigError: on an unknown value.

    Source: the publications' scoring scripts, which differ in these.
    """

    region: Literal["full", "body_box_cleared", "body_box"] = "full"
    background: Literal["black", "white"] = "black"
    lpips_region: Literal["full", "mask_crop_512"] = "full"
    lpips_range: tuple[float, float] = (-1.0, 1.0)
    lpips_channels: Literal["rgb", "bgr"] = "rgb"
    ssim_window: Literal["gaussian", "uniform"] = "gaussian"
    ssim_range: float = 1.0
    psnr_pooling: Literal["image", "channels"] = "image"
    eight_bits: Literal["none", "rounded", "cut"] = "none"
    truth_outline: Literal["soft", "hard"] = "soft"

    def __post_init__(self) -> None:
        # A config gives a list, which would equal no tuple.
        if isinstance(self.lpips_range, (list, tuple)):
            object.__setattr__(self, "lpips_range", tuple(self.lpips_range))
        for name, choices in CHOICES.items():
            # True and False equal 1 and 0, but are no choices.
            value = getattr(self, name)
            if isinstance(value, bool) or value not in choices:
                # Ranges are shown as lists, as a config writes them.
                listed = []
                for choice in choices:
                    shown = (
                        list(choice) if isinstance(choice, tuple) else choice
                    )
                    listed.append(str(shown))
                raise ConfigError(
                    f"protocol.measures.{name} must be {' or '.join(listed)}; got {value!r}"
                )

    @property
    def needs_body_box(self) -> bool:
        """Whether the region depends on the body's projected box."""
        return self.region != "full"
