"""Calibration files of other tools, recognised by their content."""

from gsgan.data.calibration.find import Calibration, find_calibration, read_calibration

__all__ = ["Calibration", "find_calibration", "read_calibration"]
