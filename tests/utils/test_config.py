"""Configs compose, match their constructors key for key, and ablations differ by a line or two."""

import importlib.util
import io
import json
import re
from pathlib import Path

import pytest
import torch
from commands import refused
from configs import build_training
from omegaconf import OmegaConf
from rich.console import Console

from gsgan.scene import Camera
from gsgan.utils.config import (
    LONGEST_NAME,
    config_folder,
    folder_name,
    one_sentence,
    refuse_words_for_truth,
)
from gsgan.utils.errors import ConfigError, DataError

SRC = Path(__file__).parents[2] / "src" / "gsgan"


def options(group: str) -> list[str]:
    return sorted(
        path.stem for path in (config_folder() / group).glob("[!_]*.yaml")
    )


GROUPS = (
    "model",
    "data",
    "effects",
    "trainer",
    "logger",
    "size",
    "training",
    "accuracy",
)


def test_every_option_composes(compose):
    """The groups do not depend on each other: the i-th options of all are composed together."""
    choices = {group: options(group) for group in GROUPS}
    for i in range(max(map(len, choices.values()))):
        given = (
            f"{group}={found[i % len(found)]}"
            for group, found in choices.items()
        )
        config = compose("train", *given)
        OmegaConf.to_container(config.training, resolve=True)
        model = OmegaConf.to_container(config.model, resolve=True)
        assert model["_target_"].startswith("gsgan.")
    found = (
        importlib.util.find_spec("hydra_plugins.hydra_optuna_sweeper")
        is not None
    )
    for experiment in options("experiment"):
        if (
            experiment == "search" and not found
        ):  # its sweeper is in the extra sweep
            continue
        config = compose("train", f"experiment={experiment}")
        OmegaConf.to_container(config.training, resolve=True)


def differences(a, b, at: str = "") -> set[str]:
    if isinstance(a, dict) and isinstance(b, dict):
        keys = set(a) | set(b)
        return {
            x
            for k in keys
            for x in differences(a.get(k), b.get(k), f"{at}.{k}".strip("."))
        }
    return set() if a == b else {at}


@pytest.mark.parametrize("experiment", [None, "smoke"])
@pytest.mark.parametrize(
    ("model", "changed"),
    [
        ("wo_seg", {"model.segmentation"}),
        ("wo_feat", {"training.step_two.feature_matching"}),
        ("wo_gcn", {"model.pose_encoder"}),
        (
            "splat_only",
            {
                "model.segmentation",
                "model.pose_encoder",
                "model.generator",
                "training.schedule.stretch",
                "equal_time",
            },
        ),
    ],
)
def test_an_ablation_changes_what_it_says_and_nothing_else(
    compose, model, changed, experiment
):
    chosen = [] if experiment is None else [f"experiment={experiment}"]
    full = OmegaConf.to_container(compose("train", *chosen))
    other = OmegaConf.to_container(compose("train", *chosen, f"model={model}"))
    found = {".".join(key.split(".")[:3]) for key in differences(full, other)}
    assert {
        next(c for c in changed if key.startswith(c)) for key in found
    } == changed


def test_a_capture_is_taken_with_all_that_it_has(compose, tmp_path):
    def chosen(*more: str) -> tuple[str, int, str]:
        config = compose(
            "train", "data=capture", f"data.root={tmp_path}", *more
        )
        return config.data.skeleton, config.data.size, config.data.root

    # Nothing is known of the folder: the reader says what is wrong.
    assert chosen()[:2] == ("mediapipe33", 512)
    cameras = {"a": {"size": [320, 240]}, "b": {"size": [200, 100]}}
    (tmp_path / "cameras.json").write_text(json.dumps(cameras))
    assert chosen()[1] == 320
    assert chosen("size=small")[1] == 128
    (tmp_path / "cameras.json").write_text("[3]")
    assert chosen()[1] == 512

    (tmp_path / "face3d.npz").touch()
    assert chosen()[0] == "mediapipe33"
    (tmp_path / "hands3d.npz").touch()
    assert chosen()[0] == "holistic"
    (tmp_path / "face3d.npz").unlink()
    assert chosen()[0] == "mediapipe33_hands"
    assert chosen("data.skeleton=mediapipe33")[0] == "mediapipe33"


def test_demo_is_what_train_does_by_default_but_for_the_images_scored(compose):
    demo = compose("train", "experiment=demo", "score_images=null")
    del demo.equal_time
    assert demo == compose("train")


@pytest.mark.parametrize("word", ["", "+", "~"])
def test_a_key_that_is_gone_names_what_takes_its_place(inside, word):
    result = inside("train", f"{word}effects.generator=on")
    refused(result, "no effects.generator any more", "model=splat_only")


def test_a_key_that_is_gone_is_refused_in_files_too(inside, tmp_path):
    path = tmp_path / "experiment" / "mine.yaml"
    path.parent.mkdir()
    path.write_text("# @package _global_\neffects: {generator: auto}\n")
    given = (f"hydra.searchpath=[file://{tmp_path}]", "experiment=mine")
    refused(inside("train", *given), "no effects.generator any more")


def test_every_top_level_key_is_read_by_code(compose):
    code = "\n".join(path.read_text() for path in SRC.rglob("*.py"))
    yaml = "\n".join(
        path.read_text() for path in config_folder().rglob("*.yaml")
    )
    for name in ("train", "evaluate"):
        for key in compose(name):
            # It is a field of options, or is read by its name.
            field = rf"^    {key}: "
            named = rf'{field}|(config|stored)\.({key}\b|get\("{key}"\))'
            read = re.search(named, code, re.MULTILINE) or re.search(
                rf"\$\{{(oc\.select:)?{key}\b", yaml
            )
            assert read, f"conf/{name}.yaml: {key} is read by nothing"


