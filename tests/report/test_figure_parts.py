"""The parts of the figures, on images whose numbers are known."""

import numpy as np
import pytest
import torch
from matplotlib import rc_context

from gsgan.report.figures.details import detail_boxes
from gsgan.report.figures.layout import (
    COLUMN_WIDTH,
    STYLE,
    TALLEST,
    Panel,
    draw_panels,
    format_number,
)
from gsgan.report.figures.run import most_disputed
from gsgan.report.figures.subjects import choose_items, make_shots, measure
from gsgan.scene import Camera
from gsgan.skeleton import TEMPLATES
from gsgan.utils.errors import ConfigError, DataError


def rendered(figure) -> np.ndarray:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


def test_measures_in_closed_form():
    truth = torch.zeros(1, 3, 16, 16)
    truth[..., 4:12, 4:12] = 0.8
    found = measure(truth + 0.1, truth)
    assert found["psnr"] == pytest.approx(20, abs=1e-4)
    assert found["edge_f1"] == 1
    same = measure(truth, truth)
    assert same["psnr"] is None  # infinite
    blank = measure(truth, torch.zeros_like(truth))
    assert blank["edge_f1"] is None
    assert format_number(None, 2, " dB") == "n/a"


def test_the_box_lies_where_the_runs_differ():
    runs = torch.zeros(3, 3, 20, 10)
    runs[1, :, 12:16, 6:9] = 1.0
    rows, columns = most_disputed(runs, 0.3)
    assert (rows.stop - rows.start, columns.stop - columns.start) == (6, 3)
    assert rows.start <= 12
    assert rows.stop >= 16
    assert (columns.start, columns.stop) == (6, 9)
    whole = most_disputed(torch.zeros(2, 3, 5, 5), 1.0)
    assert whole == (slice(0, 5), slice(0, 5))


@pytest.mark.parametrize("name", ["mediapipe33", "mediapipe33_hands"])
def test_details_are_squares_that_hold_the_head_and_the_hands(name):
    template = TEMPLATES[name]
    K = torch.tensor([[[200.0, 0, 100], [0, 200, 200], [0, 0, 1]]])
    R = torch.diag(torch.tensor([1.0, -1, -1]))[None]
    camera = Camera(K, R, torch.tensor([[0.0, 1.0, 2.5]]), size=(400, 200))
    skeleton = torch.tensor([template.rest_positions])
    visibility = torch.ones(1, len(template.names))
    boxes = detail_boxes(template, skeleton, visibility, camera)
    assert list(boxes) == ["head", "left hand", "right hand"]
    pixels, _ = camera.project(skeleton)
    for part, joint in (
        ("head", "nose"),
        ("left hand", "left_index"),
        ("right hand", "right_wrist"),
    ):
        rows, columns = boxes[part]
        assert rows.stop - rows.start == columns.stop - columns.start
        assert rows.start >= 0
        assert rows.stop <= 400
        assert columns.start >= 0
        assert columns.stop <= 200
        column, row = pixels[0, template.names.index(joint)].tolist()
        assert rows.start <= row <= rows.stop
        assert columns.start <= column <= columns.stop

    # A hand that was not detected, or lies outside the image, is not shown.
    left = [
        i for i, joint in enumerate(template.names) if joint.startswith("left_")
    ]
    visibility[:, left] = 0
    hidden = detail_boxes(template, skeleton, visibility, camera)
    assert "left hand" not in hidden
    far = skeleton + torch.tensor([9.0, 0, 0])
    assert detail_boxes(template, far, visibility, camera) == {}


def test_a_panel_holds_its_image():
    image = torch.zeros(1, 3, 4, 2)
    image[0, 0, 3, 1] = 1.0  # the lower right pixel is red
    with rc_context(STYLE):
        panels = [[Panel(image, "note"), Panel(image)]]
        figure, axes = draw_panels(
            panels, titles=["one", "$x^$"], names=["row"]
        )
        drawn = rendered(figure)  # and no title is a formula
    box, height = axes[0, 1].get_window_extent(), drawn.shape[0]
    corner = drawn[round(height - box.y0) - 3, round(box.x1) - 3]
    assert corner.tolist() == [255, 0, 0]
    assert drawn[round(height - box.y1) + 3, round(box.x0) + 3].tolist() == [
        0,
        0,
        0,
    ]
    assert figure.get_size_inches()[0] == COLUMN_WIDTH
    assert figure.get_size_inches()[1] < TALLEST + 0.5  # with text


@pytest.fixture
def data(build):
    return build()[0]


def test_shots_are_spread_over_frames_and_cameras(data):
    def choose(**given):
        keys = {"frames": None, "camera": None, "count": 2} | given
        return choose_items(data, "novel_pose", **keys)

    assert choose() == [("cam00", 4), ("cam01", 5)]
    assert choose(frames=[5, 4]) == [("cam00", 5), ("cam01", 4)]
    assert choose(camera="cam01") == [("cam01", 4), ("cam01", 5)]
    assert choose(one_camera=True) == [("cam00", 4), ("cam00", 5)]
    with pytest.raises(ConfigError, match=r" 99.* 4-5"):
        choose(frames=[4, 99])
    with pytest.raises(ConfigError, match=r"cam02.*novel_pose.*cam00"):
        choose(camera="cam02")
    with pytest.raises(ConfigError, match="split"):
        choose_items(data, "test", frames=None, camera=None, count=1)


def test_an_empty_split_names_those_with_images(build):
    data = build(
        "data.test_cameras=[]", "data.train_cameras=[cam00,cam01,cam02]"
    )[0]
    with pytest.raises(
        DataError,
        match="split=train, split=novel_pose",
    ):
        choose_items(data, "novel_view", frames=None, camera=None, count=1)


def test_windows_hold_the_joints_and_have_one_size(data):
    items = [("cam00", 0), ("cam01", 3)]
    shots = make_shots(data, "train", items, margin=0.1)
    assert [shot.item for shot in shots] == items
    assert len({shot.truth.shape for shot in shots}) == 1
    for shot in shots:
        height, width = shot.window.size
        pixels, _ = shot.window.camera(shot.frame.camera).project(
            shot.frame.skeleton
        )
        inside = (pixels >= 0) & (pixels <= torch.tensor([width, height]))
        reach, _ = shot.frame.camera.project(shot.frame.skeleton)
        in_picture = (reach >= 0) & (reach <= 32)
        assert bool(inside[in_picture].all())
        assert torch.equal(shot.truth, shot.window.cut(shot.frame.image))
