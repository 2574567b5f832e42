"""Configs of runs: those of earlier versions are read too."""

from gsgan.run.stored import CONFIG, read_config


def test_a_config_of_an_earlier_version_names_classes_where_they_are_now(tmp_path):
    path = tmp_path / CONFIG
    path.parent.mkdir()
    path.write_text("data: {}\nmodel: {_target_: gsgan.model.assemble.AvatarParts}\n")
    assert read_config(tmp_path).model._target_ == "gsgan.run.assemble.AvatarParts"