def test_every_size_key_is_used(compose):
    yaml = "\n".join(
        path.read_text() for path in config_folder().rglob("*.yaml")
    )
    keys = set(compose("train").size)
    for key in keys:
        assert re.search(rf"\$\{{.*\bsize\.{key}\b", yaml), (
            f"size.{key} is read by nothing"
        )
    for size in options("size"):
        assert set(compose("train", f"size={size}").size) == keys, size


def test_missing_config_folder_is_said(monkeypatch, tmp_path):
    import gsgan.utils.config as module

    monkeypatch.setattr(
        module, "__file__", str(tmp_path / "a" / "b" / "config.py")
    )
    with pytest.raises(Exception, match="conf"):
        config_folder()


def test_bugs_keep_their_traceback_and_mistakes_get_a_sentence():
    assert one_sentence(DataError("x.png: missing")) == "x.png: missing"
    assert one_sentence(ConfigError("run is not set")) == "run is not set"
    assert one_sentence(ZeroDivisionError("a bug")) is None
    assert one_sentence(ValueError("of another library")) is None
    with pytest.raises(ValueError, match="K ") as caught:
        Camera(*(torch.zeros(1),) * 3, size=(4, 4))
    assert one_sentence(caught.value) == str(caught.value)


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("effects.view_dependence=7", "effects.view_dependence must be one of"),
        ("model.generator.patch=3", "patch must be one of 1, 2, 4"),
        (
            "training.schedule.step_two=-1",
            "schedule.step_two must be a number of at least 0",
        ),
        ("+model.densify.colour=1", "unexpected keyword argument 'colour'"),
        ("+model.generator.colour=1", "unexpected keyword argument 'colour'"),
        ("training.perceptual.weights=resnet", "pretrained, random"),
        ("training.perceptual.net=resnet", "vgg, alex"),
        ("training.perceptual.crop=8", "training.perceptual.crop must be"),
        ("data.crop=car", "data.crop must be null or person"),
    ],
)
def test_unknown_values_become_one_sentence(tiny, override, named):
    from configs import build_training

    config = tiny(override)
    with pytest.raises(Exception) as caught:  # noqa: PT011 (the sentence is what is checked)
        build_training(config)
    assert named in (one_sentence(caught.value) or "")


MANY = [
    f"training.recipes.psi.rate.{key}=0.{i}"
    for i, key in enumerate(("hold", "final"))
] + [
    f"training.step_two.{key}=0.25"
    for key in ("l1", "l2", "ssim", "perceptual", "anchor")
]


@pytest.mark.parametrize(
    "experiment", [[], ["experiment=study"], ["experiment=ablation_capture"]]
)
def test_a_sweep_folder_has_a_name_that_file_systems_take(experiment, tmp_path):
    from hydra import compose, initialize_config_dir
    from omegaconf import open_dict

    given = [
        *experiment,
        *MANY,
        "data.val_images=3",
        "effects.only=[a,b]",
        "logger=csv",
    ]
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = compose("train", overrides=given, return_hydra_config=True)
    with open_dict(config):
        config.hydra.job.num = 7
    # without Hydra's own resolver
    assert Path(config.hydra.sweep.dir).parts[0] == "runs"
    name = config.hydra.sweep.subdir
    assert len(name.encode()) <= LONGEST_NAME + 2
    assert not set(name) & set("[],=/ ")
    assert "psi.rate.hold-0.0" in name
    (tmp_path / name).mkdir()


def test_two_runs_of_a_sweep_never_share_a_folder():
    assert folder_name("model-full_seed-1") == "model-full_seed-1"
    many = "_".join(MANY)
    pairs = [
        (many + "_a-1", many + "_a-2"),
        ("data.smpl-/a/b_c", "data.smpl-/a_b/c"),
        ("names-é", "names-è"),
    ]
    for one, other in pairs:
        assert folder_name(one) != folder_name(other)
        assert max(map(len, map(folder_name, (one, other)))) <= LONGEST_NAME


@pytest.mark.parametrize(
    ("capability", "precision"),
    [
        ((7, 0), "32-true"),
        ((7, 5), "32-true"),
        ((8, 0), "bf16-mixed"),
        ((12, 0), "bf16-mixed"),
    ],
)
def test_bf16_only_on_gpus_that_have_it(monkeypatch, capability, precision):
    from gsgan.utils.config import gpu_precision

    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr(
        "torch.cuda.get_device_capability", lambda *_: capability
    )
    assert gpu_precision() == precision


def test_the_precision_of_an_old_gpu_is_explained(tiny, monkeypatch):
    from gsgan.train.description import describe

    data, module = build_training(tiny("model=splat_only"))

    def described(precision: str) -> str:
        console = Console(file=io.StringIO(), record=True, width=200)
        cpu = torch.device("cpu")
        describe(console, Path("run"), data, module, cpu, precision, None)
        return console.export_text()

    assert "compute capability" not in described("32-true")
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.get_device_capability", lambda *_: (7, 5))
    assert "compute capability 7.5" in described("32-true")
    assert "compute capability" not in described("bf16-mixed")


@pytest.mark.parametrize("word", ["no", "off", "maybe", 1])
def test_words_are_not_taken_for_true(word):
    defaults = OmegaConf.create({"overwrite": False, "smooth": {"on": True}})
    for key in ("overwrite", "smooth.on"):
        config = defaults.copy()
        OmegaConf.update(config, key, word)
        with pytest.raises(ConfigError, match=f"{key} must be true or false"):
            refuse_words_for_truth(config, defaults)
    refuse_words_for_truth(defaults, defaults)
