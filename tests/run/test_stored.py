"""Configs of runs."""

import pytest

from gsgan.run.stored import CONFIG, hydra_record, read_config
from gsgan.utils.errors import DataError


def write_config(folder, text):
    path = folder / CONFIG
    path.parent.mkdir()
    path.write_text(text)


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


@pytest.mark.parametrize("text", ["- a\n- b\n", "a: ["])
def test_a_damaged_record_of_hydra_is_named(tmp_path, text):
    (tmp_path / ".hydra").mkdir()
    path = tmp_path / ".hydra" / "hydra.yaml"
    path.write_text(text)
    with pytest.raises(DataError, match=r"hydra\.yaml") as error:
        hydra_record(tmp_path)
    assert "data and model" not in str(error.value)
