"""`gsgan.bench effects`: decisions, runs that go on, figures off against on, an honest verdict."""

from __future__ import annotations

import contextlib
import json
import sys

import pytest
from gsgan.bench.effects_case import Row, Training
from gsgan.bench.effects_report import Report, text, write, write_docs
from gsgan.bench.environment import Environment
from hydra.utils import instantiate

from gsgan.bench import effects, effects_case, effects_cost
from gsgan.utils.errors import ConfigError, GsganError

WHERE = Environment("cpu", "Abacus", 1, "2026-01-01", {}, None)
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


# ---------------------------------------------------------------- the report


def test_the_table_shows_gain_cost_and_decision():
    page = text(Report([row(marks=["a stand-in"])], WHERE))
    line = next(x for x in page.splitlines() if x.startswith("| antialias"))
    assert "on: scales differ" in line
    assert "+1.00 (20.00 → 21.00)" in line
    assert "+0.50 (19.00 → 19.50)" in line
    assert "30.00 → 31.50" in line
    assert "+72" in line
    assert "Stand-in in use: a stand-in." in page


def test_what_was_not_trained_is_a_dash_and_no_failure(tmp_path):
    bare = Row("distortion", "default person", False, False, "no lens", "novel_view")
    report = Report([bare], WHERE)
    assert report.failures == []
    assert "| distortion | default person | off: no lens | – | – | novel_view | – | – | – |" in (
        text(report)
    )
    write(report, tmp_path, {"repeats": 1})
    record = json.loads((tmp_path / "effects.json").read_text())
    assert record["rows"][0]["gain_db"] == {"full": None, "splat": None}


@pytest.mark.parametrize(
    ("rows", "complaint"),
    [
        ([row(auto=False)], "auto leaves antialias in the scene antialias off"),
        ([row(called=False, auto=True)], "scene default person on"),
        ([row(on=19.9)], "gains -0.10 dB although it is called for"),
    ],
)
def test_what_is_not_as_it_must_be_is_said(rows, complaint):
    failures = Report(rows, WHERE).failures
    assert len(failures) == 1
    assert complaint in failures[0]
    assert "(wrong)" in text(Report(rows, WHERE)) or "auto" not in complaint


def test_an_effect_need_not_gain_where_it_is_not_called_for():
    assert Report([row(called=False, on=19.0)], WHERE).failures == []


def test_the_block_of_a_page_is_rewritten(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- bench:effects -->old<!-- end -->\nafter")
    write_docs(Report([row()], WHERE), page)
    assert "old" not in page.read_text()
    assert "| antialias |" in page.read_text()
    assert page.read_text().endswith("after")


# ---------------------------------------------------------------- what is run


@pytest.fixture
def bench(compose):
    def build(*overrides):
        return instantiate(compose("bench_effects", *overrides))

    return build


def test_the_default_person_without_effects_is_trained_once(bench):
    todo = list(effects.cells(bench()))
    assert len(todo) == 9
    names = [t.name for cell in todo for t in cell.runs.values()]
    assert names.count("default-off") == 4
    assert len(set(names)) == 13
    assert [c.row.effect for c in todo if not c.runs] == ["distortion"]
    for cell in todo:
        if cell.runs:
            off, on = cell.runs["off"].overrides, cell.runs["on"].overrides
            assert on[: len(off)] == off
            assert len(on) == len(off) + 1
            assert on[-1].startswith(f"effects.{cell.row.effect}=")


def test_only_some_and_not_on_the_default_person(bench):
    todo = list(effects.cells(bench("only=[antialias]", "default=false")))
    assert [(c.row.scene, list(c.runs)) for c in todo] == [
        ("antialias", ["off", "on"]),
        ("default person", []),
    ]


def test_without_training_only_auto_is_asked(bench, capture):
    todo = list(effects.cells(bench("train=false", f"real={capture}")))
    assert len(todo) == 10
    assert not any(c.runs for c in todo)


def test_the_real_capture_has_its_own_runs(bench, capture):
    cell = list(effects.cells(bench("only=[antialias]", f"real={capture}")))[-1]
    assert cell.row.scene == "real capture"
    assert (cell.row.effect, cell.row.split) == ("colour_correction", "novel_pose")
    assert {"data=capture", f"data.root='{capture}'"} <= set(cell.runs["off"].overrides)
    assert cell.runs["on"].name == "real-capture-on"


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("only=[gloss]", "only must list some of"),
        ("only=antialias", "only must list some of"),
        ("only=[]", "only must list some of"),
        ("repeats=0", "repeats must be"),
        ("frames=1.5", "frames must be"),
        ("real=nosuch/folder", "no such folder"),
        ("real_effect=depth", "real_effect must be one of"),
        ("cases.antialias.split=train", "split must be one of"),
    ],
)
def test_senseless_keys_end_in_one_sentence(inside, override, message):
    result = inside("bench", "effects", override)
    assert result.returncode == 1
    assert message in " ".join(result.stderr.split())
    assert "Traceback" not in result.stderr


