"""Hull, colours, reprojection, units and settings."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from gsgan.check.agreement import colour_findings, hull_findings, mean_colours, score_hulls
from gsgan.check.charts import Series, rig_drawing, series_chart
from gsgan.check.frames import doubts, motion_of
from gsgan.check.report import counted, listed
from gsgan.check.reprojection import read_reprojection, reprojection_findings
from gsgan.check.rig import axis_name, ground_axes, rig_findings, rig_of
from gsgan.check.settings import Limits, Sampling
from gsgan.check.views import complete, measure, sampled_items
from gsgan.data.crop import project
from gsgan.data.formats.trust import spread
from gsgan.effects import EffectSettings
from gsgan.utils.errors import ConfigError, DataError

SAMPLING = Sampling(pictures=8, hull_frames=1)


@pytest.fixture
def views(subject):
    return measure(subject, sampled_items(subject, 8), SAMPLING)[0]


def test_the_hull_of_good_masks_fills_them(subject, views):
    score = score_hulls(subject, views, 1)
    assert all(share > 0.95 for share in score.filled.values())
    assert hull_findings(score, Limits()) == []


def test_a_mask_of_elsewhere_is_named_by_the_hull_alone(subject, views):
    wrong = [
        replace(view, mask=np.roll(view.mask, 12, axis=1)) if view.camera == "cam02" else view
        for view in views
    ]
    (finding,) = hull_findings(score_hulls(subject, wrong, 1), Limits())
    assert "without camera cam02" in finding.sentence


def test_two_cameras_cannot_show_which_is_wrong(subject, views):
    two = [view for view in views if view.camera in ("cam00", "cam01")]
    assert score_hulls(subject, two, 1) is None


@pytest.mark.parametrize(("difference", "named"), [(None, True), (0.01, False), (0.2, True)])
def test_colours_are_named_unless_shared_surface_agrees(views, difference, named):
    """One camera is darker; the measure on shared surface decides whether exposure is the cause."""
    dark = [replace(v, colour=v.colour * (0.7 if v.camera == "cam01" else 1)) for v in views]
    surface = None if difference is None else SimpleNamespace(difference=difference)
    names = ("cam00", "cam01", "cam02", "cam03")
    info = SimpleNamespace(surface=surface, train_cameras=names)
    colours = mean_colours(dark)
    found = colour_findings(colours, info, EffectSettings(), Limits(colour_ratio=1.2))
    assert ["cam01 red 0.7" in finding.sentence for finding in found] == [True] * named
    held_out = SimpleNamespace(surface=surface, train_cameras=("cam00", "cam02"))
    assert colour_findings(colours, held_out, EffectSettings(), Limits(colour_ratio=1.2))


def test_pictures_are_the_same_moments_in_every_camera(subject):
    items = sampled_items(subject, 12)
    frames = {camera: [f for c, f in items if c == camera] for camera in subject.cameras}
    assert set(map(tuple, frames.values())) == {(0, 6, 11)}


def test_values_are_spread():
    assert spread((3, 4, 5), 5) == [3, 4, 5]
    assert spread(range(10), 3) == [0, 4, 9]
    assert spread(range(10), 1) == [0]
    assert spread([], 3) == []


def test_reprojection_of_stored_distances(subject):
    found = read_reprojection(subject)
    assert found.source.startswith("reproj_px")
    assert found.median == pytest.approx(0.2)
    assert reprojection_findings(found, Limits()) == []


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
    (finding,) = reprojection_findings(found, Limits())
    assert finding.sentence.startswith("camera cam01")
    limits = Limits(reprojection_frame=0.05)
    doubted = doubts(moved, [], motion_of(moved, limits), found, limits)
    (doubt,) = (doubt for doubt in doubted if doubt.kind == "detections")
    assert doubt.frame == subject.frames[3]
    assert doubt.text.startswith("left_wrist ")


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


def test_damaged_detections_are_reported(subject, tmp_path):
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
    assert rig_findings(subject, rig, Limits()) == []


def test_a_person_of_ten_metres_is_an_error(subject):
    rig = replace(rig_of(subject), stature=10.0)
    (finding,) = rig_findings(subject, rig, Limits())
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

    drawing = rig_drawing(subject)
    tree.fromstring(drawing)
    assert all(f"<!-- {name} -->".encode() in drawing for name in subject.cameras)
    lines = {"a<b": ([0, 1, 2, 3], [0.1, np.nan, 0.5, np.inf]), "c": ([0], [1.0])}
    chart = series_chart([Series("x & y", lines, limit=0.3)], frozenset({2}))
    tree.fromstring(chart)
    assert b"<!-- a&lt;b -->" in chart
    assert b"<!-- x &amp; y -->" in chart


def test_counts_and_lists():
    assert (counted(1, "error"), counted(2, "error")) == ("1 error", "2 errors")
    assert listed(range(8)) == "0, 1, 2, 3, 4, 5 and 2 more"


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
    path = tmp_path / "picture"
    path.write_bytes(content)
    assert complete(path) == whole
    assert not complete(tmp_path / "absent")


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: Sampling(pictures=0), r"sampling\.pictures must be a number above 0"),
        (lambda: Limits(shift="wide"), r"limits\.shift must be a number above 0"),
    ],
)
def test_settings_out_of_range_are_refused(make, named):
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
