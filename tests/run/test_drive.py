"""The options of a motion."""

from dataclasses import asdict

import pytest
from omegaconf import OmegaConf

from gsgan.run.drive import MotionOptions
from gsgan.utils.config import config_folder
from gsgan.utils.errors import ConfigError


def test_the_defaults_are_those_of_the_config():
    config = OmegaConf.load(config_folder() / "render.yaml")
    assert asdict(MotionOptions()).items() <= dict(config).items()


@pytest.mark.parametrize(
    "wrong",
    [
        {"drive": "body"},
        {"retarget": "maybe"},
        {"up": "w"},
        {"transition": 0},
    ],
)
def test_wrong_values_are_named(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        MotionOptions(**wrong)
