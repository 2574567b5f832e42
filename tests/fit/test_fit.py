"""`gsgan.fit`: poses fill the masks better, and held-out images are not used."""

import json
import shutil
import threading
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from commands import refused
from configs import run_fit
from fit_quick import QUICK
from hydra.utils import instantiate
from make import edit_npz, write_hands, write_tiny_capture

import gsgan.utils.compat  # noqa: F401
from gsgan.body.shape import BodyShape, free_space, shape_body
from gsgan.body.solve import Solver
from gsgan.data.datamodule import GsganData
from gsgan.data.splits import spread_frames
from gsgan.evaluate.origin import fingerprint
from gsgan.evaluate.run import ScoreOptions, make_scorer
from gsgan.fit.fitter import Fitter
from gsgan.fit.frames import MaskedFrames, Silhouette, rotate_cameras
from gsgan.fit.run import fit_before_training, refuse_other_fit
from gsgan.fit.shape import fit_shape
from gsgan.run.assemble import AvatarSettings
from gsgan.scene import BodyPose
from gsgan.train.resume import training_record
from gsgan.utils.errors import ConfigError, DataError


def with_landmarks(people: Path, to: Path, change) -> Path:
    """A copy of the capture whose landmarks ``change`` alters in place."""
    shutil.copytree(people, to)
    edit_npz(to / "landmarks3d.npz", change)
    return to


def ready(people: Path, compose, *overrides: str, turn: float = 0.0) -> Fitter:
    """A fitter of the training frames, whose solved poses are turned by noise (radians)."""
    config = compose("fit", f"data.root={people}", *QUICK, *overrides)
    frames = MaskedFrames(
        instantiate(config.data, _convert_="all"), torch.device("cpu")
    )
    body = shape_body(fit_shape(frames.skeletons, frames.visibility))
    pose = Solver(body).solve(frames.skeletons, frames.visibility)
    noise = torch.randn(
        pose.theta.shape, generator=torch.Generator().manual_seed(0)
    )
    return Fitter(
        instantiate(config.fit),
        frames,
        body,
        BodyPose(pose.theta + turn * noise, pose.transl),
    )


def test_the_masks_are_filled_better(people, compose):
    fitter = ready(people, compose, "fit.sweeps=8", turn=0.05)
    for _ in range(20):
        fitter.surface_step()
    while fitter.swept < 8:
        fitter.sweep()
    before, after = fitter.overlap(fitter.start), fitter.overlap(fitter.pose())
    assert float(after.mean()) > float(before.mean()) + 0.02


def test_held_out_frames_are_solved_by_their_skeleton(fitted, fit, people):
    found = dict(np.load(fitted / "body_pose.npz"))
    assert found["registered"].tolist() == [0, 1, 2]
    again = fit(name="driven", keep=False)
    assert again["registered"].tolist() == []
    np.testing.assert_allclose(
        again["theta"][3:], found["theta"][3:], atol=1e-5
    )
    assert np.abs(again["theta"][:3] - found["theta"][:3]).max() > 1e-3
    assert found["frame_id"].tolist() == [0, 1, 2, 3, 4]
    data = GsganData(str(fitted), size=48)
    shape = {
        name: torch.from_numpy(x)
        for name, x in np.load(fitted / "body_shape.npz").items()
    }
    landmarks = data.layout.landmarks
    p = torch.from_numpy(np.stack([landmarks.p[f] for f in (3, 4)])).float()
    solved = Solver(shape_body(BodyShape(**shape))).solve(p, torch.ones(2, 33))
    np.testing.assert_allclose(found["theta"][3:], solved.theta, atol=0.05)
    np.testing.assert_allclose(
        0.01 * found["transl"][3:], solved.transl, atol=1e-3
    )
    both = fit("fit.held_out=true")
    assert both["registered"].tolist() == [0, 1, 2, 3, 4]
    assert np.abs(both["theta"][3:] - found["theta"][3:]).max() > 1e-3


