"""Paths as users type them reach a command as they are."""

import re
from itertools import pairwise

import pytest
from omegaconf import OmegaConf
from omegaconf.errors import InterpolationKeyError

from gsgan.utils.config import (
    DATA_PATHS,
    PATH_LISTS,
    PATHS,
    build,
    config_folder,
    one_sentence,
    paths_as_text,
    quote,
)

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
    "20261129",
    "1.5",
    "1e3",
    "true",
    "walk,slow.bvh",
    "C:\\takes\\",
    "it's \\'odd\\'",
    "{camera}_{frame}.png",
    "${HOME}.bvh",
    "takes/${a.b}",
    "a$${x",
    "${",
    "C:\\${takes}",
    "it's ${mine}",
)


# Keys whose comments name files though they are none.
TEXT = (
    "align",
    "frames",
    "motion_fps",
    "figures",
    "up",
    "animation",
    "unit",
    "camera_unit",
)


def parsed(argument: str) -> object:
    from hydra.core.override_parser.overrides_parser import OverridesParser

    override = OverridesParser.create().parse_override(quote(argument))
    return OmegaConf.create({"value": override.value()}).value


@pytest.mark.parametrize("path", ODD)
@pytest.mark.parametrize("key", sorted(PATHS))
def test_odd_paths_arrive_as_typed(key, path):
    if key == "other_capture" and path.startswith("{"):
        return  # keys of a dataset
    if "." in key and "${" in path:
        return  # values of other keys
    assert str(parsed(f"{key}={path}")) == path
    assert type(parsed(f"{key}={path}")) is not int


def test_a_list_of_odd_paths_arrives_as_typed():
    paths = [path for path in ODD if "," not in path and "'" not in path]
    found = parsed(f"motion=[{', '.join(paths)},'with,comma']")
    assert [str(path) for path in found] == [*paths, "with,comma"]


@pytest.mark.parametrize("key", sorted(PATHS - PATH_LISTS))
def test_brackets_are_part_of_a_path_that_stands_alone(key):
    assert parsed(f"{key}=[final]") == "[final]"


def test_calls_and_references_of_run_folders_are_hydras():
    assert parsed("out=a_${by_name:x,{x:b},c}") == "a_b"
    argument = "hydra.run.dir=runs/${seed}"
    assert quote(argument) == argument


def test_commas_part_the_values_of_a_sweep():
    assert quote("run=377,378", sweep=True) == "run=377,378"
    assert quote("run=377", sweep=True) == "run='377'"


def test_numbers_of_config_files_become_text():
    config = OmegaConf.create({"data": {"root": 377}, "runs": [1, "b"]})
    paths_as_text(config)
    assert config == {"data": {"root": "377"}, "runs": ["1", "b"]}


def test_references_in_lists_are_text():
    config = OmegaConf.create({"motion": ["\\${a}.bvh", 3]})
    paths_as_text(config)
    assert build(config.motion) == ["${a}.bvh", "3"]


def test_a_reference_that_leads_nowhere_is_named():
    config = OmegaConf.create({"data": {"root": "takes/${x}"}})
    with pytest.raises(InterpolationKeyError) as error:
        _ = config.data.root
    sentence = one_sentence(error.value)
    assert "data.root" in sentence
    assert "another key" in sentence
    assert "\n" not in sentence


def test_the_mark_of_a_missing_value_is_a_path():
    assert parsed("motion=???") == "./???"


def test_every_key_that_the_config_folder_calls_a_path_is_one():
    words = re.compile(r"\b(file|folder|capture)s?\b")
    for file in config_folder().glob("*.yaml"):
        for above, line in pairwise(["", *file.read_text().splitlines()]):
            key, sign, rest = line.partition(": ")
            own, _, comment = rest.partition("#")
            if not sign or not key.isidentifier() or own.strip() != "null":
                continue
            said = comment or (above if above.startswith("#") else "")
            if words.search(said.split(";")[0]) and key not in TEXT:
                assert key in PATHS, f"{file.name}: {key}"


def test_the_keys_of_datasets_exist():
    held = "".join(
        path.read_text() for path in config_folder().glob("data/*.yaml")
    )
    for key in DATA_PATHS:
        assert f"{key.rpartition('.')[2]}:" in held


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
    assert quote(argument) == argument
    found = parsed(argument)
    assert OmegaConf.create({"v": found}).v == value or str(found) == value


@pytest.mark.parametrize(
    "argument", ["--help", "-m", "hydra/launcher=joblib", "~model", "key"]
)
def test_flags_and_groups_are_left_alone(argument):
    assert quote(argument) == argument


def test_a_command_gets_an_odd_path(inside, tmp_path):
    folder = tmp_path / "my run (1) [x]"
    result = inside("evaluate", f"run={folder}")
    assert result.returncode == 1
    assert str(folder) in result.stderr.replace("\n", "")
    assert "not a run folder" in result.stderr
