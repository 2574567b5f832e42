"""Registration of a body's surface to images: offsets it finds, what training does with them."""

from copy import deepcopy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from commands import TINY
from configs import build_training, registration_settings
from rich.console import Console

from gsgan.body import open_body
from gsgan.model.body_points import BodyPoints
from gsgan.scene import BodyPose, Camera, Frame, Gaussians
from gsgan.splat import rasterise
from gsgan.train.registration import (
    MovingSurface,
    SurfaceOffsets,
    linear_fit,
)
from gsgan.train.surface_flow import (
    Drawn,
    TrainingView,
    flow_between,
    projection_slope,
    sample_image,
)
from gsgan.utils.errors import ConfigError

ON = "effects.body_points=on"
REGISTERED = (
    "model=splat_only",
    ON,
    "effects.registration=on",
    "training.registration.frames=2",
    "training.registration.cameras=1",
)
SETTINGS = registration_settings()
SIZE = 192
BENT = "upperarm01.L"


def camera(angle: float) -> Camera:
    """3 metres from the body's middle, at an angle round the vertical axis."""
    sine = float(np.sin(angle))
    cosine = float(np.cos(angle))
    R = torch.tensor(
        [[cosine, sine, 0.0], [0.0, 0.0, -1.0], [-sine, cosine, 0.0]]
    )
    K = torch.tensor([[300.0, 0, SIZE / 2], [0, 300.0, SIZE / 2], [0, 0, 1]])
    t = torch.tensor([0.0, 0.0, 3.0]) - R @ torch.tensor([0.0, 0.0, 0.9])
    return Camera(K[None], R[None], t[None], (SIZE, SIZE))


class Painted:
    """Images of a patterned body whose surface differs from its points by ``offsets [F, C, 3]``."""

    def __init__(self, body, placed, thetas, offsets) -> None:
        self.body = body
        self.placed = placed
        self.poses = [
            placed.points.with_bones(BodyPose(theta[None], torch.zeros(1, 3)))
            for theta in thetas
        ]
        self.offsets = offsets
        self.cameras = [camera(2 * np.pi * i / 4) for i in range(4)]
        self.items = [
            (f"cam{c}", frame) for frame in range(len(thetas)) for c in range(4)
        ]
        landmarks = [body.posed_landmarks(pose)[0] for pose in self.poses]
        p = torch.stack(landmarks)
        self.skeletons = SimpleNamespace(
            joints=lambda frames: (p[list(frames)], torch.ones(len(frames), 33))
        )
        # A pattern of about 15 cm on the body.
        waves = torch.randn(3, 3, generator=torch.Generator().manual_seed(1))
        self.colours = 0.5 + 0.4 * torch.sin(25 * placed.points.means @ waves)

    def __getitem__(self, place: int) -> Frame:
        name, frame = self.items[place]
        seen = self.cameras[int(name[3:])]
        pose = replace(self.poses[frame], offsets=self.offsets[frame][None])
        count = self.placed.n_points
        with torch.no_grad():
            raster = rasterise(
                Gaussians(
                    means=self.placed(pose).means,
                    quats=torch.tensor([1.0, 0, 0, 0]).expand(1, count, 4),
                    scales=(0.6 * self.placed.points.spacing)
                    .view(1, count, 1)
                    .expand(1, count, 3),
                    opacities=torch.full((1, count), 0.95),
                    features=self.colours[None],
                ),
                seen,
            )
        return Frame(
            image=raster.features,
            mask=raster.alpha,
            camera=seen,
            skeleton=torch.zeros(1, 33, 3),
            visibility=torch.ones(1, 33),
            frame_id=torch.tensor([frame]),
            camera_index=torch.tensor([0]),
            body=self.poses[frame],
        )


@pytest.fixture(scope="module")
def painted():
    body = open_body("free", None, ())
    placed = BodyPoints(
        body, 1.7, points=4000, controls=80, pose_offsets=0.02
    ).eval()
    thetas = torch.zeros(4, len(body.joints), 3)
    thetas[:, body.joint_names.index(BENT), 1] = torch.linspace(0, 0.6, 4)

    # The surface slides by up to 15 mm, more in each frame.
    learnt = placed.points.learnt
    total = learnt.share.new_zeros(80).index_add_(
        0, learnt.near.flatten(), learnt.share.flatten()
    )
    places = learnt.share.new_zeros(80, 3).index_add_(
        0,
        learnt.near.flatten(),
        (learnt.share.unsqueeze(2) * placed.points.means[:, None]).flatten(
            0, 1
        ),
    )
    slide = torch.sin(4 * places / total[:, None]).roll(1, 1)
    amount = 0.015 * torch.linspace(0, 1, 4)
    return Painted(body, placed, thetas, amount[:, None, None] * slide)