# ---------------------------------------------------------------- training and timing


@pytest.fixture
def launched(monkeypatch):
    """`gsgan.train` in this process: a process of its own takes seconds to start."""
    started = []

    def launch(arguments, log):
        import gsgan.train.__main__

        started.append(list(arguments))
        monkeypatch.setattr(sys, "argv", ["gsgan.train", *arguments])
        with log.open("w") as stream, contextlib.redirect_stderr(stream):
            try:
                gsgan.train.main()
            except SystemExit as end:
                return int(end.code or 0)
        return 0

    monkeypatch.setattr(effects_case, "launch", launch)
    return started


def test_a_failed_run_is_one_sentence_with_what_it_said(launched, tmp_path):
    training = Training("one", ("data=capture", "data.root=/nowhere"))
    with pytest.raises(GsganError, match=r"training one failed: .*nowhere") as caught:
        effects_case.train(training, tmp_path, fresh=False)
    assert "\n" not in str(caught.value)


def test_a_process_of_its_own_trains_too(tmp_path):
    """The launcher itself, on a run that fails before torch has anything to do."""
    assert effects_case.launch(["size=nosuch"], tmp_path / "log") != 0
    assert "nosuch" in (tmp_path / "log").read_text()


def test_compose_leaves_the_outer_command_its_hydra():
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra

    from gsgan.utils.config import config_folder

    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        before = GlobalHydra.instance().hydra
        assert before is not None
        assert effects_case.compose(["size=tiny"]).size.picture == 32
        assert GlobalHydra.instance().hydra is before
        with pytest.raises(ConfigError, match="nosuch"):
            effects_case.compose(["size=nosuch"])
        assert GlobalHydra.instance().hydra is before


def test_frames_for_timing_are_spread():
    assert effects_cost.spread(10, 2) == [2, 7]
    assert effects_cost.spread(3, 8) == [0, 1, 2]


def test_the_whole_bench_in_miniature(launched, compose, tmp_path, monkeypatch):
    """One effect trained in its scene; the second time nothing is trained again."""
    monkeypatch.setenv("GSGAN_CACHE", str(tmp_path / "cache"))
    base = ",".join(f"'{x}'" for x in [*SCENE, *OFF])
    page, out = tmp_path / "page.md", tmp_path / "out"
    page.write_text("<!-- bench:effects --><!-- end -->")
    overrides = (
        *(f"base=[{base}]", "only=[colour_correction]", "frames=1", "repeats=2"),
        *(f"docs={page}", "threads=1", "default=false"),
    )
    config = compose("bench_effects", *overrides)

    said = ""
    try:
        effects.run(config, out)
    except GsganError as error:
        said = str(error)
    record = json.loads((out / "effects.json").read_text())
    assert said == "; ".join(record["failures"])
    found = {r["scene"]: r for r in record["rows"]}
    assert found["default person"]["auto"] is False
    one = found["colour_correction"]
    assert set(one["scores"]) == set(one["paint_ms"]) == set(one["read_ms"]) == {"off", "on"}
    assert all(ms > 0 for ms in (*one["paint_ms"].values(), *one["read_ms"].values()))
    assert one["parameters"]["on"] > one["parameters"]["off"]
    assert one["marks"]
    assert "| colour_correction |" in page.read_text()
    assert found["default person"]["scores"] == {}
    assert len(launched) == 2
    checkpoint = out / "runs" / "colour_correction-on" / "checkpoints" / "last.ckpt"
    before = checkpoint.stat().st_mtime_ns
    cell = next(effects.cells(instantiate(config)))
    again = effects_case.train(cell.runs["on"], out / "runs", fresh=False)
    assert effects_case.scores_of(again, one["split"]) == one["scores"]["on"]
    assert checkpoint.stat().st_mtime_ns == before
