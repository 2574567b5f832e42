"""A model has the parts that its name says, whatever the size and the data."""

from dataclasses import replace

import pytest
import torch
from configs import build_avatar, build_training
from hydra.utils import instantiate
from rich.console import Console
from test_extending import OneLayer

from gsgan.data.scene_info import SceneInfo
from gsgan.model.generator import Generator
from gsgan.train.description import describe
from gsgan.train.module import fit_schedule
from gsgan.utils.config import config_folder

SIZES = sorted(path.stem for path in (config_folder() / "size").glob("*.yaml"))
DATA = sorted(
    path.stem for path in (config_folder() / "data").glob("[!_]*.yaml")
)
# A person of 380 pixels in six cameras, with a body that fits the masks: G is dense on it.
SCENE = SceneInfo(
    camera_names=("a", "b"),
    n_train_cameras=2,
    train_cameras=("a", "b"),
    has_distortion=False,
    has_labels=False,
    n_labels=0,
    label_names=(),
    has_body_pose=True,
    body="free",
    skeleton="mediapipe33",
    limb_length_sum=4.2,
    centre=(0.0, 0.0, 1.0),
    frames=10,
    scale_train=(210.0, 220.0),
    body_inside=1.0,
)


def built(config):
    skeleton = config.data.get("skeleton", "mediapipe33")
    return build_avatar(config, replace(SCENE, skeleton=skeleton))


@pytest.mark.parametrize(
    ("size", "data"),
    [
        *((size, "capture") for size in SIZES),
        *(("tiny", data) for data in DATA),
    ],
)
def test_full_is_full_at_every_size_and_on_all_data(compose, size, data):
    config = compose("train", "model=full", f"size={size}", f"data={data}")
    avatar = built(config)
    assert isinstance(avatar.generator, Generator)
    assert avatar.segmentation is not None
    assert avatar.pose_encoder is not None
    assert config.training.discriminator is not None


@pytest.mark.parametrize("data", DATA)
def test_full_has_a_second_step_on_all_data(compose, data):
    config = compose("train", f"data={data}")
    schedule = instantiate(config.training.schedule)
    assert fit_schedule(schedule, built(config)).step_two > 0


@pytest.mark.parametrize("model", ["wo_seg", "wo_gcn", "wo_feat"])
def test_ablations_have_the_generator(compose, model):
    avatar = built(compose("train", f"model={model}"))
    assert avatar.generator is not None
    assert (avatar.segmentation is None) == (model == "wo_seg")


@pytest.mark.parametrize("size", SIZES)
def test_a_generator_of_ones_own_is_built_at_every_size(
    compose, size, tmp_path
):
    folder = tmp_path / "model" / "generator"
    folder.mkdir(parents=True)
    content = f"_target_: {OneLayer.__module__}.OneLayerSettings\n"
    (folder / "one_layer.yaml").write_text(content)
    path = f"hydra.searchpath=[file://{tmp_path}]"
    given = (path, f"size={size}", "model/generator=one_layer")
    assert isinstance(built(compose("train", *given)).generator, OneLayer)


@pytest.mark.parametrize(
    ("model", "points", "advised"),
    [
        ("full", 500, True),
        ("full", 20, False),
        ("splat_only", 500, False),
    ],
)
def test_advice_where_the_generator_gains_little(
    tiny, tmp_path, model, points, advised
):
    words = ("effects.body_points=on", f"size.body_points={points}")
    data, module = build_training(tiny(f"model={model}", *words))
    console = Console(record=True, width=200)
    device = torch.device("cpu")
    describe(console, tmp_path, data, module, device, "32-true", None)
    text = console.export_text()
    assert ("Gaussians per pixel of the person" in text) == advised
    assert ("model=splat_only trains it alone" in text) == advised
