"""Which folders are runs, what is read from them, and which are left out."""

import json
import re

import pytest
from omegaconf import OmegaConf
from report_folders import write_run

from gsgan.report.runs import find_runs, read_run, read_runs
from gsgan.utils.errors import ConfigError, DataError


def test_a_sweep_is_searched_and_each_run_taken_once(tmp_path):
    deep = write_run(tmp_path / "sweep" / "a" / "seed-0")
    flat = write_run(tmp_path / "sweep" / "b")
    (flat / "checkpoints").mkdir()
    (tmp_path / "sweep" / "multirun.yaml").write_text("")
    assert find_runs([str(tmp_path / "sweep")]) == [deep, flat]
    given = [f"{tmp_path}/sweep/b*", f"{tmp_path}/sweep", str(deep)]
    assert find_runs(given) == [flat, deep]


@pytest.mark.parametrize(
    "entry", ["absent", "x*", "a/metrics.json", "empty", ""]
)
def test_an_entry_without_a_run_is_refused(tmp_path, monkeypatch, entry):
    write_run(tmp_path / "a")
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=f"runs.*'{re.escape(entry)}'"):
        find_runs([entry])


def test_name_and_seed_come_from_the_facts(tmp_path):
    run = read_run(write_run(tmp_path / "a", "wo_gcn", 3, psnr=30.0))
    assert (run.name, run.seed, run.data["name"]) == ("wo_gcn", 3, "synthetic")
    predicted = write_run(
        tmp_path / "b", None, None, facts={"method": "gauhuman"}
    )
    assert (read_run(predicted).name, read_run(predicted).seed) == (
        "gauhuman",
        None,
    )


def trained(folder, config, **facts):
    """A scored run folder with a config."""
    write_run(folder, psnr=30.0, facts=facts)
    (folder / ".hydra").mkdir()
    OmegaConf.save(config, folder / ".hydra" / "config.yaml")
    return folder


def test_settings_are_without_the_seed(tmp_path, tiny):
    runs = [
        read_run(trained(tmp_path / str(seed), tiny(f"seed={seed}")))
        for seed in (4, 5)
    ]
    assert runs[0].settings == runs[1].settings
    other = read_run(
        trained(tmp_path / "other", tiny("training.pose_noise=0.5"))
    )
    assert other.settings != runs[0].settings


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("metrics.json", '{"novel_pose": {"full": {"psnr": 30', "broken"),
        ("facts.json", '{"model": "full", "data": 3}', "broken"),
        ("facts.json", "{", "broken"),
    ],
)
def test_a_damaged_file_is_named_and_its_run_left_out(
    tmp_path, file, text, message
):
    whole = write_run(tmp_path / "whole", psnr=30.0)
    broken = write_run(tmp_path / "broken", psnr=30.0)
    (broken / file).write_text(text)
    with pytest.raises(DataError, match=message):
        read_run(broken)
    runs, out = read_runs([whole, broken])
    assert [run.folder for run in runs] == [whole]
    assert list(out) == [broken]
    assert str(tmp_path) not in out[broken]  # it ends in pages that others read


def test_a_run_that_was_scored_half_way_is_left_out(tmp_path, tiny):
    run = trained(tmp_path / "a", tiny(), iterations=15)
    assert read_runs([run])[1] == {}
    facts = json.loads((run / "facts.json").read_text())
    (run / "facts.json").write_text(json.dumps(facts | {"iterations": 3}))
    assert read_runs([run])[1] == {
        run: "scored after 3 of at least 12 iterations"
    }


def test_an_unfinished_run_and_a_broken_config_are_left_out(tmp_path, tiny):
    unfinished = trained(tmp_path / "a", tiny())
    (unfinished / "metrics.json").unlink()
    broken = trained(tmp_path / "b", tiny())
    (broken / ".hydra" / "config.yaml").write_text("seed: [0")
    unknown = write_run(tmp_path / "c")
    (unknown / "facts.json").unlink()
    runs, out = read_runs(find_runs([str(tmp_path)]))
    assert not runs
    reasons = {folder.name: reason for folder, reason in out.items()}
    assert "not finished" in reasons["a"]
    assert "config.yaml" in reasons["b"]
    assert "no facts.json" in reasons["c"]


def test_it_reads_what_evaluate_writes(run):
    read = read_run(run)
    facts = json.loads((run / "facts.json").read_text())
    assert (read.name, read.seed) == ("full", 0)
    assert read.data["fingerprint"] == facts["data"]["fingerprint"]
    assert read.settings["training.schedule.epoch"] == 4