def test_fingers_follow_the_hands_of_every_frame(people, fit, tmp_path):
    root = shutil.copytree(people, tmp_path / "hands")
    p = write_hands(root, 5, per_metre=100)
    p[4] = np.nan
    write_hands(root, 5, p=100 * p)
    found = fit(
        "data.skeleton=mediapipe33_hands", "fit.sweeps=1", root=root, keep=False
    )
    plain = fit("fit.sweeps=1", root=root, name="plain", keep=False)
    with np.load(tmp_path / "out" / "body_shape.npz") as shape:
        assert shape["hands"].shape == (2, 2, 3)
        assert (np.linalg.norm(shape["hands"], axis=-1) > 0).any()
    names = shape_body(free_space().neutral()).joint_names
    fingers = [
        i
        for i, name in enumerate(names)
        if name.startswith("finger") and "1-1" not in name
    ]
    trunk = [
        i
        for i, n in enumerate(names)
        if n.startswith(("root", "spine", "neck", "upperleg"))
    ]
    for one in (found, plain):  # a file serves both skeletons
        bent = np.linalg.norm(one["theta_hands"][:, fingers], axis=-1).max(-1)
        assert (bent[:4] > 0.05).all()  # held-out frames too
        assert bent[4] == 0  # hands that are not seen rest
        assert not one["theta"][:, fingers].any()
        apart = np.abs(one["theta"] - one["theta_hands"])[:, trunk]
        assert apart.max() < 0.02
        assert (
            np.abs(one["transl"] - one["transl_hands"]).max() < 0.2
        )  # centimetres


def test_what_is_written_is_read(fitted, people, compose):
    data, plain = (
        GsganData(str(fitted), size=48),
        GsganData(str(people), size=48),
    )
    frame = data.dataset("train")[0]
    poses, stored = data.layout.poses, np.load(fitted / "body_pose.npz")
    assert poses.fitted
    np.testing.assert_allclose(
        frame.body.theta[0], stored["theta"][0], atol=1e-6
    )
    np.testing.assert_allclose(
        frame.body.transl[0], 0.01 * stored["transl"][0], atol=1e-6
    )
    shape = BodyShape.of_flat(torch.tensor(data.info.betas))
    np.testing.assert_allclose(
        shape.stretch, np.load(fitted / "body_shape.npz")["stretch"]
    )
    assert fingerprint(plain) != fingerprint(data)
    report = json.loads((fitted / "body_fit.json").read_text())
    assert set(report["frames"]) == {"0", "1", "2"}
    assert len(report["joints"]) == 33
    config = compose(
        "train", "data=capture", f"data.root={fitted}", "size=tiny"
    )
    assert "fitted poses" in training_record(config, data)
    assert "fitted poses" not in training_record(config, plain)


def test_scores_say_that_held_out_frames_were_registered(
    fitted, fit, people, compose, tmp_path
):
    options = ScoreOptions(
        lpips={"nets": [], "path": None}, score_images=None, grid_rows=4
    )
    assert not any(
        "fitted" in mark
        for mark in make_scorer(options, GsganData(str(fitted)), []).marks
    )
    root = shutil.copytree(people, tmp_path / "both")
    run_fit(
        compose(
            "fit",
            f"data.root={root}",
            *QUICK,
            "fit.held_out=true",
            "fit.sweeps=1",
        )
    )
    marks = make_scorer(options, GsganData(str(root)), []).marks
    assert "body poses of 2 held-out frames fitted to their own masks" in marks
    other = GsganData(str(fitted), train_frames="0-1", test_frames="2-4")
    assert other.registered_held_out == (2,)


def test_a_camera_that_was_fitted_to_is_not_held_out(fitted):
    with pytest.raises(ConfigError, match="cam01"):
        GsganData(str(fitted), size=48, test_cameras=["cam01"]).setup()


def test_unseen_joints(fit, people, tmp_path):
    def hide(arrays):
        arrays["p"][:, 15] = np.nan  # a wrist, in no frame
        arrays["conf"] = np.ones(arrays["p"].shape[:2])
        arrays["conf"][1, 25] = 0  # a knee, in one

    found = fit(root=with_landmarks(people, tmp_path / "hidden", hide))
    assert np.isfinite(found["theta"]).all()


