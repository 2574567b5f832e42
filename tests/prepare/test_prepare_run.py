"""`gsgan.prepare` from videos on disk to a dataset that training reads."""

import io
import json
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from capture_scenes import options, quiet, write_project
from configs import mediapipe_tool, solve_settings
from make import edit_npz, skeletons
from rich.console import Console

import gsgan.prepare.mediapipe as tool
from gsgan.data.formats.capture import read_capture
from gsgan.prepare.options import Options
from gsgan.prepare.run import prepare
from gsgan.utils.errors import ConfigError, DataError, GsganError
from gsgan.utils.files import read_json

CAMERAS, FRAMES, SIZE = 3, 6, (96, 80)


@pytest.fixture
def project(tmp_path):
    """A project folder: videos, calibration, 2D landmarks and masks of a known person."""
    return write_project(tmp_path / "project", CAMERAS, FRAMES, SIZE)


def test_videos_become_a_capture_that_training_reads(project):
    settings = solve_settings(body=False)
    out = prepare(options(project, solve=settings), quiet())
    layout = read_capture(out)
    assert layout.camera_names == ("cam00", "cam01", "cam02")
    assert layout.frames == tuple(range(FRAMES))
    assert (layout.meta.fps, layout.meta.up_axis) == (30.0, "z")
    found = np.load(out / "landmarks3d.npz")
    known = np.isfinite(found["p"]).all(-1)
    assert known.mean() > 0.9
    np.testing.assert_allclose(
        found["p"][known], skeletons(FRAMES)[known], atol=0.02
    )
    assert np.nanmedian(found["reproj_px"]) < 0.2
    assert not layout.cameras["cam01"].distorted
    given = json.loads((project / "cameras.json").read_text())["cam01"]
    np.testing.assert_allclose(layout.cameras["cam01"].K, given["K"])
    # No hands and no face were given.
    assert not (out / "hands3d.npz").exists()
    assert not (out / "face3d.npz").exists()


def test_joints_that_no_two_cameras_see_are_inferred_and_marked(project):
    def hide(arrays):
        arrays["conf"][2, [13, 27]] = 0

    for path in sorted((project / "pose").iterdir())[:2]:
        edit_npz(path, hide)
    out = prepare(options(project, solve=solve_settings()), quiet())
    found = np.load(out / "landmarks3d.npz")
    assert np.isfinite(found["p"]).all()
    assert not found["seen"][2, [13, 27]].any()
    assert found["seen"].mean() > 0.95
    np.testing.assert_allclose(found["conf"][2, [13, 27]], 0.1)
    error = np.linalg.norm(found["p"] - skeletons(FRAMES), axis=-1)
    assert np.median(error) < 0.01
    assert error[2, [13, 27]].max() < 0.05


def test_the_numbers_have_every_stage_and_the_dataset_is_checked(
    project, monkeypatch, check
):
    monkeypatch.setattr("gsgan.prepare.run.check_capture", check)
    console = Console(file=io.StringIO(), width=100)
    out = prepare(options(project), console)
    assert "check.html" in console.file.getvalue()
    assert "smoothed" in console.file.getvalue()
    numbers = json.loads((out / "prepare.json").read_text())
    assert list(numbers["error_px"]) == [
        "plain",
        "robust",
        "flips",
        "refined",
        "smoothed",
    ]
    assert numbers["cameras"]["cam02"]["frames_written"] == FRAMES
    assert numbers["settings"]["solve"]["smoothing"] == 0.02
    assert (out / "check.html").read_text().count(
        "data:image/jpeg;base64,"
    ) >= CAMERAS
    assert json.loads((out / "check.json").read_text())["errors"] == 0


def test_a_camera_with_one_image_is_an_error(project):
    for path in sorted((project / "masks" / "cam01").iterdir())[1:]:
        path.unlink()
    with pytest.raises(DataError, match=r"cam01 .* mask in 1 of"):
        prepare(options(project), quiet())


