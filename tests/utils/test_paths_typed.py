"""Paths as users type them reach a command as they are."""

import pytest
from omegaconf import OmegaConf

from gsgan.utils.config import quoted

ODD = (
    "walk cycle (1).bvh",
    "/data/My Captures/[new] take #2",
    "it's mine.bvh",
    'a "quoted" name.bvh',
    "take=3.bvh",
    "läuft schnell.bvh",
    "歩く.bvh",
    "a{b}.bvh",
    "50%.bvh",
    "dance(1)",
    "plain/path.bvh",
)


def parsed(argument: str) -> object:
    from hydra.core.override_parser.overrides_parser import OverridesParser

    return OverridesParser.create().parse_override(quoted(argument)).value()


@pytest.mark.parametrize("path", ODD)
@pytest.mark.parametrize(
    "key", ["motion", "data.root", "+on.root", "hydra.run.dir"]
)
def test_odd_paths_arrive_as_typed(key, path):
    assert str(parsed(f"{key}={path}")) == path


def test_the_users_folder_is_expanded(monkeypatch):
    monkeypatch.setenv("HOME", "/home/ann lee")
    assert str(parsed("data.root=~/capture")) == "/home/ann lee/capture"


@pytest.mark.parametrize(
    ("argument", "value"),
    [
        ("seed=3", 3),
        ("data.train_cameras=[cam01,cam02]", ["cam01", "cam02"]),
        ("a={b: 1}", {"b": 1}),
        ("data.root=null", None),
        ("run='already quoted (1)'", "already quoted (1)"),
    ],
)
def test_what_hydra_reads_stays(argument, value):
    assert quoted(argument) == argument
    found = parsed(argument)
    assert OmegaConf.create({"v": found}).v == value or str(found) == value


@pytest.mark.parametrize(
    "argument", ["--help", "-m", "hydra/launcher=joblib", "~model", "key"]
)
def test_flags_and_groups_are_left_alone(argument):
    assert quoted(argument) == argument


def test_a_command_gets_an_odd_path(inside, tmp_path):
    folder = tmp_path / "my run (1) [x]"
    result = inside("evaluate", f"run={folder}")
    assert result.returncode == 1
    assert str(folder) in result.stderr.replace("\n", "")
    assert "not a run folder" in result.stderr