def test_a_fit_before_training_writes_poses_into_the_capture(
    people, compose, tmp_path
):
    root = str(shutil.copytree(people, tmp_path / "plain"))
    data = GsganData(root, size=48)
    assert data.lacks_body
    settings = instantiate(compose("fit", *QUICK, "fit.sweeps=1").fit)
    fit_before_training(data, settings, torch.device("cpu"))
    data = GsganData(root, size=48)
    assert not data.lacks_body
    assert data.layout.poses.fitted


def test_other_settings_of_a_fit_that_is_there_are_refused(
    people, compose, tmp_path
):
    root = str(shutil.copytree(people, tmp_path / "plain"))
    settings = instantiate(compose("fit", *QUICK, "fit.sweeps=1").fit)
    data = GsganData(root, size=48)
    refuse_other_fit(data, settings, ["fit.sweeps=1"])
    fit_before_training(data, settings, torch.device("cpu"))
    data = GsganData(root, size=48)
    refuse_other_fit(data, settings, ["fit.sweeps=1"])
    other = instantiate(compose("fit", *QUICK, "fit=refined").fit)
    refuse_other_fit(data, other, [])
    with pytest.raises(ConfigError, match=r"fit=refined changes nothing.*"):
        refuse_other_fit(data, other, ["fit=refined"])


def test_a_fit_before_training_reads_the_data_as_the_run_does(
    people, compose, tmp_path, monkeypatch
):
    given, fitted = [], {}
    keys = {
        "cache_mb": 7,
        "min_joints": 20,
        "distortion": "project",
        "train_frames": "0-1",
    }
    data = GsganData(
        str(shutil.copytree(people, tmp_path / "plain")), size=48, **keys
    )

    def fit_body(seen, settings, device):
        given.append(device)
        fitted.update(vars(seen))
        assert settings.sweeps == 2
        assert seen.trained == [0, 1]

    monkeypatch.setattr("gsgan.fit.run.fit_body", fit_body)
    settings = instantiate(compose("fit", "fit.sweeps=2").fit)
    device = torch.device("meta")
    fit_before_training(data, settings, device)
    assert given == [device]
    same = set(vars(data)) - {"size", "crop"}
    assert {"cache_mb", "limits", "lens", "split_keys", "skeleton"} <= same
    assert all(
        fitted[key] == getattr(data, key) for key in same - {"layout", "splits"}
    )
    assert (fitted["size"], fitted["crop"].margin, data.size) == (128, 0.2, 48)


def test_of_two_processes_one_fits(
    people, fitted, compose, tmp_path, monkeypatch
):
    """The second finds the poses that the first wrote while it waited."""
    root, fits, waits = (
        shutil.copytree(people, tmp_path / "both"),
        [],
        threading.Event(),
    )
    settings = instantiate(compose("fit").fit)
    device = torch.device("cpu")
    datas = [GsganData(str(root), size=48) for _ in range(2)]
    assert all(data.lacks_body for data in datas)

    def second():
        waits.set()
        fit_before_training(datas[1], settings, device)

    other = threading.Thread(target=second)

    def fit_body(seen, settings, device):
        fits.append(seen)
        other.start()
        waits.wait()
        for name in ("body_shape.npz", "body_pose.npz"):
            shutil.copy(fitted / name, root)

    monkeypatch.setattr("gsgan.fit.run.fit_body", fit_body)
    fit_before_training(datas[0], settings, device)
    other.join()
    assert len(fits) == 1
    assert GsganData(str(root), size=48).layout.poses.fitted


def test_held_out_cameras_are_not_used(fit, fitted, people, tmp_path):
    plain = np.load(fitted / "body_pose.npz")
    other = shutil.copytree(people, tmp_path / "other")
    for file in (other / "masks/cam03").iterdir():
        cv2.imwrite(str(file), np.full((96, 96), 255, np.uint8))
    lenient = "data.reader.consistency.frames=0"
    changed = fit(lenient, root=other, name="other")
    np.testing.assert_array_equal(plain["theta"], changed["theta"])
    assert list(plain["fitted_to"]) == ["cam00", "cam01", "cam02"]


