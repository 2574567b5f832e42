"""Configs of runs: those of earlier versions are read too."""

import pytest
import torch
from omegaconf import OmegaConf

from gsgan.run.stored import (
    CHECKPOINT,
    CONFIG,
    RENAMED_KEYS,
    hydra_record,
    read_config,
)
from gsgan.train.resume import checkpoint_to_resume
from gsgan.utils.errors import ConfigError, DataError


def test_a_config_of_an_earlier_version_names_classes_where_they_are_now(
    tmp_path,
):
    path = tmp_path / CONFIG
    path.parent.mkdir()
    path.write_text(
        "data: {}\nmodel: {_target_: gsgan.model.assemble.AvatarParts}\n"
    )
    assert (
        read_config(tmp_path).model._target_ == "gsgan.run.assemble.AvatarParts"
    )


def write_config(folder, text):
    path = folder / CONFIG
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)


def test_a_config_of_an_earlier_version_has_the_keys_of_now(tmp_path):
    write_config(
        tmp_path,
        """
        data: {reader: {consistency: {least_inside: 0.3, far_camera: 10}}}
        fit: {least_mask: 0.2}
        model: {window_least: "${size}"}
        size: 24
        training: {rollback: {most: 5}}
        """,
    )
    config = read_config(tmp_path)
    assert config.data.reader.consistency == {
        "refused_below": 0.3,
        "far_camera": 10,
    }
    assert config.fit == {"min_mask": 0.2}
    assert config.model == {"window_minimum": 24}
    assert config.training.rollback == {"max_restorations": 5}


def test_a_key_that_is_gone_is_left_out_if_nothing_else_was_possible(tmp_path):
    text = "data: {{}}\nmodel: {{deformation: {{layers: 2, pose_frame: {}}}}}\n"
    write_config(tmp_path, text.format("world"))
    assert read_config(tmp_path).model.deformation == {"layers": 2}
    write_config(tmp_path, text.format("pelvis"))
    with pytest.raises(
        ConfigError, match=r"another model.deformation.pose_frame"
    ):
        read_config(tmp_path)


def test_a_config_of_now_stays_as_it_is(tmp_path):
    """Also one that lacks the groups, or has a null in their place."""
    text = "data: {reader: null}\nmodel: {window_minimum: 8}\nfit: null\n"
    write_config(tmp_path, text)
    config = read_config(tmp_path)
    assert config == {
        "data": {"reader": None},
        "model": {"window_minimum": 8},
        "fit": None,
    }


def test_a_run_of_an_earlier_version_is_resumed(tmp_path):
    before = {"training": {"rollback": {"most": 5, "slower": 0.5}}, "seed": 0}
    checkpoint = tmp_path / CHECKPOINT
    checkpoint.parent.mkdir()
    state = {"gsgan": {"marks": [], "record": before}, "state_dict": {}}
    torch.save(state, checkpoint)
    now = {
        "training": {"rollback": {"max_restorations": 5, "slower": 0.5}},
        "seed": 0,
    }
    assert checkpoint_to_resume(tmp_path, now, []) == checkpoint
    now["training"]["rollback"]["max_restorations"] = 4
    with pytest.raises(
        ConfigError, match=r"\(training.rollback.max_restorations\)"
    ):
        checkpoint_to_resume(tmp_path, now, [])


def test_conf_has_the_names_of_now(compose):
    config = compose("train", "data=capture")
    for before, now in RENAMED_KEYS.items():
        group, _, last = before.rpartition(".")
        settings = OmegaConf.select(config, group)
        assert now in settings
        assert last not in settings


@pytest.mark.parametrize("text", ["- a\n- b\n", "a: ["])
def test_a_damaged_record_of_hydra_is_named(tmp_path, text):
    (tmp_path / ".hydra").mkdir()
    path = tmp_path / ".hydra" / "hydra.yaml"
    path.write_text(text)
    with pytest.raises(DataError, match=r"hydra\.yaml") as error:
        hydra_record(tmp_path)
    assert "data and model" not in str(error.value)
