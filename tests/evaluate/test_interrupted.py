"""A scoring that is interrupted goes on where it ended, with the same scores."""

import json
import shutil

import pandas as pd
import pytest
from configs import evaluate_config

from gsgan.evaluate import kept
from gsgan.evaluate.scores import Tally
from gsgan.utils.errors import ConfigError, DataError


@pytest.fixture
def copied(run, tmp_path):
    return shutil.copytree(run, tmp_path / "run")


def evaluated(compose, folder, *overrides: str) -> pd.DataFrame:
    evaluate_config(
        compose(
            "evaluate",
            f"run={folder}",
            "device=cpu",
            "lpips.nets=[]",
            *overrides,
        )
    )
    return pd.read_csv(folder / "scores.csv")


def interrupt(monkeypatch, after: int) -> None:
    """Stops the next scoring after so many images."""
    monkeypatch.setattr(kept, "KEEP_SECONDS", 0.0)
    add = Tally.add

    def cut_off(self, *arguments, **options):
        if self.images == after:
            raise KeyboardInterrupt
        add(self, *arguments, **options)

    monkeypatch.setattr(Tally, "add", cut_off)


def test_an_interrupted_scoring_goes_on(copied, compose, monkeypatch, capsys):
    whole = evaluated(compose, copied)
    grid = (copied / "grids/novel_view.png").read_bytes()
    with monkeypatch.context() as patch:
        interrupt(patch, after=3)
        with pytest.raises(KeyboardInterrupt):
            evaluated(compose, copied)
    assert (copied / ".scoring").is_dir()
    capsys.readouterr()
    pd.testing.assert_frame_equal(evaluated(compose, copied), whole)
    assert "3 of" in capsys.readouterr().out
    assert (copied / "grids/novel_view.png").read_bytes() == grid
    assert not (copied / ".scoring").exists()


def test_the_config_of_the_caller_stays_as_it_is(
    copied, capture, compose, tmp_path
):
    """Its null for LPIPS' networks means those of each run."""
    (copied / "checkpoints/last.ckpt").unlink()
    data = ("data=capture", f"data.root={capture}")
    for given in (
        [f"run={copied}"],
        [f"predictions={tmp_path / 'none'}", *data],
    ):
        config = compose("evaluate", "device=cpu", *given)
        before = config.copy()
        with pytest.raises(DataError):
            evaluate_config(config)
        assert config == before


def test_scores_of_other_settings_are_not_used(
    copied, compose, monkeypatch, capsys
):
    with monkeypatch.context() as patch:
        interrupt(patch, after=3)
        with pytest.raises(KeyboardInterrupt):
            evaluated(compose, copied, "score_images=4")
    capsys.readouterr()
    evaluated(compose, copied)
    assert "scored before" not in capsys.readouterr().out


def test_a_damaged_file_is_written_again(copied, compose, capsys):
    folder = copied / ".scoring"
    folder.mkdir()
    (folder / "novel_view.pt").write_bytes(b"not a file of torch")
    evaluated(compose, copied)
    assert "scored before" not in capsys.readouterr().out


def test_a_part_of_the_images_is_scored_and_marked(copied, compose):
    """Beside the scores of all images, which stay."""
    whole = evaluated(compose, copied)
    left = evaluated(compose, copied, "score_images=1")
    pd.testing.assert_frame_equal(left, whole)
    part = copied / "of_1_images"
    table = pd.read_csv(part / "scores.csv")
    assert table.groupby(["split", "variant"]).size().max() == 1
    marks = json.loads((part / "metrics.json").read_text())["novel_view"][
        "full"
    ]
    assert any("at most 1" in mark for mark in marks["marks"])
    with pytest.raises(ConfigError, match="score_images"):
        evaluated(compose, copied, "score_images=0")