def test_colours_are_not_used(fit, fitted, people, tmp_path):
    other = shutil.copytree(people, tmp_path / "other")
    for file in other.glob("images/*/*"):
        cv2.imwrite(str(file), np.full((96, 96, 3), 10, np.uint8))
    plain = np.load(fitted / "body_pose.npz")
    np.testing.assert_array_equal(plain["theta"], fit(root=other)["theta"])


@pytest.mark.parametrize(
    "hole",
    ["no mask of a moment", "a bystander in a moment", "a crumb in one mask"],
)
def test_an_empty_mask_does_not_affect_other_frames(
    fit, people, tmp_path, capsys, hole
):
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
    whole_images = ("data.crop=null", "data.reader.consistency.frames=0")
    found = fit(*whole_images, root=holed)
    plain = fit(*whole_images, name="plain")
    assert "left out" in capsys.readouterr().out
    others = [0, 2]
    apart = np.abs(plain["theta"] - found["theta"])[others].max()
    assert apart < 0.2
    assert found["registered"].tolist() == ([0, 2] if whole else [0, 1, 2])


def test_masks_without_anyone_are_refused(compose, people, tmp_path):
    empty = shutil.copytree(people, tmp_path / "empty")
    for file in empty.glob("masks/*/*"):
        cv2.imwrite(str(file), np.zeros((96, 96), np.uint8))
    with pytest.raises(DataError):
        run_fit(
            compose(
                "fit",
                f"data.root={empty}",
                f"out={tmp_path / 'a'}",
                *QUICK,
                "data.reader.consistency.frames=0",
            )
        )


def test_outside_the_image_alpha_costs_nothing(
    people, tmp_path, compose, monkeypatch
):
    """Pixels of a window outside the camera's image are ignored, and the fit ignores them."""
    oblong = write_tiny_capture(
        tmp_path / "oblong", cameras=2, frames=2, size=(96, 64)
    )
    frame = MaskedFrames(
        GsganData(str(oblong), size=48), torch.device("cpu")
    ).silhouettes(0)[0]
    beyond = frame.ignored > 0.5
    assert beyond.float().mean() == pytest.approx(1 / 3)
    assert float(frame.mask[beyond].max()) == 0

    # Whatever the masks are there, the surface becomes the same.
    read = MaskedFrames.silhouettes

    def fill(frames: MaskedFrames, i: int) -> list[Silhouette]:
        return [
            seen
            if seen.ignored is None
            else replace(seen, mask=torch.maximum(seen.mask, seen.ignored))
            for seen in read(frames, i)
        ]

    weights = []
    for silhouettes in (read, fill):
        monkeypatch.setattr(MaskedFrames, "silhouettes", silhouettes)
        fitter = ready(oblong, compose)
        fitter.surface_step()
        weights.append(list(fitter.surface.parameters()))
    torch.testing.assert_close(*weights, rtol=0, atol=0)
    monkeypatch.setattr(MaskedFrames, "silhouettes", read)
    inside = GsganData(str(people), size=48)
    assert (
        MaskedFrames(inside, torch.device("cpu")).silhouettes(0)[0].ignored
        is None
    )


def test_the_rims_of_an_undistorted_image_are_ignored(tmp_path):
    bent = write_tiny_capture(
        tmp_path / "bent",
        cameras=2,
        frames=2,
        size=(96, 96),
        dist=(0.3, 0, 0, 0, 0),
    )
    frame = MaskedFrames(
        GsganData(str(bent), size=48), torch.device("cpu")
    ).silhouettes(0)[0]
    assert float(frame.ignored[0, 0, 0, 0]) == 1
    assert float(frame.ignored[0, 0, 24, 24]) == 0


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["out=/proc/no"], "cannot be written"),
        (["fit.sweeps=0"], "fit.sweeps"),
        (["fit.points=2.5"], "fit.points"),
        (["fit.noise=0"], "fit.noise"),
        (["fit.prior=-1"], "fit.prior"),
        (["fit.hold=2"], "fit.hold"),
    ],
)
def test_wrong_settings_are_one_sentence(inside, people, overrides, words):
    refused(
        inside("fit", f"data.root={people}", "out=a", *QUICK, *overrides), words
    )


