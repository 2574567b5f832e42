"""The window holds the person, follows from joints and camera, and pastes back where it was."""

import pytest
import torch
from frames import frame_of

from gsgan.scene import Camera, Window, body_window

HEIGHT, WIDTH = 60, 100


def camera(batch: int = 1) -> Camera:
    K = torch.tensor(
        [[50.0, 0, WIDTH / 2], [0, 50, HEIGHT / 2], [0, 0, 1]]
    ).expand(batch, 3, 3)
    return Camera(
        K,
        torch.eye(3).expand(batch, 3, 3),
        torch.zeros(batch, 3),
        (HEIGHT, WIDTH),
    )


def window(
    points, batch: int = 1, margin: float = 0.1, multiple: int = 8
) -> Window:
    p = torch.tensor(points).expand(batch, -1, -1)
    return body_window(
        p, camera(batch), margin=margin, multiple=multiple, minimum=8, near=0.01
    )


def test_closed_form():
    """Two joints 2 m away: pixels 45 … 55 and 25 … 35, 2.5 px of margin each way."""
    found = window([[[-0.2, -0.2, 2.0], [0.2, 0.2, 2.0]]])
    assert found.size == (16, 16)  # 15 px rounded up to a multiple of 8
    assert found.corners == ((22, 42),)
    assert found.whole == (HEIGHT, WIDTH)


@pytest.mark.parametrize(
    "points",
    [
        [[[-9.0, -9.0, 1.0], [9.0, 9.0, 1.0]]],  # larger than the picture
        [[[0.0, 0.0, 2.0], [0.0, 0.0, -1.0]]],  # a joint behind the camera
        [[[0.0, 0.0, 2.0], [0.0, 0.0, 0.0]]],  # a joint in the camera
    ],
)
def test_hard_cases_take_the_whole_picture(points):
    found = window(points)
    assert found.size == (HEIGHT, WIDTH)
    assert found.corners == ((0, 0),)


def test_a_person_out_of_the_picture_leaves_a_small_box_inside():
    found = window([[[50.0, 50.0, 2.0]]])
    (top, left), (h, w) = found.corners[0], found.size
    assert (h, w) == (8, 8)
    assert top + h <= HEIGHT
    assert left + w <= WIDTH


def test_boxes_of_a_batch_share_one_size():
    p = torch.tensor(
        [[[0.0, 0.0, 2.0]] * 2, [[-0.5, 0.0, 2.0], [0.5, 0.0, 2.0]]]
    )
    found = body_window(
        p, camera(2), margin=0.1, multiple=8, minimum=8, near=0.01
    )
    assert len(found.corners) == 2
    picture = (
        torch.arange(HEIGHT * WIDTH)
        .view(1, 1, HEIGHT, WIDTH)
        .float()
        .expand(2, -1, -1, -1)
    )
    back = found.paste(found.cut(picture))
    inside = found.paste(torch.ones(2, 1, *found.size)) > 0
    assert torch.equal(back[inside], picture[inside])
    assert (back[~inside] == 0).all()


def test_the_boxs_camera_sees_the_same_point():
    point = torch.tensor([[[0.1, -0.05, 2.0]]])
    found = window([[[0.1, -0.05, 2.0]]])
    (top, left) = found.corners[0]
    whole = camera().project(point)[0][0, 0]
    torch.testing.assert_close(
        found.camera(camera()).project(point)[0][0, 0],
        whole - torch.tensor([left, top]),
    )


def test_a_frame_seen_through_its_box_is_cut_in_every_map():
    """With ``ignored`` left whole, the loss would compare pictures of two sizes."""
    pixels = torch.arange(HEIGHT * WIDTH, dtype=torch.float32).view(
        1, 1, HEIGHT, WIDTH
    )
    labels = pixels[:, 0].long()
    frame = frame_of(
        pixels.expand(1, 3, -1, -1), pixels, labels=labels, ignored=pixels
    )
    seen = window([[[-0.2, -0.2, 2.0], [0.2, 0.2, 2.0]]]).frame(frame)
    cut = pixels[..., 22:38, 42:58]
    assert torch.equal(seen.ignored, cut)
    assert torch.equal(seen.mask, cut)
    assert torch.equal(seen.image, cut.expand(1, 3, -1, -1))
    assert torch.equal(seen.labels, cut[:, 0].long())
