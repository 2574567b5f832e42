"""`gsgan.fit`: what reads fitted landmarks knows them, and what cannot be fitted is refused."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from commands import refused
from fit_quick import QUICK

from gsgan.data.datamodule import GsganData
from gsgan.data.formats.capture import CaptureReader
from gsgan.evaluate.facts import fingerprint
from gsgan.evaluate.run import make_scorer
from gsgan.fit.run import run_fit
from gsgan.model.runs import CHECKPOINT
from gsgan.train.run import checkpoint_to_resume, training_record
from gsgan.utils.errors import ConfigError, DataError


def test_fitted_landmarks_are_read_and_are_other_data(fitted, people):
    plain = GsganData(str(people), size=48)
    other = GsganData(str(people), reader=CaptureReader(landmarks=str(fitted)), size=48)
    frame = other.dataset("train")[0]
    np.testing.assert_allclose(frame.skeleton[0], 0.01 * np.load(fitted)["p"][0], atol=1e-6)
    assert any("skeletons come from" in note for note in other.layout.notes)
    assert fingerprint(plain) != fingerprint(other)
    assert fingerprint(plain) == fingerprint(GsganData(str(people), size=48))


def test_a_camera_that_was_fitted_to_is_not_held_out(fitted, people):
    reader = CaptureReader(landmarks=str(fitted))
    leaking = GsganData(str(people), reader=reader, size=48, test_cameras=["cam01"])
    with pytest.raises(ConfigError, match="fitted to the masks of cam01"):
        leaking.setup()


def test_nor_where_all_its_images_are_of_held_out_poses(fitted, people, monkeypatch):
    splits = GsganData(str(people), size=48, test_cameras=["cam01"]).splits
    splits = replace(splits, items={**splits.items, "novel_view": ()})
    monkeypatch.setattr("gsgan.data.datamodule.make_splits", lambda *_, **__: splits)
    reader = CaptureReader(landmarks=str(fitted))
    with pytest.raises(ConfigError, match="cam01"):
        _ = GsganData(str(people), reader=reader, size=48).splits


def test_a_second_fit_keeps_the_cameras_of_the_first(fit, fitted):
    first = f"data.reader.landmarks={fitted}"
    again = fit(first, "data.train_cameras=[cam03]", "data.test_cameras=[]", name="again.npz")
    assert list(again["fitted_to"]) == ["cam00", "cam01", "cam02", "cam03"]


def test_scores_say_that_skeletons_were_fitted(fitted, people, compose):
    config = compose("train", "data=capture", f"data.root={people}")
    reader = CaptureReader(landmarks=str(fitted))
    for data, marked in (
        (GsganData(str(people), reader=reader), True),
        (GsganData(str(people)), False),
    ):
        marks = make_scorer(config, data, []).marks
        assert any("fitted to the masks of cam00" in mark for mark in marks) == marked


def test_a_file_in_the_folder_is_named_from_there(compose, people, tmp_path, capsys):
    root = shutil.copytree(people, tmp_path / "root")
    run_fit(compose("fit", f"data.root={root}", f"out={root / 'fit.npz'}", *QUICK))
    assert "data.reader.landmarks=fit.npz" in capsys.readouterr().out
    assert GsganData(
        str(root), reader=CaptureReader(landmarks="fit.npz")
    ).layout.landmarks.fitted_to


def test_a_body_pose_that_stays_is_noted(compose, capture, tmp_path, capsys):
    run_fit(compose("fit", f"data.root={capture}", f"out={tmp_path / 'a.npz'}", *QUICK))
    assert "body pose stays" in capsys.readouterr().out


def test_a_protocol_selects_cameras_but_not_the_size(compose):
    config = compose("fit", "protocol=zju_gauhuman", "data=capture")
    assert config.protocol.name == "zju_gauhuman"
    assert config.data.size == 128


@pytest.mark.parametrize("name", ["not_there.npz", "landmarks.json"])
def test_an_unusable_landmarks_file_is_refused(people, name):
    with pytest.raises(DataError, match=r"data\.reader\.landmarks"):
        GsganData(str(people), reader=CaptureReader(landmarks=name)).setup()


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["out=null"], "out is not set"),
        (["out=fit.txt"], "must end in .npz"),
        (["out=5"], "must end in .npz"),
        (["out=/proc/no/fit.npz"], "cannot be written"),
        (["fit.densify=null"], "fit.densify"),
        (["shown=0"], "shown must be"),
        (["fit.sweeps=0"], "fit.sweeps"),
        (["fit.sweeps=2.5"], "fit.sweeps"),
        (["fit.noise=0"], "fit.noise"),
        (["fit.prior=-1"], "fit.prior"),
        (["fit.hold=2"], "fit.hold"),
    ],
)
def test_wrong_settings_are_one_sentence(inside, people, overrides, words):
    refused(inside("fit", f"data.root={people}", "out=a.npz", *QUICK, *overrides), words)


def test_an_existing_file_is_not_replaced_unasked(compose, people, tmp_path):
    out = tmp_path / "fit.npz"
    out.write_bytes(b"mine")
    with pytest.raises(ConfigError, match="overwrite=true"):
        run_fit(compose("fit", f"data.root={people}", f"out={out}", *QUICK))
    assert out.read_bytes() == b"mine"


def test_the_landmarks_themselves_are_never_replaced(compose, people):
    there = (people / "landmarks3d.npz").read_bytes()
    out = people / "landmarks3d.npz"
    with pytest.raises(ConfigError, match="give another name"):
        run_fit(compose("fit", f"data.root={people}", f"out={out}", "overwrite=true", *QUICK))
    assert out.read_bytes() == there


def test_nor_is_the_file_that_is_read(fit, fitted, tmp_path):
    shutil.copy(fitted, tmp_path / "fit.npz")
    read = f"data.reader.landmarks={tmp_path / 'fit.npz'}"
    with pytest.raises(ConfigError, match="give another name"):
        fit(read, "overwrite=true")


def test_other_formats_are_refused(compose, people, tmp_path):
    with pytest.raises(ConfigError, match="data=capture"):
        run_fit(
            compose("fit", "data=zju_mocap", f"data.root={people}", f"out={tmp_path / 'a.npz'}")
        )


def test_training_does_not_resume_with_other_fitted_landmarks(
    fit, fitted, people, compose, tmp_path
):
    """The file of a stopped run may be made again under the same name."""
    config = compose("train", "data=capture", f"data.root={people}", "size=tiny")
    path, records = tmp_path / "fit.npz", []
    shutil.copy(fitted, path)
    for sweeps in (0, 1):
        if sweeps:
            fit(f"fit.sweeps={sweeps}", "overwrite=true")
        reader = CaptureReader(landmarks=str(path))
        records.append(training_record(config, GsganData(str(people), reader=reader, size=48)))
    folder = tmp_path / "run"
    (folder / "checkpoints").mkdir(parents=True)
    torch.save({"gsgan": {"record": records[0], "marks": []}}, folder / CHECKPOINT)
    assert checkpoint_to_resume(folder, records[0], []) == folder / CHECKPOINT
    with pytest.raises(ConfigError, match="fitted landmarks"):
        checkpoint_to_resume(folder, records[1], [])
    plain = training_record(config, GsganData(str(people), size=48))
    assert "fitted landmarks" not in plain
