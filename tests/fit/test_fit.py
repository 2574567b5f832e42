"""`gsgan.fit`: noise shrinks, unseen joints stay missing, a stopped fit resumes."""

from __future__ import annotations

import random
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from commands import refused
from hydra import compose as compose_config
from hydra import initialize_config_dir
from hydra.utils import instantiate
from make import write_tiny_capture

import gsgan.utils.compat  # noqa: F401
from gsgan.data.datamodule import GsganData
from gsgan.data.formats.capture import CaptureReader
from gsgan.evaluate.facts import fingerprint
from gsgan.evaluate.run import make_scorer
from gsgan.fit import run as running
from gsgan.fit.fitter import Fitter, _wrong
from gsgan.fit.moments import Moments, around
from gsgan.fit.run import run_fit
from gsgan.train.runs import CHECKPOINT, checkpoint_to_resume, training_record
from gsgan.utils.config import config_folder
from gsgan.utils.errors import ConfigError, DataError

BODY = slice(11, 33)
QUICK = [
    "size.picture=48",
    "fit.shape_steps=6",
    "fit.sweeps=3",
    "fit.densify.points_per_limb=10",
    "fit.densify.face_points=20",
    "fit.densify.torso_points=40",
    "device=cpu",
    "shown=1",
]


@pytest.fixture(scope="module")
def people(tmp_path_factory) -> Path:
    """Four cameras around a person, one held out, landmarks in centimetres."""
    splits = {"train_cameras": ["cam00", "cam01", "cam02"], "test_cameras": ["cam03"]}
    root = tmp_path_factory.mktemp("people")
    return write_tiny_capture(root, cameras=4, frames=4, size=(96, 96), unit="cm", splits=splits)


@pytest.fixture(scope="module")
def fitted(people, tmp_path_factory) -> Path:
    """Landmarks of these people as a fit with the default settings of `QUICK` writes them."""
    out = tmp_path_factory.mktemp("fitted") / "fit.npz"
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = compose_config("fit", [f"data.root={people}", f"out={out}", *QUICK])
    return run_fit(config)


@pytest.fixture
def fit(compose, people, tmp_path):
    """Fits and returns the written arrays: ``fit("fit.sweeps=1", root=…)``."""

    def run(*overrides: str, root: Path = people, name: str = "fit.npz"):
        out = tmp_path / name
        run_fit(compose("fit", f"data.root={root}", f"out={out}", *QUICK, *overrides))
        return dict(np.load(out))

    return run


def with_landmarks(people: Path, to: Path, change) -> Path:
    """A copy of the capture whose landmarks ``change`` alters in place."""
    shutil.copytree(people, to)
    arrays = dict(np.load(to / "landmarks3d.npz"))
    change(arrays)
    np.savez(to / "landmarks3d.npz", **arrays)
    return to


def test_noise_in_the_landmarks_shrinks(fit, people, tmp_path):
    truth = np.load(people / "landmarks3d.npz")["p"]
    noise = 3 * np.random.default_rng(0).standard_normal(truth.shape)

    def add(arrays):
        arrays["p"] = truth + noise

    noisy = with_landmarks(people, tmp_path / "noisy", add)
    found = fit("fit.shape_steps=40", "fit.sweeps=10", root=noisy)

    def off(p):
        return np.linalg.norm(p - truth, axis=-1)[:, BODY].mean()

    assert off(found["p"]) < 0.8 * off(truth + noise)
    moved = 0.01 * np.linalg.norm(found["p"] - truth - noise, axis=-1)
    np.testing.assert_allclose(found["moved_m"], moved, atol=1e-5)


def test_the_masks_are_filled_better(people, compose):
    config = compose("fit", f"data.root={people}", *QUICK, "fit.sweeps=6")
    data = instantiate(config.data, _convert_="all")
    moments = Moments(data, torch.device("cpu"))
    chance = torch.Generator().manual_seed(0)
    noisy = moments.skeletons + 0.03 * torch.randn(moments.skeletons.shape, generator=chance)
    fitter = Fitter(instantiate(config.fit), moments, 0, noisy)
    for _ in range(40):
        fitter.shape_step()
    while fitter.swept < 6:
        fitter.sweep()
    before, after = fitter.agreement(noisy), fitter.agreement(fitter.joints())
    assert after.iou > before.iou + 0.02
    assert after.share < before.share


