"""`gsgan.bench effects`: decisions, runs, figures with the effect off and on, failures."""

from __future__ import annotations

import contextlib
import json
import shutil
import sys

import pytest
from hydra import initialize_config_dir

from gsgan.bench import common, effects
from gsgan.bench.effects import Row, failures, page, rows_of
from gsgan.utils.config import config_folder
from gsgan.utils.errors import GsganError

WHERE = {"device": "cpu", "hardware": "Abacus", "threads": 1, "date": "", "load": None}
WHERE |= {"versions": {}}
OFF = [
    *("effects.view_dependence=off", "effects.distortion=off", "effects.antialias=off"),
    "effects.colour_correction=off",
]
SCENE = [
    *("size=tiny", "training=smoke", "data.source.frames=4", "data.source.test_frames=1"),
    *("data.source.train_cameras=3", "data.source.test_cameras=1", "data.source.workers=1"),
    "data.source.rays_per_pixel=1",
]


def row(effect="antialias", called=True, auto=None, off=20.0, on=21.0, **more) -> Row:
    auto = called if auto is None else auto
    values = {
        "effect": effect, "scene": effect if called else "default person", "called": called,
        "auto": auto, "why": "scales differ", "split": "novel_view",
        "scores": {"off": {"full": off, "splat": 19.0}, "on": {"full": on, "splat": 19.5}},
        "paint_ms": {"off": 30.0, "on": 31.5}, "read_ms": {"off": 2.0, "on": 2.0},
        "parameters": {"off": 1000, "on": 1072},
    }  # fmt: skip
    return Row(**(values | more))


# ---------------------------------------------------------------- the table


def test_the_table_shows_gain_cost_and_decision():
    text = page([row(marks=["a stand-in"])], WHERE)
    line = next(x for x in text.splitlines() if x.startswith("| antialias"))
    assert "on: scales differ" in line
    assert "+1.00 (20.00 → 21.00)" in line
    assert "+0.50 (19.00 → 19.50)" in line
    assert "30.00 → 31.50" in line
    assert "+72" in line
    assert "Note: a stand-in." in text


def test_what_was_not_trained_is_a_dash_and_no_failure():
    bare = Row("distortion", "default person", False, "novel_view", auto=False, why="no lens")
    assert failures([bare]) == []
    line = "| distortion | default person | off: no lens | – | – | novel_view | – | – | – |"
    assert line in page([bare], WHERE)


@pytest.mark.parametrize(
    ("rows", "complaint"),
    [
        ([row(auto=False)], "auto leaves antialias in the scene antialias off"),
        ([row(called=False, auto=True)], "scene default person on"),
        ([row(on=19.9)], "gains -0.10 dB although it is called for"),
    ],
)
def test_a_wrong_decision_and_a_missing_gain_are_failures(rows, complaint):
    (found,) = failures(rows)
    assert complaint in found
    assert "(wrong)" in page(rows, WHERE) or "auto" not in complaint


def test_an_effect_need_not_gain_where_it_is_not_called_for():
    assert failures([row(called=False, on=19.0)]) == []


# ---------------------------------------------------------------- what is run


@pytest.fixture
def rows(compose):
    return lambda *overrides: list(rows_of(compose("bench_effects", *overrides)))


def test_the_default_person_without_effects_is_trained_once(rows):
    found = rows()
    assert len(found) == 10
    names = [name for row in found for name in row.runs]
    assert names.count("default-off") == 3
    assert len(set(names)) == 14
    assert [row.effect for row in found if not row.runs] == ["distortion", "body_points"]
    for row in found:
        if row.runs:
            off, on = row.runs.values()
            assert on[: len(off)] == off
            assert len(on) == len(off) + 1
            assert on[-1].startswith(f"effects.{row.effect}=")


def test_only_some_and_not_on_the_default_person(rows):
    found = rows("only=[antialias]", "default=false")
    assert [(row.scene, list(row.runs)) for row in found] == [
        ("antialias", ["antialias-off", "antialias-on"]),
        ("default person", []),
    ]


