"""Every format that has a reader, each with the writer that tests it: add yours to `FORMATS`."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from make import write_tiny_capture
from writers import zju
from writers.avatarrex import write_avatarrex
from writers.common import Subject
from writers.easymocap import write_easymocap
from writers.smplx_rig import smplx_once, smplx_subject
from writers.thuman4 import write_thuman4

from gsgan.data.formats.avatarrex import AvatarrexReader
from gsgan.data.formats.capture import read_capture
from gsgan.data.formats.easymocap import EasymocapReader
from gsgan.data.formats.thuman4 import Thuman4Reader
from gsgan.data.formats.zju import ZjuReader
from gsgan.data.layout import Layout
from gsgan.data.validation import Thresholds


@dataclass(frozen=True)
class Format:
    """How a subject is written into a new folder, and read with the subject's model file."""

    name: str
    write: Callable[[Path, Subject], object]
    read: Callable[[Path, Path], Layout]


def _zju(root: Path, smpl: Path) -> Layout:
    return ZjuReader()(root, Thresholds(), str(smpl))


def _odd(root: Path, subject: Subject) -> None:
    zju.write_313(root, subject, tuple(range(1, len(subject.cameras) + 1)))


def _capture(root: Path, subject: Subject) -> None:
    write_tiny_capture(root, labels=True, body_pose=True, meta={"body": "free"}, suffix="jpg")


def _thuman4(root: Path, _: Subject) -> None:
    write_thuman4(root, smplx_subject(smplx_once()), ("cam01\\00000002.jpg",))


def _avatarrex(root: Path, _: Subject) -> None:
    write_avatarrex(root, smplx_subject(smplx_once()))


FORMATS = (
    Format("capture", _capture, lambda root, smpl: read_capture(root)),
    Format("zju_original", zju.write_original, _zju),
    Format("zju_313", _odd, _zju),
    Format("zju_refined", zju.write_refined, _zju),
    Format(
        "thuman4", _thuman4, lambda root, _: Thuman4Reader()(root, Thresholds(), str(smplx_once()))
    ),
    Format(
        "avatarrex",
        _avatarrex,
        lambda root, _: AvatarrexReader()(root, Thresholds(), str(smplx_once())),
    ),
    Format("easymocap", write_easymocap, lambda root, _: EasymocapReader()(root, Thresholds())),
    Format(
        "easymocap_smpl",
        write_easymocap,
        lambda root, smpl: EasymocapReader()(root, Thresholds(), str(smpl)),
    ),
)
COMMON = ("capture", "zju_original", "thuman4", "easymocap")
PARAMETERS = [
    pytest.param(kind, id=kind.name, marks=() if kind.name in COMMON else pytest.mark.slow)
    for kind in FORMATS
]
"""All formats; those that share most code with a common one are for the slow tests."""
