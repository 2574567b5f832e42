"""Which folders are runs, what they tell, and how damaged ones are told apart."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from omegaconf import OmegaConf
from report_folders import report_of, row, table, texts, write_run

from gsgan.report.folders import find_runs, read_runs
from gsgan.report.mixing import differing, same_data
from gsgan.report.scored import read_run
from gsgan.utils.errors import ConfigError, DataError


def test_a_sweep_is_searched_and_each_run_taken_once(tmp_path):
    deep = write_run(tmp_path / "sweep" / "a" / "seed-0")
    flat = write_run(tmp_path / "sweep" / "b")
    (flat / "checkpoints").mkdir()
    (tmp_path / "sweep" / "multirun.yaml").write_text("")
    assert find_runs([str(tmp_path / "sweep")]) == [flat, deep]
    given = [f"{tmp_path}/sweep/b*", f"{tmp_path}/sweep", str(deep)]
    assert find_runs(given) == [flat, deep]


@pytest.mark.parametrize(
    ("entry", "said"),
    [("absent", "does not exist"), ("x*", "matches no folder"), ("a/metrics.json", "is a file"),
     ("empty", "holds no run folder")],
)  # fmt: skip
def test_what_is_no_run_is_refused(tmp_path, entry, said):
    write_run(tmp_path / "a")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match=said):
        find_runs([f"{tmp_path}/{entry}"])


def test_an_empty_entry_is_not_the_folder_one_stands_in(tmp_path, monkeypatch):
    write_run(tmp_path / "a")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="an entry is empty"):
        find_runs([""])


def test_facts_say_what_a_run_is(tmp_path):
    run = read_run(write_run(tmp_path / "a", "wo_gcn", 3, psnr=30.0))
    assert (run.name, run.seed, run.data["name"]) == ("wo_gcn", 3, "synthetic")
    predicted = write_run(tmp_path / "b", None, None, facts={"method": "gauhuman"})
    assert (read_run(predicted).name, read_run(predicted).seed) == ("gauhuman", None)


def old_run(folder, config, **choices):
    """A run folder from before facts.json."""
    write_run(folder, psnr=30.0)
    (folder / "facts.json").unlink()
    (folder / ".hydra").mkdir()
    OmegaConf.save(config, folder / ".hydra" / "config.yaml")
    held = {"hydra": {"runtime": {"choices": {"model": "full", "data": "capture", **choices}}}}
    (folder / ".hydra" / "hydra.yaml").write_text(OmegaConf.to_yaml(held))
    return folder


def test_an_old_folder_is_read_from_its_config(tmp_path, tiny):
    runs = [
        read_run(old_run(tmp_path / str(seed), tiny(f"seed={seed}"), model="wo_seg"))
        for seed in (4, 5)
    ]
    assert [(r.name, r.seed, r.data["name"]) for r in runs] == [
        ("wo_seg", 4, "capture"), ("wo_seg", 5, "capture"),
    ]  # fmt: skip
    assert runs[0].settings == runs[1].settings  # they differ in the seed alone
    assert runs[0].facts == {}
    other = read_run(old_run(tmp_path / "other", tiny("training.pose_noise=0.5")))
    assert other.settings != runs[0].settings
    assert other.data_settings() == runs[0].data_settings()


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        ("metrics.json", '{"novel_pose": {"full": {"psnr": 30', "damaged"),
        ("metrics.json", '{"novel_pose": {"full": {"psnr": NaN, "images": 1}}}', "damaged"),
        ("metrics.json", "[]", "expected a table"),
        ("metrics.json", "{}", "no scores"),
        ("metrics.json", '{"novel_pose": 3}', "novel_pose is not a table"),
        ("metrics.json", '{"novel_pose": {"full": {"psnr": "30", "images": 1}}}', "psnr must be"),
        ("metrics.json", '{"novel_pose": {"full": {"psnr": 30}}}', "count of images"),
        ("metrics.json", "\x00\x01", "damaged"),
        ("metrics.json", '{"a": {"full": {"psnr": 1%s, "images": 1}}}' % ("0" * 400), "psnr must"),
        ("metrics.json", '{"a": {"full": {"images": 1, "marks": [3]}}}', "marks must be"),
        ("metrics.json", '{"a": {"full": {"images": 1, "protocol": {}}}}', "protocol is not"),
        ("facts.json", '{"model": "full", "data": {"root": 3}}', "root cannot be 3"),
        ("facts.json", '{"model": "full", "data": {}, "commit": 5}', "commit cannot be 5"),
        ("facts.json", '{"model": "full", "data": {}, "train_seconds": "a"}', "train_seconds"),
        ("facts.json", '{"data": {}}', "neither a model nor a method"),
        ("facts.json", '{"model": "full", "data": 3}', "data must be a table"),
        ("facts.json", "{", "damaged"),
        ("facts.json", '{"model": "full", "data": {}, "seed": "a"}', "seed must be"),
        ("facts.json", '{"model": "full", "data": {}, "protocol": "p"}', "says protocol p"),
    ],
)
def test_a_damaged_file_is_named_and_its_run_left_out(tmp_path, file, text, said):
    whole = write_run(tmp_path / "whole", psnr=30.0)
    broken = write_run(tmp_path / "broken", psnr=30.0)
    (broken / file).write_text(text)
    with pytest.raises(DataError, match=said):
        read_run(broken)
    runs, out = read_runs([whole, broken])
    assert [run.folder for run in runs] == [whole]
    assert [held.folder for held in out] == [broken]
    assert str(tmp_path) not in out[0].reason  # it ends in pages that others read


def test_an_old_folder_and_a_new_one_are_matched_by_their_configs(tmp_path, tiny):
    old, new = (read_run(old_run(tmp_path / str(s), tiny(f"seed={s}"))) for s in (0, 1))
    new = replace(new, data=new.data | {"fingerprint": "f00d"})
    assert same_data(old, new)
    assert same_data(old, replace(new, data=new.data | {"root": "elsewhere"})) is False
    assert same_data(old, replace(new, data=new.data | {"name": "zju_mocap"})) is False
    assert same_data(old, replace(new, settings=None)) is None  # predictions: no config
    before = {k: v for k, v in old.settings.items() if k != "data.reader.landmarks"}
    assert same_data(replace(old, settings=before), new)  # of a config that had no such key yet
    assert differing(before, old.settings) == []
    other = read_run(old_run(tmp_path / "other", tiny("data.train_frames=[0,1]")))
    assert same_data(old, other) is False


def test_a_run_that_was_scored_half_way_is_left_out(tmp_path, tiny):
    run = old_run(tmp_path / "a", tiny())
    for done in (15, 3):
        facts = {"model": "full", "data": {}, "iterations": done}
        (run / "facts.json").write_text(json.dumps(facts))
        told = [held.reason for held in read_runs([run])[1]]
        assert told == ([] if done == 15 else ["scored after 3 of at least 12 iterations"])


def test_an_unfinished_run_and_a_broken_config_are_left_out(tmp_path, tiny):
    unfinished = old_run(tmp_path / "a", tiny())
    (unfinished / "metrics.json").unlink()
    broken = old_run(tmp_path / "b", tiny())
    (broken / ".hydra" / "config.yaml").write_text("seed: [0")
    unknown = write_run(tmp_path / "c")
    (unknown / "facts.json").unlink()
    runs, out = read_runs(find_runs([str(tmp_path)]))
    assert not runs
    told = {held.folder.name: held.reason for held in out}
    assert "not finished" in told["a"]
    assert "damaged" in told["b"]
    assert "neither facts.json nor .hydra" in told["c"]


def test_every_score_of_the_evaluation_has_a_column():
    from gsgan.evaluate.scores import METRICS as SCORED
    from gsgan.report.spec import METRICS as SHOWN

    assert set(SHOWN) >= set(SCORED)


def test_the_format_is_the_evaluations_own(run):
    read = read_run(run)
    facts = json.loads((run / "facts.json").read_text())
    assert (read.name, read.seed) == ("full", 0)
    assert read.data["fingerprint"] == facts["data"]["fingerprint"]
    assert read.settings["training.schedule.epoch"] == 4


def test_predictions_that_were_scored_stand_beside_a_run(run, capture, tmp_path, inside):
    """Black pictures of a method of someone else: its row has the floor's very scores."""
    from gsgan.train.runs import build_data, load_config

    for camera, frame in build_data(load_config(run)).dataset("novel_pose").items:
        path = tmp_path / "black" / "novel_pose" / camera / f"{frame:06d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.zeros((32, 32, 3), np.uint8))
    given = ["data=capture", "data.size=32", "data.crop=null", f"data.root={capture}"]
    given += ["splits=[novel_pose]"]
    result = inside("evaluate", f"predictions={tmp_path / 'black'}", *given)
    assert result.returncode == 0, result.stderr
    report = report_of(table(metrics=["psnr"]), run, tmp_path / "black_scores")
    (grid,) = report.grids
    assert [r.label for r in grid.rows] == ["black", "full", "all background (floor)"]
    assert texts(row(grid, "black")) == texts(row(grid, "all background (floor)"))
    assert row(grid, "black").origin[0] == "1"