def avatar_of(placed) -> SimpleNamespace:
    return SimpleNamespace(body_points=placed, window=lambda *_: None)


@pytest.fixture(scope="module")
def found(painted):
    """The offsets of each frame, before any is explained by the pose."""
    surface = MovingSurface(avatar_of(painted.placed), painted, SETTINGS)
    return surface.align_frames(range(4), Console(quiet=True))


def test_the_surface_of_each_frame_is_found(painted, found):
    assert found.isfinite().all()

    def apart(offsets):
        at = painted.placed.points.learnt.interpolate
        return torch.stack([at(x - offsets[0]) for x in offsets])

    truth = apart(painted.offsets)
    left = (apart(found) - truth).norm(dim=2)
    assert left.median() < 0.4 * truth.norm(dim=2).median()


def test_a_body_whose_surface_is_right_stays(painted):
    still = Painted(
        painted.body,
        painted.placed,
        torch.stack([pose.theta[0] for pose in painted.poses]),
        torch.zeros_like(painted.offsets),
    )
    surface = MovingSurface(avatar_of(painted.placed), still, SETTINGS)
    found = surface.align_frames(range(4), Console(quiet=True))
    # a third of a pixel
    assert found.norm(dim=2).median() < 0.0035


def test_what_the_pose_explains_starts_the_offsets(painted, found):
    placed = deepcopy(painted.placed)
    registered = SETTINGS(avatar_of(placed), painted, Console(quiet=True))
    with torch.no_grad():
        for frame, pose in enumerate(painted.poses):
            rest = registered.of(torch.tensor([frame]))
            explained = placed.offset(replace(pose, offsets=rest))[0]
            expected = placed.points.learnt.interpolate(found[frame])
            torch.testing.assert_close(explained, expected, atol=1e-4, rtol=0)


def test_linear_offsets_are_found_and_noise_is_not():
    generator = torch.Generator().manual_seed(0)
    bends = torch.randn(40, 5, 9, generator=generator)
    field = torch.randn(5, 9, 3, generator=generator)
    offsets = 0.3 + torch.einsum("fck,ckj->fcj", bends, field)
    rest, found = linear_fit(bends, offsets)
    torch.testing.assert_close(found, field, atol=2e-2, rtol=0)
    torch.testing.assert_close(rest, torch.full((5, 3), 0.3), atol=1e-2, rtol=0)
    noise = torch.randn(40, 5, 3, generator=generator)
    _, found = linear_fit(bends, noise)
    assert found.square().mean() < 0.05


def test_equal_poses_have_a_fit():
    bends = torch.zeros(3, 5, 9)
    rest, found = linear_fit(bends, torch.ones(3, 5, 3))
    assert found.abs().max() == 0
    assert rest.isfinite().all()


def test_flow_is_that_of_the_images_and_untrusted_where_nothing_is():
    x, y = np.meshgrid(np.arange(96.0), np.arange(80.0))

    def pattern(x, y):
        wave = 0.5 + 0.2 * np.sin(x / 4) + 0.2 * np.sin((y + x / 3) / 3)
        return np.repeat(wave[..., None], 3, axis=2).astype(np.float32)

    inside = np.zeros((80, 96), np.float32)
    inside[20:60, 20:70] = 1
    view = TrainingView(camera(0.0), pattern(x - 1.5, y + 1), inside)
    known = np.ones_like(inside)
    known[:, 60:] = 0
    flow, trust = flow_between(Drawn(pattern(x, y), known, inside), view)
    middle = flow[30:50, 30:50]
    assert np.abs(middle - [1.5, -1]).max() < 0.3
    assert trust[30:50, 30:50].min() > 0.5
    assert trust[inside == 0].max() == 0
    assert trust[:, 60:].max() == 0


def test_flat_images_are_not_trusted():
    flat = np.full((64, 64, 3), 0.5, np.float32)
    inside = np.ones((64, 64), np.float32)
    view = TrainingView(camera(0.0), flat, inside)
    flow, trust = flow_between(Drawn(flat, inside, inside), view)
    assert np.isfinite(flow).all()
    assert trust.max() < 0.01


