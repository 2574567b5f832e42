"""Hull, colours, reprojection, units and settings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsgan.check.charts import rig_drawing, series_chart
from gsgan.check.colours import score_colours
from gsgan.check.hull import carvings, judge_hulls, score_hulls
from gsgan.check.looking import chosen_items, look_at
from gsgan.check.reprojection import far_frames, judge_reprojection, read_reprojection
from gsgan.check.rig import axis_name, ground_axes, judge_rig, rig_of
from gsgan.check.settings import Limits, Sampling
from gsgan.check.subject import evenly
from gsgan.check.suspects import finished
from gsgan.data.crop import project
from gsgan.utils.errors import ConfigError, DataError

SAMPLING = Sampling(pictures=8, hull_frames=1)


@pytest.fixture
def looks(subject):
    return look_at(subject, chosen_items(subject, 8), Limits(), SAMPLING)[0]


def test_the_hull_of_good_masks_fills_them(subject, looks):
    score = score_hulls(carvings(subject, looks, SAMPLING))
    assert all(share > 0.95 for share in score.filled.values())
    assert judge_hulls(score, Limits()) == []


def test_a_mask_of_elsewhere_is_named_by_the_hull_alone(subject, looks):
    wrong = [
        replace(look, mask=np.roll(look.mask, 12, axis=1)) if look.camera == "cam02" else look
        for look in looks
    ]
    score = score_hulls(carvings(subject, wrong, SAMPLING))
    (finding,) = judge_hulls(score, Limits())
    assert "without camera cam02" in finding.sentence
    assert judge_hulls(score, Limits(), frozenset({"cam02"})) == []


def test_two_cameras_cannot_tell_which_is_wrong(subject, looks):
    two = [look for look in looks if look.camera in ("cam00", "cam01")]
    assert score_hulls(carvings(subject, two, SAMPLING)) is None


def test_gains_are_measured_on_shared_surface(subject, looks):
    gains = {"cam00": 1.0, "cam01": 0.7, "cam02": 1.0, "cam03": 1.2}
    lit = [
        replace(look, image=0.5 * gains[look.camera] * look.soft[..., None].repeat(3, -1))
        for look in looks
    ]
    colours = score_colours(lit, carvings(subject, lit, SAMPLING))
    for name, gain in gains.items():
        assert colours[name].gain == pytest.approx([gain] * 3, rel=1e-3)


def test_pictures_are_the_same_moments_in_every_camera(subject):
    items = chosen_items(subject, 12)
    frames = {camera: [f for c, f in items if c == camera] for camera in subject.cameras}
    assert set(map(tuple, frames.values())) == {(0, 6, 11)}


def test_evenly():
    assert evenly((3, 4, 5), 5) == (3, 4, 5)
    assert evenly(tuple(range(10)), 3) == (0, 4, 9)
    assert evenly(tuple(range(10)), 1) == (0,)


def test_reprojection_of_stored_distances(subject):
    found = read_reprojection(subject)
    assert found.source.startswith("reproj_px")
    assert found.median == pytest.approx(0.2)
    assert judge_reprojection(found, Limits()) == []


def test_stored_distances_are_not_those_of_fitted_landmarks(subject):
    fitted = replace(subject.layout.landmarks, fitted_to=("cam00",))
    moved = replace(subject, layout=replace(subject.layout, landmarks=fitted))
    assert read_reprojection(moved) is None


def test_reprojection_of_detections_is_measured_by_camera(subject, tmp_path):
    root = tmp_path / "capture"
    (root / "landmarks2d").mkdir(parents=True)
    ids = subject.frames
    for name, camera in subject.cameras.items():
        pixels = project(camera, subject.p)[0]
        pixels[..., 0] += 5.0 if name == "cam01" else 0.5
        pixels[3, 15] += 40.0
        np.savez(root / f"landmarks2d/{name}.npz", p=pixels[::-1], frame_id=ids[::-1])
    moved = replace(subject, layout=replace(subject.layout, root=root))
    found = read_reprojection(moved)
    assert found.by_camera == pytest.approx(
        {"cam00": 0.5, "cam01": 5.0, "cam02": 0.5, "cam03": 0.5}
    )
    (finding,) = judge_reprojection(found, Limits())
    assert finding.sentence.startswith("camera cam01")
    medians, worst = far_frames(found, Limits(reprojection_frame=0.05))
    assert np.flatnonzero(~np.isnan(worst)).tolist() == [3]
    assert np.isnan(medians).all()


class Counted(np.ndarray):
    """An array that counts how often it is walked through."""

    walks = 0

    def __iter__(self):
        Counted.walks += 1
        return super().__iter__()


def test_thousands_of_frames_are_indexed_once(subject, tmp_path):
    (tmp_path / "landmarks2d").mkdir()
    count = 3000
    p = np.resize(subject.p, (count, *subject.p.shape[1:]))
    for name, camera in subject.cameras.items():
        pixels = project(camera, p)[0]
        np.savez(tmp_path / f"landmarks2d/{name}.npz", p=pixels, frame_id=np.arange(count))
    long = replace(
        subject,
        layout=replace(subject.layout, root=tmp_path),
        frames=np.arange(count).view(Counted),
        p=p,
        visible=np.resize(subject.visible, p.shape[:2]),
    )
    assert read_reprojection(long).median == pytest.approx(0, abs=1e-3)
    assert Counted.walks == 1


def test_damaged_detections_are_said(subject, tmp_path):
    root = tmp_path / "capture"
    (root / "landmarks2d").mkdir(parents=True)
    np.savez(root / "landmarks2d/cam00.npz", p=np.zeros((3, 33, 3)), frame_id=np.arange(3))
    with pytest.raises(DataError, match=r"cam00\.npz: 'p' must have shape"):
        read_reprojection(replace(subject, layout=replace(subject.layout, root=root)))


def test_units_of_a_good_capture(subject):
    rig = rig_of(subject)
    assert rig.distances == pytest.approx(dict.fromkeys(subject.cameras, 3.0), abs=0.15)
    assert rig.gaps == pytest.approx([90] * 4, abs=3)
    assert rig.stature == pytest.approx(1.6, abs=0.2)
    assert rig.lean < 5
    assert judge_rig(subject, rig, Limits()) == []


def test_a_person_of_ten_metres_is_an_error(subject):
    rig = replace(rig_of(subject), stature=10.0)
    (finding,) = judge_rig(subject, rig, Limits())
    assert finding.level == "error"
    assert "10 m" in finding.sentence


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_ground_axes_are_right_handed_with_up(axis, sign):
    up = np.zeros(3)
    up[axis] = sign
    first, second = ground_axes(up)
    assert np.cross(first, second) == pytest.approx(up)
    assert axis_name(up) == ("" if sign > 0 else "-") + "xyz"[axis]


def test_drawings_are_svg_with_every_camera(subject):
    import xml.etree.ElementTree as tree

    drawing = tree.fromstring(rig_drawing(subject))
    words = {text.text for text in drawing.iter("{http://www.w3.org/2000/svg}text")}
    assert set(subject.cameras) <= words
    held = {"a<b": ([0, 1, 2, 3], [0.1, np.nan, 0.5, np.inf])}
    chart = tree.fromstring(series_chart("x & y", [0, 3], held, limit=0.3))
    words = {text.text for text in chart.iter("{http://www.w3.org/2000/svg}text")}
    assert {"a<b", "x & y", "0.5"} <= words


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
def test_whole_files_are_told_by_their_end(tmp_path, content, whole):
    path = tmp_path / "picture"
    path.write_bytes(content)
    assert finished(path) == whole
    assert not finished(tmp_path / "absent")


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: Sampling(pictures=0), r"sampling\.pictures must be a number above 0"),
        (lambda: Limits(flesh="thick"), r"limits\.flesh must be a number above 0"),
        (lambda: Limits(inside_error=0.95), r"limits\.inside_error must not be above"),
    ],
)
def test_settings_refuse_what_makes_no_sense(make, named):
    with pytest.raises(ConfigError, match=named):
        make()


def test_settings_are_those_of_the_config(compose):
    from hydra.utils import instantiate

    config = compose("check")
    assert instantiate(config.sampling) == Sampling()
    assert instantiate(config.limits) == Limits()


def test_every_setting_is_read():
    import re
    from dataclasses import fields
    from pathlib import Path

    import gsgan.check

    folder = Path(gsgan.check.__file__).parent
    code = "\n".join(p.read_text() for p in folder.glob("*.py") if p.stem != "settings")
    for group in (Sampling, Limits):
        for field in fields(group):
            assert re.search(rf"\b{group.__name__.lower()}\.{field.name}\b", code), field.name
