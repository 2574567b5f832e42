"""Calibration files of other tools, told apart by what is in them."""

from gsgan.data.calibration.find import Calibration, find_calibration, read_calibration

__all__ = ["Calibration", "find_calibration", "read_calibration"]
