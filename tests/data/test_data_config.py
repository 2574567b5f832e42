"""The config files of the data: what they build, and what they take from other groups."""

from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from writers.avatarrex import write_avatarrex
from writers.easymocap import write_easymocap
from writers.thuman4 import write_thuman4

from gsgan.utils.config import config_folder
from gsgan.utils.errors import ConfigError

CONF = config_folder()


def conf(name: str, *overrides: str) -> Any:
    """The data group as the entry points compose it, keys of the group itself overridden."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        chosen = [
            f"+data={name}",
            *(o if o[0] == "+" else f"data.{o}" for o in overrides),
        ]
        return compose(overrides=chosen).data


@pytest.mark.parametrize(
    "name", ["capture", "zju_mocap", "thuman4", "avatarrex", "easymocap"]
)
def test_a_dataset_without_root_says_so(name):
    with pytest.raises(InstantiationException) as caught:
        instantiate(conf(name))
    cause = caught.value.__cause__
    assert isinstance(cause, ConfigError)
    assert str(cause).startswith("data.root is not set: give the folder of a")


def test_capture_config_builds_and_reads(ten_frames):
    data = instantiate(
        conf("capture", f"root={ten_frames}", "size=20", "train_frames=0-3")
    )
    assert len(data.dataset("train")) == 12
    assert data.dataset("train")[0].image.shape == (1, 3, 20, 20)
    assert data.crop.margin == conf("capture").crop.margin
    wide = instantiate(conf("capture", f"root={ten_frames}", "crop.margin=0.5"))
    assert wide.crop.margin == 0.5
    assert (
        instantiate(conf("capture", f"root={ten_frames}", "crop=null")).crop
        is None
    )
    assert (
        instantiate(conf("capture", f"root={ten_frames}", "crop=person")).crop
        is not None
    )


@pytest.mark.usefixtures("model_once")
@pytest.mark.parametrize(
    ("name", "write", "body", "camera", "skeleton"),
    [
        ("thuman4", write_thuman4, "smplx", "cam02", "smplx -> mediapipe33"),
        (
            "avatarrex",
            write_avatarrex,
            "smplx",
            "22010708",
            "smplx -> mediapipe33",
        ),
        ("easymocap", write_easymocap, "smpl", "10", "smpl24 -> mediapipe33"),
    ],
)
def test_configs_of_published_formats_read_them_in_worker_processes(
    request, tmp_path, name, write, body, camera, skeleton
):
    subject = request.getfixturevalue(
        "subject" if body == "smpl" else "smplx_subject"
    )
    words = [
        f"root={write(tmp_path / name, subject)}",
        "size=16",
        "workers=1",
        "test_frames=3",
    ]
    words += [
        f"smpl={request.getfixturevalue(f'{body}_file')}",
        f"test_cameras=[{camera}]",
    ]
    words += ["reader.ignore_alpha=[5,250]"] if body == "smplx" else []
    data = instantiate(conf(name, *words))
    batch = next(iter(data.train_dataloader()))
    assert batch.image.shape == (1, 3, 16, 16)
    assert (batch.ignored is None) == (body == "smpl")
    assert data.layout.meta.skeleton_source == skeleton
    assert (data.info.body, data.info.frames) == (body, 3)
    assert data.eval_names == ("novel_view", "novel_pose")
    place = data.layout.camera_names.index(camera)
    assert data.dataset("novel_view")[0].camera_index.item() == place


def test_synthetic_config_reads_what_the_generator_would_make(ten_frames):
    """The generator is not run here: its parameters are checked, its folder replaced."""
    from gsgan.synthetic.scene_setup import SceneSettings

    data = instantiate(
        conf("synthetic", "size=48", "source.frames=12", "source.test_frames=3")
    )
    assert data.source.func.__name__ == "ensure_scene"
    given = dict(data.source.keywords)
    assert given.pop("workers") == 2
    assert SceneSettings(**given) == SceneSettings(
        size=48, frames=12, test_frames=3
    )
    made = instantiate(
        conf("synthetic", f"root={ten_frames}", "skeleton=mediapipe33")
    )
    assert made.dataset("train")[0].image.shape[-2:] == (128, 128)


@pytest.mark.parametrize("name", ["capture", "synthetic"])
def test_other_groups_set_size_seed_and_length_of_an_epoch(name):
    alone = conf(name)
    assert (alone.seed, alone.steps_per_epoch) == (0, None)
    among = conf(name, "+seed=7", "+training={schedule: {epoch: 250}}")
    assert (among.seed, among.steps_per_epoch) == (7, 250)
    with_group = conf(name, "+size=tiny")
    assert with_group.size == 32
    assert conf(name, "size=77").size == 77
    assert conf(name).size in (128, 256, 512)
    if name == "synthetic":
        assert with_group.source.size == 32
