"""`experiment=paper` is one line for every data set, and only its runs bear the paper's name."""

import re

import pytest
from omegaconf import OmegaConf

from gsgan.run.stored import record
from gsgan.utils.config import config_folder, flat

DATA = sorted(
    path.stem for path in (config_folder() / "data").glob("[!_]*.yaml")
)
OURS = {  # what gsgan adds to the paper's method, and the value that leaves it out
    "effects.body_points": "off",
    "effects.colour_correction": "off",
    "effects.antialias": "off",
    "effects.random_background": "off",
    "effects.registration": "off",
    "effects.light": "off",
    "model.deformation.normals": False,
    "model.deformation.free_table": False,
    "model.deformation.embedding": 0,
    "model.generator.rgb_skip": False,
    "model.low_pass": 0.3,
    "model.supersample": 1,
    "model.window_margin": None,
    "training.average": None,
    "training.pose_noise": 0.0,
    "training.recipes.psi.clip": None,
    "training.step_one.feature_head": 0.0,
    "training.step_two.anchor": 0.0,
    "training.step_two.adversarial": 1.0,
    "training.step_two.perceptual": 1.0,
    "training.step_two.feature_matching": 1.0,
    "training.step_two.gan": "logistic",
    "training.schedule.step_one": 10000,
    "training.recipes.generator.rate.peak": 2e-5,
}


@pytest.fixture
def settings(compose):
    def run(*overrides: str):
        return dict(flat(record(compose("train", *overrides))))

    return run


@pytest.mark.parametrize("data", DATA)
def test_the_preset_leaves_out_what_is_ours_on_every_data(settings, data):
    found = settings("experiment=paper", f"data={data}")
    assert {key: found[key] for key in OURS} == OURS


@pytest.mark.parametrize(
    ("data", "protocol"), [("thuman4", "thuman4"), ("zju_mocap", "zju")]
)
def test_it_brings_the_papers_protocol(compose, data, protocol):
    config = compose("train", "experiment=paper", f"data={data}")
    assert config.protocol.name == f"paper_{protocol}"
    assert config.data.protocol.name == f"paper_{protocol}"
    assert config.data.crop is None


@pytest.mark.parametrize("model", ["lbs_splat", "image_to_image"])
def test_baselines_that_are_not_the_papers_are_refused_in_one_sentence(
    inside, capture, model
):
    given = (
        "experiment=paper",
        f"model={model}",
        "data=capture",
        f"data.root={capture}",
    )
    result = inside("train", *given, "size=tiny", "training=smoke")
    assert result.returncode == 1
    assert (
        "it goes with model=full, wo_feat, wo_seg, wo_gcn or splat_only"
        in result.stderr
    )
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "model", ["full", "wo_feat", "wo_seg", "wo_gcn", "splat_only"]
)
def test_it_builds_with_the_papers_models(build, model):
    small = ("size=tiny", "training=smoke")
    _, avatar, frame = build("experiment=paper", f"model={model}", *small)
    assert avatar.effects.degree == 3
    assert avatar.body_points is None
    assert avatar.window(frame.skeleton, frame.camera) is None
    assert avatar.generator_margin is None
    assert avatar(*frame.inputs).image.shape == frame.image.shape


def test_its_sign_language_is_of_the_hands(settings):
    found = settings("experiment=paper_slp")
    assert found["data.skeleton"] == "holistic"
    assert found["data.reader._target_"].endswith("CaptureReader")
    assert found["model.segmentation.mode"] == "hands"


def test_the_page_lists_keys_that_exist_and_values_of_the_preset(compose):
    """Every key of docs/paper.md, by its last word where several share a cell."""
    page = (config_folder().parent / "docs" / "paper.md").read_text()
    config = compose("train", "experiment=paper")
    groups = ("model", "training", "effects", "size", "data", "trainer")
    known = dict(
        flat(
            {g: OmegaConf.to_container(config[g], resolve=True) for g in groups}
        )
    )
    groups = {key.rpartition(".")[0] for key in known} | set(known)
    parents = {
        ".".join(key.split(".")[:n]) for key in known for n in range(1, 6)
    }
    for row in (line for line in page.splitlines() if line.startswith("|")):
        cell = row.split("|")[3]
        keys = re.findall(r"`([a-z0-9_.]+)`", cell)
        for key in keys:
            if "." in key:
                assert key in parents | groups, key
                first = key
            else:
                assert (
                    f"{first.rpartition('.')[0]}.{key}" in parents | groups
                ), key
    for key in OURS:
        group, _, name = key.rpartition(".")
        assert name in page, key
        assert group.split(".")[0] in page


# Under the preset these are off, or say what another listed key says.
UNLISTED = (
    "model.body_points",
    "training.recipes.colour",
    "training.registration",
    "training.schedule.stretch",
    "training.schedule.coarse",
    "model.segmentation.hands_face",
    "training.perceptual.width",
    "training.perceptual.weights",
    "training.recipes.psi.span",
    "model.backend",
    "model.window_multiple",
    "model.window_minimum",
    "training.seed",
    "training.log_every",
    "training.max_skipped",
    "training.skip_window",
    "training.rollback",
    "training.average_every",
    "training.perceptual.path",
    "training.schedule.epoch",
    "effects.impossible",
)


def test_the_page_lists_every_number_of_the_preset(compose):
    """By itself, or by the part that it is of."""
    page = (config_folder().parent / "docs" / "paper.md").read_text()
    config = compose("train", "experiment=paper")
    for group in ("model", "training"):
        for key, _ in flat(
            {group: OmegaConf.to_container(config[group], resolve=True)}
        ):
            words = key.split(".")
            parts = [".".join(words[:n]) for n in range(3, len(words) + 1)]
            parts += [f"{group}.accuracy"] * ("accuracy" in words) + [key]
            listed = f"`{words[-1]}`" in page or any(
                f"`{part}`" in page for part in parts
            )
            idle = any(key.startswith(part) for part in UNLISTED)
            assert listed or idle or words[-1].startswith("_"), key
