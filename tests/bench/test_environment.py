"""Figures carry where they come from, and no host name."""

from __future__ import annotations

import json
import platform

import torch

from gsgan.bench.environment import cpu_name, environment


def test_it_names_device_threads_date_and_versions():
    where = environment(torch.device("cpu"))
    sentence = where.sentence()
    assert f"{torch.get_num_threads()} thread" in sentence
    assert where.date in sentence
    assert f"torch {where.versions['torch']}" in sentence
    assert where.hardware in sentence
    host = platform.node()
    assert len(host) < 4 or host not in json.dumps(where.as_dict())


def test_the_processors_name_is_read_or_replaced(tmp_path):
    listing = tmp_path / "cpuinfo"
    listing.write_text("processor : 0\nmodel name : Abacus 3000\nmodel name : Second\n")
    assert cpu_name(listing) == "Abacus 3000"
    assert cpu_name(tmp_path / "absent") == (platform.processor() or platform.machine())