def test_images_are_undistorted_and_scaled(project):
    out = prepare(options(project, scale=0.5, format="png"), quiet())
    camera = read_capture(out).cameras["cam00"]
    assert camera.size == (SIZE[1] // 2, SIZE[0] // 2)
    given = json.loads((project / "cameras.json").read_text())["cam00"]
    np.testing.assert_allclose(camera.K[:2], np.array(given["K"])[:2] / 2)
    mask = cv2.imread(
        str(out / "masks" / "cam00" / "000002.png"), cv2.IMREAD_GRAYSCALE
    )
    p = np.load(out / "landmarks3d.npz")["p"][2]
    x = p @ camera.R.T + camera.t
    uv = (x / x[:, 2:]) @ camera.K.T
    inside = mask[uv[:, 1].astype(int), uv[:, 0].astype(int)] > 127
    assert inside.mean() > 0.9


def test_the_same_again_is_left_alone_and_another_refused(project):
    out = prepare(options(project), quiet())
    before = (out / "meta.json").stat().st_mtime_ns
    prepare(options(project), quiet())
    assert (out / "meta.json").stat().st_mtime_ns == before
    with pytest.raises(DataError, match="overwrite=true"):
        prepare(options(project, scale=0.5), quiet())
    prepare(
        options(project, scale=0.5, overwrite=True, keep_work=False), quiet()
    )
    assert read_capture(out).cameras["cam00"].size == (40, 48)
    assert [
        p.name for p in out.parent.iterdir() if p.name.startswith(".")
    ] == []


def test_other_folders_are_never_overwritten(project):
    out = project.parent / "out"
    out.mkdir()
    (out / "thesis.txt").write_text("do not lose")
    with pytest.raises(DataError, match="out"):
        prepare(options(project, overwrite=True), quiet())
    assert (out / "thesis.txt").read_text() == "do not lose"


def test_a_camera_with_missing_masks_keeps_the_rest(project):
    (project / "masks" / "cam01" / "000003.png").unlink()
    out = prepare(options(project, frames="1-5"), quiet())
    layout = read_capture(out)
    assert sorted(layout.images["cam01"]) == [1, 2, 4, 5]
    assert sorted(layout.images["cam00"]) == [1, 2, 3, 4, 5]


def test_the_rate_of_every_other_frame_is_half_the_videos(project):
    out = prepare(options(project, frames="1-5:2"), quiet())
    half = read_json(out / "meta.json")["fps"]
    assert read_json(out / "prepare.json")["fps"] == half
    prepare(options(project, overwrite=True), quiet())
    assert read_json(out / "meta.json")["fps"] == 2 * half


def test_offsets_move_a_cameras_numbers(project):
    # The videos are synchronised, so an offset makes a clock late.
    late = options(project, offsets={"cam02": 1})
    with pytest.raises(DataError, match=r"was written, but .*cam02: 0"):
        prepare(late, quiet())
    out = Path(late.out)
    assert sorted(read_capture(out).images["cam02"]) == list(
        range(1, FRAMES)
    )  # frame 6 is its own alone
    with pytest.raises(ConfigError, match=r"offsets.*cam09"):
        prepare(
            options(project, offsets={"cam09": 1}, out=str(project / "x")),
            quiet(),
        )


def test_folders_of_images_need_a_frame_rate(project):
    for video in (project / "videos").iterdir():
        video.unlink()
    (project / "videos").rmdir()
    with pytest.raises(ConfigError, match="fps"):
        prepare(options(project), quiet())
    out = prepare(options(project, fps=25), quiet())
    assert read_capture(out).meta.fps == 25


def in_centimetres(project: Path) -> None:
    rig = json.loads((project / "cameras.json").read_text())
    for camera in rig.values():
        camera["t"] = [100 * x for x in camera["t"]]
    (project / "cameras.json").write_text(json.dumps(rig))


def one_video(project: Path) -> None:
    for name in ("cam01", "cam02"):
        (project / "videos" / f"{name}.avi").unlink()


def no_detections(project: Path) -> None:
    def change(arrays):
        arrays["left"] = arrays["px"][
            :, :21
        ].copy()  # hands alone do not make a person
        arrays["px"][:] = np.nan

    for path in (project / "pose").iterdir():
        edit_npz(path, change)


@pytest.mark.parametrize(
    ("break_it", "more", "what"),
    [
        (
            lambda p: None,
            {"unit": "mm"},
            r"cameras\.json: cameras stand 0\.003 m .* unit=mm",
        ),
        (
            in_centimetres,
            {},
            r"cameras\.json: cameras stand 3\d\d m .* unit=mm, cm or m",
        ),
        (lambda p: None, {"source": "nowhere"}, "nowhere does not exist"),
        (lambda p: (p / "cameras.json").unlink(), {}, "holds no calibration"),
        (
            lambda p: (p / "pose" / "cam01.npz").unlink(),
            {},
            "no landmarks of the camera cam01",
        ),
        (
            lambda p: (p / "pose" / "cam01.npz").write_bytes(b"PK"),
            {},
            r"cam01\.npz",
        ),
        (
            lambda p: (p / "videos" / "cam01.avi").write_bytes(b"RIFF"),
            {},
            r"cam01\.avi",
        ),
        (
            lambda p: (p / "masks" / "cam00" / "000001.png").write_bytes(b"x"),
            {},
            r"000001\.png",
        ),
        (no_detections, {}, "frame number"),
        (lambda p: None, {"frames": "90-99"}, "frames=90-99"),
        (
            lambda p: None,
            {"cameras": {"cam00": "cam01"}},
            "more than one video",
        ),
        (lambda p: None, {"unit": "inch"}, "unit"),
        (lambda p: None, {"source": None}, "source="),
        (one_video, {}, "cam00"),
    ],
)
def test_errors_are_one_sentence(project, break_it, more, what):
    break_it(project)
    with pytest.raises(GsganError, match=what) as failure:
        prepare(options(project, **more), quiet())
    assert "\n" not in str(failure.value)
    assert not (project.parent / "out").exists()


def test_every_key_of_the_config_is_understood(project, compose, capsys):
    config = compose(
        "prepare",
        f"source={project}",
        f"out={project.parent / 'out'}",
        f"landmarks={project / 'pose'}",
        f"masks={project / 'masks'}",
        "cameras={cam00: cam00}",
    )
    prepare(Options.from_config(config))
    assert "is ready" in capsys.readouterr().out


# ------------------------------------------------ the MediaPipe tool, without MediaPipe

STUB = """
import json, pathlib, shutil, sys
from types import SimpleNamespace
given = SimpleNamespace(**json.loads(sys.argv[1]))
names = "hands face rotate threads slot"
assert set(names.split()) < set(vars(given))
name, root = pathlib.Path(given.source).stem, pathlib.Path({root!r})
if name == {bad!r}:
    raise SystemExit("the stub refuses " + name)
shutil.copytree(root / "masks" / name, given.masks)
for i in range(6):
    print(i + 1, 6)
shutil.copy(root / "pose" / (name + ".npz"), given.out)
"""


def with_stub(project: Path, monkeypatch, bad: str = "") -> Options:
    environment = project.parent / "environment"
    (environment / "bin").mkdir(parents=True)
    (environment / tool.READY).touch()
    (environment / "bin" / "python").symlink_to(sys.executable)
    script = project.parent / f"stub{bad}.py"
    script.write_text(STUB.format(root=str(project), bad=bad))
    monkeypatch.setattr(tool, "SCRIPT", script)
    mediapipe = mediapipe_tool(folder=str(environment))
    return options(
        project, landmarks="mediapipe", masks="mediapipe", mediapipe=mediapipe
    )


def test_the_tool_runs_once_per_camera(project, monkeypatch):
    given = with_stub(project, monkeypatch)
    out = prepare(given, quiet())
    assert len(read_capture(out).frames) == FRAMES
    calls = []
    monkeypatch.setattr(
        "gsgan.prepare.mediapipe._detect", lambda *a, **k: calls.append(a)
    )
    smoother = {"scale": 0.5, "overwrite": True}
    prepare(replace(given, **smoother), quiet())
    assert calls == []


def test_the_message_of_a_failing_tool_is_its_last_line(project, monkeypatch):
    with pytest.raises(
        DataError,
        match=r"cam01\.avi.*the stub refuses",
    ):
        prepare(with_stub(project, monkeypatch, bad="cam01"), quiet())
    assert not (project.parent / "out").exists()


def test_the_environment_is_only_made_with_setup(project):
    missing = mediapipe_tool(folder=str(project / "nothing"))
    with pytest.raises(ConfigError, match="setup=true"):
        prepare(
            options(project, landmarks="mediapipe", mediapipe=missing), quiet()
        )
    assert not (project / "nothing").exists()


def test_errors_of_the_check_are_errors_of_the_command(project, monkeypatch):
    finding = {
        "level": "error",
        "topic": "body",
        "sentence": "a person of 2.95 m",
    }

    def found(_root: Path, page: Path, _console: Console) -> None:
        page.with_suffix(".json").write_text(
            json.dumps({"findings": [finding]})
        )

    monkeypatch.setattr("gsgan.prepare.run.check_capture", found)
    console = Console(file=io.StringIO(), width=100)
    for _ in range(2):  # the dataset that exists is not ready either
        with pytest.raises(DataError, match=r"2\.95 m.*check\.html"):
            prepare(options(project), console)
    assert "is ready" not in console.file.getvalue()
