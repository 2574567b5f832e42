"""`gsgan.bench loader`: real loading, a row a number of processes, and what it refuses."""

from __future__ import annotations

import json

import pytest
from gsgan.data.speed import LoaderSpeed

from gsgan.bench.loader import rows, run
from gsgan.utils.errors import ConfigError


def test_measures_each_number_of_processes(compose, capture, tmp_path, capsys):
    given = [f"data.root={capture}", "data.size=32", "workers=[0,1]", "batches=2"]
    run(compose("bench_loader", *given), tmp_path)
    found = json.loads((tmp_path / "loader.json").read_text())["speeds"]
    assert [speed["workers"] for speed in found] == [0, 1]
    assert all(speed["frames"] == 2 and speed["seconds"] > 0 for speed in found)
    assert "| 1 |" in (tmp_path / "loader.md").read_text()
    assert "pictures of 32 x 32" in capsys.readouterr().out


def test_a_rate_below_what_training_takes_says_so():
    speed = LoaderSpeed(frames=30, seconds=3.0, workers=2, size=(512, 512), first=0.5)
    assert rows([speed], 12.5) == [["2", "10.0", "5.00", "0.500", "no, 12.5 are needed"]]
    assert rows([speed], 8.0)[0][-1] == "yes, 8 are needed"
    assert rows([speed], None)[0][-1] == "–"


def test_loading_in_the_training_process_is_not_called_enough():
    speed = LoaderSpeed(frames=30, seconds=3.0, workers=0, size=(512, 512), first=0.5)
    assert rows([speed], 8.0)[0][-1] == "in the training process, 8 are needed"
    assert rows([speed], 12.5)[0][-1] == "no, 12.5 are needed"


@pytest.mark.parametrize("wrong", ["batches=0", "seconds=-1", "workers=[]", "workers=[-1]"])
def test_numbers_out_of_range_end_in_one_sentence(compose, capture, tmp_path, wrong):
    with pytest.raises(ConfigError, match=wrong.split("=")[0]):
        run(compose("bench_loader", f"data.root={capture}", wrong), tmp_path)