def test_an_unseen_joint_stays_missing(fit, people, tmp_path):
    def hide(arrays):
        arrays["p"][:, 15] = np.nan  # a wrist, in no frame
        arrays["conf"] = np.ones(arrays["p"].shape[:2])
        arrays["conf"][1, 25] = 0  # a knee, in one

    found = fit(root=with_landmarks(people, tmp_path / "hidden", hide))
    assert np.isnan(found["p"][:, 15]).all()
    assert np.isnan(found["moved_m"][:, 15]).all()
    assert np.isnan(found["moved_m"][1, 25])
    others = np.delete(np.arange(33), [15])
    assert np.isfinite(found["p"][:, others]).all()
    assert found["conf"][1, 25] == 0


def test_coincident_joints_keep_gradients_finite(people, compose):
    config = compose("fit", f"data.root={people}", *QUICK)
    moments = Moments(instantiate(config.data, _convert_="all"), torch.device("cpu"))
    start = moments.skeletons.clone()
    start[0, 13] = start[0, 11]  # an upper arm of no length
    start[1] = start[1, :1]  # a person of one point
    fitter = Fitter(instantiate(config.fit), moments, 0, start)
    fitter.shape_step()
    fitter.sweep()
    assert fitter.joints().isfinite().all()
    assert all(p.isfinite().all() for p in fitter.shape.parameters())


def test_held_out_cameras_are_not_used(fit, fitted, people, tmp_path):
    plain = np.load(fitted)
    other = shutil.copytree(people, tmp_path / "other")
    for file in (other / "masks/cam03").iterdir():
        cv2.imwrite(str(file), np.full((96, 96), 255, np.uint8))
    trust = "data.reader.trust.frames=0"
    changed = fit(trust, root=other, name="other.npz")
    np.testing.assert_array_equal(plain["p"], changed["p"])
    assert list(plain["fitted_to"]) == ["cam00", "cam01", "cam02"]


def test_colours_are_not_used(fit, fitted, people, tmp_path):
    other = shutil.copytree(people, tmp_path / "other")
    for file in other.glob("images/*/*"):
        cv2.imwrite(str(file), np.full((96, 96, 3), 10, np.uint8))
    np.testing.assert_array_equal(np.load(fitted)["p"], fit(root=other)["p"])


@pytest.mark.parametrize(
    "hole", ["no mask of a moment", "a bystander in a moment", "a crumb in one mask"]
)
def test_an_empty_mask_does_not_affect_other_frames(fit, people, tmp_path, capsys, hole):
    holed = shutil.copytree(people, tmp_path / "holed")
    whole = "moment" in hole
    for camera in ("cam00", "cam01", "cam02")[: 3 if whole else 1]:
        mask = np.zeros((96, 96), np.uint8)
        if "bystander" in hole:
            mask[:, :8] = 255
        if "crumb" in hole:
            mask[50:52, 50:52] = 255
        cv2.imwrite(str(holed / f"masks/{camera}/000001.png"), mask)
    capsys.readouterr()
    whole_pictures = ("data.crop=null", "data.reader.trust.frames=0")
    found = fit(*whole_pictures, root=holed)
    plain = fit(*whole_pictures, name="plain.npz")
    assert "left out" in capsys.readouterr().out
    there = np.load(people / "landmarks3d.npz")["p"]
    others = [0, 2, 3]
    moved = np.linalg.norm(plain["p"] - there, axis=-1)[others].mean()
    apart = np.linalg.norm(plain["p"] - found["p"], axis=-1)[others].mean()
    assert apart < moved
    if whole:
        np.testing.assert_array_equal(found["p"][1], there[1])
    else:
        assert np.nanmax(found["moved_m"][1]) < 0.1


def test_masks_without_anyone_are_refused(compose, people, tmp_path):
    empty = shutil.copytree(people, tmp_path / "empty")
    for file in empty.glob("masks/*/*"):
        cv2.imwrite(str(file), np.zeros((96, 96), np.uint8))
    with pytest.raises(DataError):
        run_fit(
            compose(
                *("fit", f"data.root={empty}", f"out={tmp_path / 'a.npz'}", *QUICK),
                *("data.reader.trust.frames=0", "data.reader.trust.watched_masks=0"),
            )
        )


