"""The machine, tables, blocks of a page, memory, trainings."""

from __future__ import annotations

import json
import platform

import pandas as pd
import pytest
import torch
from omegaconf import OmegaConf

from gsgan.bench import common
from gsgan.bench.common import Bench, cpu_name, environment, number, sentence
from gsgan.utils.errors import ConfigError, GsganError


def test_the_machine_is_named_without_its_host():
    where = environment(torch.device("cpu"))
    line = sentence(where)
    assert f"{torch.get_num_threads()} thread" in line
    assert where["date"] in line
    assert f"torch {where['versions']['torch']}" in line
    host = platform.node()
    assert len(host) < 4 or host not in json.dumps(where)


def test_the_processors_name_is_read_or_replaced(tmp_path):
    listing = tmp_path / "cpuinfo"
    listing.write_text("processor : 0\nmodel name : Abacus 3000\nmodel name : Second\n")
    assert cpu_name(listing) == "Abacus 3000"
    assert cpu_name(tmp_path / "absent") == (platform.processor() or platform.machine())


@pytest.mark.parametrize(
    ("value", "digits", "shown"),
    [
        (None, 3, "–"),
        (float("nan"), 3, "–"),
        (float("inf"), 3, "∞"),
        (0.0, 3, "0.00"),
        (1.2345, 3, "1.23"),
        (12345.6, 3, "12346"),
        (0.0123, 2, "0.012"),
        (1.26e-5, 2, "1.3e-05"),
        (-2.5e-6, 2, "-2.5e-06"),
    ],
)
def test_numbers_have_their_significant_digits(value, digits, shown):
    assert number(value, digits) == shown


def start(folder, page=None):
    config = OmegaConf.create({"threads": None, "docs": page and str(page), "device": "cpu"})
    return Bench.start("mine", config, folder)


def test_files_and_the_block_of_a_page_are_written(tmp_path):
    page = tmp_path / "docs" / "page.md"
    page.parent.mkdir()
    page.write_text("A\n<!-- bench:mine -->\nold\n<!-- end -->\nB\n")
    frame = pd.DataFrame({"x": [1.5, None]})
    bench = start(tmp_path / "out", page)
    rows = {"rows": common.records(frame)}
    bench.write("Title", "text", rows, frame, {"one.png": b"png"}, docs="new")
    assert page.read_text() == "A\n<!-- bench:mine -->\n\nnew\n\n<!-- end -->\nB\n"
    assert (page.parent / "pictures" / "one.png").read_bytes() == b"png"
    assert (tmp_path / "out" / "mine.md").read_text() == "# Title\n\ntext\n"
    assert (tmp_path / "out" / "mine.csv").read_text() == 'x\n1.5\n""\n'
    found = json.loads((tmp_path / "out" / "mine.json").read_text())
    assert found["rows"] == [{"x": 1.5}, {"x": None}]
    assert found["where"]["device"] == "cpu"


def test_a_page_without_the_block_is_refused_at_the_start(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("nothing")
    with pytest.raises(ConfigError, match=r"page\.md: expected a block <!-- bench:mine -->"):
        start(tmp_path, page)


def test_a_failed_training_is_one_sentence_with_its_last_line(tmp_path, monkeypatch):
    def launch(arguments, log):
        log.write_text("some lines\ngsgan: no data\n")
        return 1

    monkeypatch.setattr(common, "launch", launch)
    with pytest.raises(GsganError, match=r"^training one failed: no data \(see .*one\.log\)$"):
        common.train(["size=tiny"], tmp_path / "runs" / "one")


def test_training_runs_in_another_process(tmp_path):
    assert common.launch(["size=nosuch"], tmp_path / "log") != 0
    assert "nosuch" in (tmp_path / "log").read_text()


def test_peak_memory_is_what_an_action_takes_on_top_of_what_is_held():
    held = torch.ones(20_000_000)  # 80 MB that must not count
    found = common.peak_memory(lambda: torch.ones(5_000_000).exp(), torch.device("cpu"))
    if found is None:
        pytest.skip("this system does not report a peak of memory")
    assert 20 < found < 70
    assert held.sum() == 20_000_000
