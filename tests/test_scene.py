"""The nouns check their shapes, move, stack, crop and project."""

import dataclasses

import pytest
import torch

from gsgan.scene import BodyPose, Camera, Frame, cat


def camera(batch: int = 1, **changes) -> Camera:
    parts = {
        "K": torch.tensor([[50.0, 0, 20], [0, 40, 15], [0, 0, 1]]).expand(
            batch, 3, 3
        ),
        "R": torch.eye(3).expand(batch, 3, 3),
        "t": torch.zeros(batch, 3),
        "size": (30, 40),
    }
    return Camera(**(parts | changes))


def test_projection_closed_form():
    pixels, depth = camera().project(
        torch.tensor([[[0.2, -0.1, 2.0], [0.0, 0.0, -1.0]]])
    )
    torch.testing.assert_close(pixels[0, 0], torch.tensor([25.0, 13.0]))
    assert depth.tolist() == [[2.0, -1.0]]
    assert torch.isfinite(pixels).all()


def test_tensors_are_tensors():
    with pytest.raises(ValueError, match=r"t .*tensor"):
        camera(t=[0, 0, 0])


def test_crop_and_resize_see_the_same_point():
    point = torch.tensor([[[0.2, -0.1, 2.0]]])
    cropped = camera().crop(5, 8, (20, 24))
    torch.testing.assert_close(
        cropped.project(point)[0][0, 0], torch.tensor([17.0, 8.0])
    )
    resized = camera().resize((60, 20))
    torch.testing.assert_close(
        resized.project(point)[0][0, 0], torch.tensor([12.5, 26.0])
    )
    assert resized.size == (60, 20)


def test_centre_is_where_depth_vanishes():
    turn = torch.linalg.qr(torch.randn(3, 3)).Q
    one = camera(R=turn[None], t=torch.tensor([[1.0, 2.0, 3.0]]))
    torch.testing.assert_close(
        one.to_camera(one.centre[:, None])[0, 0],
        torch.zeros(3),
        atol=1e-5,
        rtol=0,
    )


def test_records_move_slice_and_stack():
    frame = Frame(
        torch.zeros(1, 3, 4, 4), torch.zeros(1, 1, 4, 4), camera(size=(4, 4)),
        torch.zeros(1, 33, 3), torch.ones(1, 33), torch.tensor([7]), torch.tensor([0]),
        BodyPose(torch.zeros(1, 2, 3), torch.zeros(1, 3)), torch.zeros(1, 4, 4).long(),
    )  # fmt: skip
    double = frame.to(torch.float64)
    assert double.camera.K.dtype == torch.float64
    assert double.labels.dtype == torch.int64
    both = cat([frame, frame])
    assert len(both) == 2
    assert both.camera.size == (4, 4)
    assert len(both[:1].body.theta) == 1
    with pytest.raises(TypeError, match="slice"):
        both[0]
    with pytest.raises(ValueError, match="labels"):
        cat([frame, dataclasses.replace(frame, labels=None)])
    with pytest.raises(ValueError, match="size"):
        cat([camera(size=(4, 4)), camera(size=(5, 4))])
    with pytest.raises(ValueError, match="at least one"):
        cat([])