def test_sampling_counts_from_pixel_centres_for_any_number_of_points():
    image = np.arange(12, dtype=np.float32).reshape(3, 4)
    pixels = np.tile(np.float32([[2.5, 1.5], [1.0, 0.5]]), (20_000, 1))
    found = sample_image(image, pixels)
    assert found.shape == (40_000,)
    assert np.allclose(found, np.tile([6.0, 0.5], 20_000))


def test_slopes_are_those_of_the_projection():
    view = camera(0.7)
    means = 0.3 * torch.randn(5, 3) + torch.tensor([0.0, 0.0, 0.9])
    slope = projection_slope(view, means)
    exact = torch.autograd.functional.jacobian(
        lambda x: view.project(x[None])[0][0], means
    )
    expected = torch.stack([exact[i, :, i] for i in range(5)])
    torch.testing.assert_close(slope, expected, atol=1e-2, rtol=1e-4)


def test_frames_that_were_not_registered_have_no_offsets():
    registered = SurfaceOffsets(torch.tensor([3, 8]), torch.ones(2, 5, 3))
    found = registered.of(torch.tensor([8, 4]))
    assert found[0].eq(1).all()
    assert found[1].eq(0).all()


def test_models_without_offsets_are_not_registered(tiny):
    data, module = build_training(
        tiny(*REGISTERED, "model.body_points.pose_offsets=0")
    )
    found = module.registration(
        module.avatar, data.dataset("train"), Console(quiet=True)
    )
    assert found is None


def test_whether_a_run_registers_is_decided_by_its_scene(tiny):
    _, module = build_training(tiny("model=splat_only", ON))
    effect = module.avatar.effects.registration
    assert not effect.on
    assert "less than a pixel" in effect.why
    _, module = build_training(
        tiny(
            "model=splat_only",
            ON,
            "effects.texture=0",
            "effects.pixels_per_metre=0",
        )
    )
    assert module.avatar.effects.registration.on


def test_a_negative_weight_is_refused():
    with pytest.raises(ConfigError, match="smooth"):
        registration_settings(smooth=-1)


def test_only_training_frames_have_offsets_of_their_own(tiny):
    data, module = build_training(tiny(*REGISTERED))
    given = []
    forward = module.avatar.forward

    def watched(p, seen, camera, body=None, *rest, **options):
        given.append(body.offsets)
        return forward(p, seen, camera, body, *rest, **options)

    module.avatar.forward = watched
    frame = data.dataset("train")[0]
    controls = len(module.avatar.body_points.points.learnt.field)
    module.surface_offsets = SurfaceOffsets(
        frame.frame_id, torch.full((1, controls, 3), 0.01)
    )
    module.trainer = None
    module.validation_step(frame, 0)
    assert given[-1] is None


def test_a_resumed_run_keeps_the_registered_surface(
    tiny, capture, tmp_path, inside
):
    given = (
        *TINY,
        *REGISTERED,
        "evaluate=false",
        "trainer=cpu",
        f"data.root={capture}",
        f"hydra.run.dir={tmp_path / 'run'}",
    )
    result = inside("train", *given)
    assert result.returncode == 0, result.stderr
    path = tmp_path / "run" / "checkpoints" / "last.ckpt"
    kept = torch.load(path, weights_only=True)["registered"]
    assert kept["offsets"].isfinite().all()
    _, module = build_training(tiny(*REGISTERED))
    module.on_load_checkpoint(torch.load(path, weights_only=True))
    assert torch.equal(module.surface_offsets.offsets, kept["offsets"])
    assert torch.equal(module.surface_offsets.frames, kept["frames"])


def test_training_moves_the_surface_of_its_frames(make):
    module, trainer, data = make(*REGISTERED)
    frames = torch.tensor(data.trained)
    controls = len(module.avatar.body_points.points.learnt.field)
    module.surface_offsets = SurfaceOffsets(
        frames, 0.001 * torch.randn(len(frames), controls, 3)
    )
    given = []
    forward = module.avatar.forward

    def watched(p, seen, camera, body=None, *rest, **options):
        if module.avatar.training:
            given.append(body.offsets)
        return forward(p, seen, camera, body, *rest, **options)

    module.avatar.forward = watched
    trainer.fit(module, data)
    assert given
    assert all(offsets.abs().max() > 0 for offsets in given)
