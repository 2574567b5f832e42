"""The examples of docs/extending.md: a dataset format, a loss term, a generator, a baseline."""

import json
import shutil
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from configs import build_data, build_training
from torch import Tensor, nn

from gsgan.data.cameras import make_camera
from gsgan.data.formats.common import FolderReader, image_size, one_mask_each
from gsgan.data.layout import DatasetFiles, Meta
from gsgan.data.skeletons import make_landmarks
from gsgan.model.body_points import SkinnedPoints
from gsgan.model.rendering import Rendering
from gsgan.scene import BodyPose, Frame, Gaussians
from gsgan.utils.frame_files import frame_files

HERE = __name__
ROOT = Path(__file__).parents[1]


class NpzReader(FolderReader):
    """A dataset format: two .npz files, and folders of images and masks for each camera."""

    contents = "cameras.npz, skeletons.npz, CAMERA/ and CAMERA_mask/"
    hint = "check that cameras.npz and skeletons.npz have the same world frame and unit"

    def find(self, root, limits, smpl) -> DatasetFiles:
        images, masks, cameras = {}, {}, {}
        file = root / "cameras.npz"
        with np.load(file) as arrays:
            for name, K, R, t in zip(
                *(arrays[key] for key in ("name", "K", "R", "t")), strict=True
            ):
                images[name] = frame_files(root, name, (".png",))
                masks[name] = frame_files(root, f"{name}_mask", (".png",))
                size = image_size(root, images[name])
                cameras[name] = make_camera(
                    f"{file}: {name}", name, K=K, R=R, t=t, dist=None, size=size
                )
        with np.load(root / "skeletons.npz") as arrays:
            p, ids = arrays["p"], arrays["frame"]
        return DatasetFiles(
            root=root,
            meta=Meta(layout="npz"),
            cameras=cameras,
            images=images,
            masks=one_mask_each(masks, "grey"),
            mask_folder="{camera}_mask",
            landmarks=make_landmarks(
                ids, p, np.ones(p.shape[:2]), limits.max_reach, []
            ),
            calibration=file,
            unit_hint="lengths must be in metres",
        )


class Smoothness(nn.Module):
    """A loss term: total variation of the painted image."""

    def __init__(self, weight: float) -> None:
        super().__init__()
        self.weight = weight

    def forward(self, painting: Rendering, frame: Frame) -> Tensor:
        return self.weight * painting.image.diff(dim=-1).abs().mean()


class OneLayer(nn.Module):
    """A generator: one convolution of all maps, the pose code ignored."""

    feature_bound = None

    def __init__(self, channels) -> None:
        super().__init__()
        inputs = channels.feature + channels.segmentation + channels.skeleton
        self.paint = nn.Conv2d(inputs, 4, 3, padding=1)

    def forward(self, F, S, p2d, g, fine=None, alpha=None) -> Tensor:
        return self.paint(
            torch.cat([x for x in (F, S, p2d) if x is not None], dim=1)
        )


class OneLayerSettings:
    def build(self, channels) -> OneLayer:
        return OneLayer(channels)


class Blobs(nn.Module):
    """A splatting baseline: grey spheres on the body that learn their colour alone."""

    features = 0  # channels of F besides the three of colour

    def __init__(
        self, body, stature: float, sh_degree: int, count: int
    ) -> None:
        super().__init__()
        self.points, self.size = SkinnedPoints(body, count), 0.03 * stature
        self.sh_degree = self.active_degree = sh_degree
        self.colour = nn.Parameter(torch.full((count, 3), 0.5))

    def parameter_groups(self):
        return [([self.colour], 1.0)]

    def forward(self, pose: BodyPose, eye: Tensor) -> Gaussians:
        A, t = self.points.blend(pose)
        means = (A @ self.points.means.unsqueeze(-1)).squeeze(-1) + t
        quats = means.new_tensor([1.0, 0, 0, 0]).expand(*means.shape[:2], 4)
        features = self.colour.expand(len(means), -1, -1)
        return Gaussians(
            means,
            quats,
            torch.full_like(means, self.size),
            features[..., 0] * 0 + 0.9,
            features,
        )