def test_without_training_only_the_decisions_are_found(rows):
    found = rows("train=false")
    assert len(found) == 10
    assert not any(row.runs for row in found)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("only=[gloss]", "only must list some of"),
        ("only=antialias", "only must list some of"),
        ("only=[]", "only must list some of"),
        ("repeats=0", "repeats must be"),
        ("frames=1.5", "frames must be"),
        ("cases.antialias.split=train", "split must be one of"),
    ],
)
def test_wrong_keys_end_in_one_sentence(inside, override, message):
    result = inside("bench", "effects", override)
    assert result.returncode == 1
    assert message in " ".join(result.stderr.split())
    assert "Traceback" not in result.stderr


# ---------------------------------------------------------------- training and timing


@pytest.fixture
def launched(monkeypatch):
    """`gsgan.train` in this process: another process takes seconds to start."""
    started = []

    def launch(arguments, log):
        import gsgan.train.__main__

        started.append(list(arguments))
        monkeypatch.setattr(sys, "argv", ["gsgan.train", *arguments])
        with log.open("w") as stream, contextlib.redirect_stderr(stream):
            try:
                gsgan.train.__main__.main()
            except SystemExit as end:
                return int(end.code or 0)
        return 0

    monkeypatch.setattr(common, "launch", launch)
    return started


@pytest.fixture
def small(compose, tmp_path, monkeypatch):
    """The config of one effect in a tiny scene, with Hydra as in the command."""
    monkeypatch.setenv("GSGAN_CACHE", str(tmp_path / "cache"))
    base = ",".join(f"'{x}'" for x in [*SCENE, *OFF])
    page = tmp_path / "page.md"
    page.write_text("<!-- bench:effects --><!-- end -->")
    overrides = (
        *(f"base=[{base}]", "only=[colour_correction]", "frames=1", "repeats=2"),
        *(f"docs={page}", "threads=1", "default=false"),
    )
    config = compose("bench_effects", *overrides)
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        yield config


@pytest.mark.slow
def test_runs_are_scored_timed_and_written(run, small, tmp_path, monkeypatch):
    """The same finished run stands in for the training without the effect and with it."""

    def launch(arguments, log):
        shutil.copytree(run, log.with_suffix(""))
        return 0

    monkeypatch.setattr(common, "launch", launch)
    with pytest.raises(GsganError, match=r"gains \+0\.00 dB although it is called for"):
        effects.run(small, tmp_path / "out")
    rows = json.loads((tmp_path / "out" / "effects.json").read_text())["rows"]
    found = {row["scene"]: row for row in rows}
    assert found["default person"]["scores"] == {}
    one = found["colour_correction"]
    assert set(one["scores"]) == set(one["paint_ms"]) == set(one["read_ms"]) == {"off", "on"}
    assert all(ms > 0 for ms in (*one["paint_ms"].values(), *one["read_ms"].values()))
    assert one["marks"]
    assert "| colour_correction |" in (tmp_path / "page.md").read_text()


@pytest.mark.slow
def test_the_whole_bench_in_miniature(launched, small, tmp_path):
    """One effect trained in its scene; the second time nothing is trained again."""
    config, page, out = small, tmp_path / "page.md", tmp_path / "out"
    message = ""
    try:
        effects.run(config, out)
    except GsganError as error:
        message = str(error)
    record = json.loads((out / "effects.json").read_text())
    assert message == "; ".join(record["failures"])
    found = {r["scene"]: r for r in record["rows"]}
    assert found["default person"]["auto"] is False
    assert found["default person"]["scores"] == {}
    one = found["colour_correction"]
    assert set(one["scores"]) == set(one["paint_ms"]) == set(one["read_ms"]) == {"off", "on"}
    assert all(ms > 0 for ms in (*one["paint_ms"].values(), *one["read_ms"].values()))
    assert one["parameters"]["on"] > one["parameters"]["off"]
    assert one["marks"]
    assert "| colour_correction |" in page.read_text()
    assert len(launched) == 2
    checkpoint = out / "runs" / "colour_correction-on" / "checkpoints" / "last.ckpt"
    before = checkpoint.stat().st_mtime_ns
    name, words = list(next(rows_of(config)).runs.items())[1]
    common.train(words, out / "runs" / name)
    assert checkpoint.stat().st_mtime_ns == before
