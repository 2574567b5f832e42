"""`gsgan.fit`: noise shrinks, unseen joints stay missing, a stopped fit resumes."""

from __future__ import annotations

import random
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from fit_quick import QUICK
from hydra.utils import instantiate
from make import write_tiny_capture

import gsgan.utils.compat  # noqa: F401
from gsgan.data.datamodule import GsganData
from gsgan.fit import run as running
from gsgan.fit.fitter import Fitter, _wrong
from gsgan.fit.moments import Moments, around
from gsgan.fit.run import run_fit
from gsgan.utils.errors import DataError

BODY = slice(11, 33)


def with_landmarks(people: Path, to: Path, change) -> Path:
    """A copy of the capture whose landmarks ``change`` alters in place."""
    shutil.copytree(people, to)
    arrays = dict(np.load(to / "landmarks3d.npz"))
    change(arrays)
    np.savez(to / "landmarks3d.npz", **arrays)
    return to


@pytest.mark.slow
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


def test_a_fit_stopped_between_its_files_resumes(fit, monkeypatch, tmp_path):
    monkeypatch.setattr(running, "fit_picture", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        fit()
    assert (tmp_path / "fit.npz").exists()
    monkeypatch.undo()
    fit()
    assert (tmp_path / "fit.png").exists()