@dataclass
class BlobSettings:
    points: int

    def build(self, body, stature: float, sh_degree: int) -> Blobs:
        return Blobs(body, stature, sh_degree, self.points)


def test_a_dataset_format(tiny, capture, tmp_path):
    stored = json.loads((capture / "cameras.json").read_text())
    np.savez(
        tmp_path / "cameras.npz",
        name=list(stored),
        **{
            key: [camera[key] for camera in stored.values()]
            for key in ("K", "R", "t")
        },
    )
    with np.load(capture / "landmarks3d.npz") as arrays:
        np.savez(
            tmp_path / "skeletons.npz", p=arrays["p"], frame=arrays["frame_id"]
        )
    for name in stored:
        shutil.copytree(capture / "images" / name, tmp_path / name)
        shutil.copytree(capture / "masks" / name, tmp_path / f"{name}_mask")
    reader = ("~data.reader", f"+data.reader={{_target_: {HERE}.NpzReader}}")
    here = build_data(
        tiny(*reader, f"data.root={tmp_path}", "data.test_cameras=[cam02]")
    )
    there = build_data(tiny("data.test_cameras=[cam02]"))
    mine, theirs = here.dataset("train")[0], there.dataset("train")[0]
    assert torch.equal(mine.image, theirs.image)
    assert torch.equal(mine.skeleton, theirs.skeleton)
    assert torch.equal(mine.camera.K, theirs.camera.K)


def test_a_loss_term(tiny):
    losses = f"{{smooth: {{_target_: {HERE}.Smoothness, weight: 0.1}}}}"
    data, module = build_training(tiny(f"training.extra_losses={losses}"))
    frame = data.dataset("train")[0]
    painting = module.avatar(*frame.inputs)
    terms = module.step_two_terms(painting, frame, None)
    expected = 0.1 * painting.image.diff(dim=-1).abs().mean()
    assert float(terms["smooth"].detach()) == float(expected) > 0


def test_a_generator(build, tmp_path):
    folder = tmp_path / "model" / "generator"
    folder.mkdir(parents=True)
    content = f"_target_: {HERE}.OneLayerSettings\n"
    (folder / "one_layer.yaml").write_text(content)
    path = f"hydra.searchpath=[file://{tmp_path}]"
    _, avatar, frame = build(path, "model/generator=one_layer")
    assert isinstance(avatar.generator, OneLayer)
    assert avatar(*frame.inputs).image.shape == frame.image.shape


def test_a_splatting_baseline(tiny):
    keys = (
        "opacity",
        "scale",
        "mean_bound",
        "scale_min",
        "scale_max",
        "scale_spacings",
        "logit_bound",
    )
    config = tiny(
        "model=lbs_splat",
        f"model.surface._target_={HERE}.BlobSettings",
        "model.surface.points=50",
        *(f"~model.surface.{key}" for key in keys),
    )
    data, module = build_training(config)
    frame = data.dataset("train")[0]
    painting = module.avatar(
        frame.skeleton,
        frame.visibility,
        frame.camera,
        frame.body,
        generate=False,
    )
    module.step_one_loss(painting, frame).backward()
    assert float(module.avatar.surface.colour.grad.abs().max()) > 0


def test_an_installed_package_adds_its_config_folder(tmp_path, monkeypatch):
    """Installed as pip does it: the module on the path, its entry points beside it."""
    from hydra import compose, initialize_config_dir

    from gsgan.utils.config import config_folder

    example = ROOT / "docs/examples/package"
    project = tomllib.loads((example / "pyproject.toml").read_text())["project"]
    shutil.copytree(example / "my_avatars", tmp_path / "my_avatars")
    installed = tmp_path / "my_avatars-0.1.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text("Name: my-avatars\nVersion: 0.1\n")
    lines = ["[gsgan.conf]"]
    for name, module in project["entry-points"]["gsgan.conf"].items():
        lines.append(f"{name} = {module}")
    (installed / "entry_points.txt").write_text("\n".join(lines) + "\n")
    monkeypatch.syspath_prepend(str(tmp_path))

    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = compose("train", ["model=few_points"])
    assert config.model.body_points.points == 540
