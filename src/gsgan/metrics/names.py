"""Variants and metrics of an evaluation by their key in metrics.json, as tables print them."""

from typing import NamedTuple

FULL = "full"  # the final image
SPLAT = "splat"  # Step I's colour
FLOOR_VARIANT = "floor"  # the all-background image
VARIANTS = {
    FULL: "final image",
    SPLAT: "Step I's colour",
    FLOOR_VARIANT: "floor: background",
}


class Metric(NamedTuple):
    """The printed form of a metric.

    Args:
        name: in tables of several methods.
        short: in the narrow table of one method.
        digits: after the point.
        better: ``↑``, ``↓``, ``→1`` (near 1), or empty if no direction is better.
    """

    name: str
    short: str
    digits: int
    better: str

    @property
    def heading(self) -> str:
        """A column's heading with the direction that is better."""
        return f"{self.name} {self.better}".rstrip()

    @property
    def short_heading(self) -> str:
        """A narrow column's heading with the direction that is better."""
        return f"{self.short} {self.better}".rstrip()


IMAGE_METRICS = {
    # name, short name, digits, direction that is better
    "psnr": Metric("PSNR dB", "PSNR", 2, "↑"),
    "psnr_person": Metric("PSNR dB in box", "in box", 2, "↑"),
    "psnr_inside": Metric(
        "PSNR dB in box off the outline", "off the outline", 2, "↑"
    ),
    "psnr_person_shifted": Metric("PSNR dB in box, shifted", "shifted", 2, "↑"),
    "ssim": Metric("SSIM", "SSIM", 4, "↑"),
    "ssim_person": Metric("SSIM in box", "SSIM in box", 4, "↑"),
    "lpips_vgg": Metric("LPIPS-VGG", "LPIPS-VGG", 4, "↓"),
    "lpips_vgg_person": Metric("LPIPS-VGG in box", "VGG in box", 4, "↓"),
    "lpips_alex": Metric("LPIPS-Alex", "LPIPS-Alex", 4, "↓"),
    "lpips_alex_person": Metric("LPIPS-Alex in box", "Alex in box", 4, "↓"),
    # edges and other detail
    "edge_f1": Metric("edge F1", "edge F1", 3, "↑"),
    "edge_f1_person": Metric("edge F1 in box", "edge F1 in box", 3, "↑"),
    "edge_ratio": Metric("edges", "edges", 3, "→1"),
    "edge_ratio_person": Metric("edges in box", "edges in box", 3, "→1"),
    "high_frequencies": Metric("HF energy", "HF energy", 3, "→1"),
    "flicker": Metric("flicker in box", "flicker", 4, "↓"),
    "warped_flicker": Metric("warped flicker", "warped flicker", 4, "↓"),
    # shares of the person's area and of the squared error there
    "area_outline": Metric("area, outline", "area, outline", 3, ""),
    "error_outline": Metric("error, outline", "error, outline", 3, ""),
    "area_trunk": Metric("area, trunk", "area, trunk", 3, ""),
    "error_trunk": Metric("error, trunk", "error, trunk", 3, ""),
    "area_limbs": Metric("area, limbs", "area, limbs", 3, ""),
    "error_limbs": Metric("error, limbs", "error, limbs", 3, ""),
    # hands and mouth
    "psnr_hands": Metric("PSNR dB hands", "hands", 2, "↑"),
    "ssim_hands": Metric("SSIM hands", "SSIM hands", 4, "↑"),
    "psnr_mouth": Metric("PSNR dB mouth", "mouth", 2, "↑"),
    "ssim_mouth": Metric("SSIM mouth", "SSIM mouth", 4, "↑"),
}
# of two consecutive frames
MOTION_METRICS = ("flicker", "warped_flicker")
# by part labels
LABEL_METRICS = ("area_trunk", "error_trunk", "area_limbs", "error_limbs")
# in the boxes of hands and mouth
BOX_METRICS = ("psnr_hands", "ssim_hands", "psnr_mouth", "ssim_mouth")
# of segmentations
PART_METRICS = {
    "miou": Metric("mIoU", "mIoU", 4, "↑"),
    "miou_with_background": Metric(
        "mIoU with background", "with background", 4, "↑"
    ),
}
METRICS = IMAGE_METRICS | PART_METRICS