def test_outside_the_image_alpha_costs_nothing(people, tmp_path, compose):
    """Pixels of a window outside the camera's image are unsure, and the fit ignores them."""
    oblong = write_tiny_capture(tmp_path / "oblong", cameras=2, frames=2, size=(96, 64))
    data = GsganData(str(oblong), size=48)
    moments = Moments(data, torch.device("cpu"))
    frame = moments.pictures(0)[0]
    assert frame.unsure is not None
    beyond = frame.unsure > 0.5
    assert beyond.float().mean() == pytest.approx(1 / 3)
    assert float(frame.mask[beyond].max()) == 0
    everything = torch.ones_like(frame.mask)
    assert float(_wrong(everything, frame)[beyond].max()) == 0
    whole = instantiate(compose("fit", *QUICK).fit)
    fitter = Fitter(whole, moments)
    fitter.shape.forward = lambda *_: everything  # alpha of 1 wherever the window is
    seen = [around(moments.skeletons[0], one) for one in moments.pictures(0)]
    everything = torch.ones(1, 1, *seen[0].mask.shape[-2:])
    area = sum(float(one.mask.sum()) for one in seen)
    counted = sum(float((1 - one.mask)[one.unsure < 0.5].sum()) for one in seen)
    share = fitter._share(0, torch.zeros(33, 3), random.Random(0))
    assert float(share) == pytest.approx(counted / area, rel=1e-5)
    assert counted < sum(float((1 - one.mask).sum()) for one in seen)
    inside = GsganData(str(people), size=48)
    assert Moments(inside, torch.device("cpu")).pictures(0)[0].unsure is None


def test_the_rims_of_an_undistorted_image_are_unsure(tmp_path):
    bent = write_tiny_capture(
        tmp_path / "bent", cameras=2, frames=2, size=(96, 96), dist=(0.3, 0, 0, 0, 0)
    )
    frame = Moments(GsganData(str(bent), size=48), torch.device("cpu")).pictures(0)[0]
    assert frame.unsure is not None
    assert float(frame.unsure[0, 0, 0, 0]) == 1
    assert float(frame.unsure[0, 0, 24, 24]) == 0


def test_frames_without_pictures_keep_their_landmarks(fit, people, tmp_path):
    def lengthen(arrays):
        for key in arrays:
            if key != "names":
                arrays[key] = np.concatenate([arrays[key], arrays[key][-1:]])
        arrays["frame_id"][-1] = 99

    longer = with_landmarks(people, tmp_path / "longer", lengthen)
    found = fit(root=longer)
    np.testing.assert_array_equal(found["p"][-1], np.load(longer / "landmarks3d.npz")["p"][-1])
    assert np.isnan(found["moved_m"][-1]).all()


def test_a_stopped_fit_resumes_to_the_same_end(fit, fitted, monkeypatch, tmp_path, capsys):
    whole = np.load(fitted)
    sweep, done = Fitter.sweep, []

    def stopping(self):
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(self.swept)
        return sweep(self)

    monkeypatch.setattr(Fitter, "sweep", stopping)
    with pytest.raises(KeyboardInterrupt):
        fit(name="again.npz")
    assert not (tmp_path / "again.npz").exists()
    monkeypatch.setattr(Fitter, "sweep", sweep)
    capsys.readouterr()
    again = fit(name="again.npz")
    assert "resuming after 2 of 3 sweeps" in capsys.readouterr().out
    np.testing.assert_array_equal(whole["p"], again["p"])
    assert not list(tmp_path.glob(".*fitting"))


def test_a_stopped_fit_does_not_resume_with_other_masks(fit, people, monkeypatch, tmp_path, capsys):
    other = shutil.copytree(people, tmp_path / "other")
    monkeypatch.setattr(running, "fit_picture", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        fit(root=other)
    monkeypatch.undo()
    file = next(other.glob("masks/cam00/*"))
    cv2.imwrite(str(file), cv2.dilate(cv2.imread(str(file), 0), np.ones((3, 3), np.uint8)))
    capsys.readouterr()
    fit("overwrite=true", root=other)
    assert "starting again" in capsys.readouterr().out


@pytest.mark.parametrize("left", ["other settings", "damage"])
def test_another_state_is_not_resumed(fit, fitted, monkeypatch, tmp_path, capsys, left):
    whole = np.load(fitted)
    if left == "damage":
        (tmp_path / ".again.npz.fitting").write_bytes(b"PK no")
    else:
        monkeypatch.setattr(running, "fit_picture", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            fit("fit.prior=0.5", name="again.npz")
        monkeypatch.undo()
    again = fit("overwrite=true", name="again.npz")
    assert "starting again" in capsys.readouterr().out
    np.testing.assert_array_equal(whole["p"], again["p"])


def test_the_image_shows_every_camera(fit, tmp_path):
    fit("shown=2")
    picture = cv2.imread(str(tmp_path / "fit.png"))
    assert picture.shape[1] == 3 * 300
    assert picture.shape[0] > 2 * 300


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


def test_a_fit_stopped_between_its_files_resumes(fit, monkeypatch, tmp_path):
    monkeypatch.setattr(running, "fit_picture", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        fit()
    assert (tmp_path / "fit.npz").exists()
    monkeypatch.undo()
    fit()
    assert (tmp_path / "fit.png").exists()


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
