"""The scores that a table can show: headings, digits, which way is better."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Metric:
    """How one score is shown.

    Args:
        heading: of its column.
        digits: after the point.
        better: ``↑`` the higher, ``↓`` the lower, ``→1`` the nearer to one.
    """

    heading: str
    digits: int
    better: str


METRICS = {
    "psnr": Metric("PSNR dB", 2, "↑"),
    "psnr_person": Metric("PSNR dB in box", 2, "↑"),
    "ssim": Metric("SSIM", 4, "↑"),
    "ssim_person": Metric("SSIM in box", 4, "↑"),
    "lpips": Metric("LPIPS", 4, "↓"),
    "edge_f1": Metric("edge F1", 3, "↑"),
    "edge_ratio": Metric("edges", 3, "→1"),
    "high_frequencies": Metric("detail", 3, "→1"),
    "miou": Metric("mIoU", 4, "↑"),
    "miou_with_background": Metric("mIoU with background", 4, "↑"),
}
MINUS = "−"


def heading(metric: str) -> str:
    """A column's heading with the direction that is better."""
    return f"{METRICS[metric].heading} {METRICS[metric].better}"


def shown(metric: str, value: float, *, signed: bool = False) -> str:
    """A value with the metric's digits, and a real minus; never a minus before zero."""
    text = f"{value:{'+' if signed else ''}.{METRICS[metric].digits}f}"
    if float(text) == 0:
        text = text.lstrip("+-")
    return text.replace("-", MINUS)