def test_an_earlier_fit_is_not_replaced_unasked(compose, fitted):
    with pytest.raises(ConfigError, match="overwrite=true"):
        run_fit(compose("fit", f"data.root={fitted}", *QUICK))


def test_poses_of_another_source_are_never_replaced(compose, capture):
    there = (capture / "body_pose.npz").read_bytes()
    with pytest.raises(ConfigError, match="did not make"):
        run_fit(
            compose("fit", f"data.root={capture}", "overwrite=true", *QUICK)
        )
    assert (capture / "body_pose.npz").read_bytes() == there


def test_other_formats_are_refused(compose, people, tmp_path):
    with pytest.raises(ConfigError, match="data=capture"):
        run_fit(
            compose(
                "fit",
                "data=zju_mocap",
                f"data.root={people}",
                f"out={tmp_path / 'a'}",
            )
        )


def test_a_truncated_shape_is_named(fitted, tmp_path):
    root = shutil.copytree(fitted, tmp_path / "cut")
    path = root / "body_shape.npz"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(DataError, match="body_shape"):
        GsganData(str(root), size=48).setup()


def test_no_image_is_read(fit, monkeypatch):
    def read(path):
        raise AssertionError(path)

    monkeypatch.setattr("gsgan.data.dataset.read_colour", read)
    assert len(fit("fit.sweeps=1")["theta"]) == 5


def test_a_long_capture_is_registered_in_a_few_frames(fit, tmp_path):
    """All poses are written all the same; registered ones are kept of all frames or none."""
    found = fit("fit.frames=2", "fit.cameras=2", keep=False)
    assert np.isfinite(found["theta"]).all()
    assert len(found["theta"]) == 5
    report = json.loads((tmp_path / "out/body_fit.json").read_text())
    assert len(report["frames"]) == 2
    assert fit("fit.frames=2", name="kept")["registered"].tolist() == [0, 1, 2]


def test_frames_with_poses_far_from_each_other_are_used(people):
    """An arm rises from frame to frame: its ends are chosen, a skeleton gone wrong is not."""
    landmarks = GsganData(str(people), size=48).layout.landmarks
    frames = range(40)
    p = {}
    for frame in frames:
        p[frame] = landmarks.p[0].copy()
        p[frame][[13, 15]] += [0.0, 0.0, 0.01 * frame]  # metres
    p[20][[13, 15]] += [0.0, 0.0, 3.0]
    visibility = dict.fromkeys(frames, landmarks.visibility[0])
    moved = replace(landmarks, p=p, visibility=visibility)

    assert spread_frames(moved, frames, 40) == list(frames)
    chosen = spread_frames(moved, frames, 5)
    assert len(chosen) == 5
    assert 20 not in chosen
    assert chosen[0] <= 2
    assert chosen[-1] >= 37
    assert max(np.diff(chosen)) < 20
    p[1] = p[0]
    assert len(spread_frames(moved, [0, 1] * 20, 5)) == 1


def test_cameras_rotate():
    cameras = ["a", "b", "c", "d"]
    assert rotate_cameras(cameras, None, 1) == cameras
    assert rotate_cameras(cameras, 4, 1) == cameras
    used = [rotate_cameras(cameras, 2, turn) for turn in range(4)]
    assert all(len(set(pair)) == 2 for pair in used)
    assert {camera for pair in used for camera in pair} == set(cameras)


@pytest.mark.parametrize(
    ("overrides", "moves"),
    [
        (["model=full"], True),
        (["model=lbs_splat"], True),
        (["model=splat_only"], True),
        (["model=splat_only", "effects.body_points=off"], False),
        (["model=wo_seg", "effects.body_points=off"], False),
        (["model=full", "effects.body_points=off"], True),
        (["model=image_to_image"], False),
    ],
)
def test_only_models_that_move_with_a_body_need_a_fit(
    compose, overrides, moves
):
    settings = AvatarSettings.from_config(compose("train", *overrides))
    assert settings.moves_with_body is moves
