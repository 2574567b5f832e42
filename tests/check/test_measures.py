"""Sampled images, units and settings."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from configs import check_limits, check_sampling
from make import edit_json, edit_npz

from gsgan.check.frames import reprojection_errors, skeleton_doubts
from gsgan.check.sections import geometry_findings, geometry_of
from gsgan.check.settings import Limits, Sampling
from gsgan.check.views import complete, measure, sample_items, subject_of
from gsgan.data.datamodule import GsganData
from gsgan.utils.errors import ConfigError

SAMPLING = check_sampling(images=8)


def test_images_are_the_same_moments_in_every_camera(subject):
    items = sample_items(subject, 12)
    frames = {
        camera: [f for c, f in items if c == camera]
        for camera in subject.cameras
    }
    assert set(map(tuple, frames.values())) == {(0, 6, 11)}


def test_joints_below_the_image_are_not_outside_its_mask(copy):
    """A camera that sees the upper body: images are padded to squares, which hold no mask."""
    for path in copy.glob("*/cam00/*.png"):
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:48])
    edit_json(
        copy / "cameras.json",
        lambda content: content["cam00"].update(size=[64, 48]),
    )
    subject = subject_of(GsganData(root=str(copy)))
    views = measure(subject, [("cam00", 3)], SAMPLING)[0]
    assert np.isnan(views[0].outside[25:]).all()
    assert views[0].has_joint.sum() > 12


def test_joints_far_from_their_detections_are_named(copy):
    def change(arrays):
        arrays["reproj_px"][3, 15] = 40.0
        arrays.update({key: value[::-1] for key, value in arrays.items()})

    edit_npz(copy / "landmarks3d.npz", change)
    subject = subject_of(GsganData(root=str(copy)))
    errors = reprojection_errors(subject)
    assert errors[3, 15] == pytest.approx(40)
    assert np.nanmedian(errors) == pytest.approx(0.2)
    found = skeleton_doubts(subject, check_limits())
    (doubt,) = (doubt for doubt in found if doubt.kind == "detections")
    assert (doubt.frame, doubt.text[:14]) == (
        subject.frames[3],
        "left_wrist 40 ",
    )


def test_units_of_a_good_capture(subject):
    found = geometry_of(subject)
    assert found.distances == pytest.approx(
        dict.fromkeys(subject.cameras, 3.0), abs=0.15
    )
    assert found.stature == pytest.approx(1.6, abs=0.2)
    assert found.lean < 5
    assert geometry_findings(subject, found) == []


def test_a_person_of_ten_metres_is_an_error(subject):
    tall = replace(geometry_of(subject), stature=10.0)
    (finding,) = geometry_findings(subject, tall)
    assert finding.level == "error"
    assert "10 m" in finding.sentence


@pytest.mark.parametrize(
    ("content", "whole"),
    [
        (b"\x89PNG\r\n\x1a\n....IEND\xaeB`\x82", True),
        (b"\x89PNG\r\n\x1a\n....", False),
        (b"\xff\xd8....\xff\xd9", True),
        (b"\xff\xd8....\xff\xd9\0\0", True),
        (b"\xff\xd8....", False),
        (b"", False),
    ],
)
def test_complete_files_have_an_end_mark(tmp_path, content, whole):
    path = tmp_path / "image"
    path.write_bytes(content)
    assert complete(path) == whole
    assert not complete(tmp_path / "absent")


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (
            lambda: check_sampling(images=0),
            r"sampling\.images.*0",
        ),
        (
            lambda: check_limits(outside="wide"),
            r"limits\.outside",
        ),
    ],
)
def test_settings_out_of_range_are_refused(make, named):
    with pytest.raises(ConfigError, match=named):
        make()


def test_every_setting_is_read():
    import re
    from dataclasses import fields
    from pathlib import Path

    import gsgan.check

    folder = Path(gsgan.check.__file__).parent
    code = "\n".join(
        p.read_text() for p in folder.glob("*.py") if p.stem != "settings"
    )
    for group in (Sampling, Limits):
        for field in fields(group):
            assert re.search(
                rf"\b{group.__name__.lower()}\.{field.name}\b", code
            ), field.name
