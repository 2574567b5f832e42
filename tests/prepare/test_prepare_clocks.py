"""Frames of several cameras are paired by their time stamps; late clocks are measured."""

from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import av
import cv2
import numpy as np
import pytest
from capture_scenes import options, quiet, ring, seen, write_project
from make import skeletons

from gsgan.prepare.camera_array import CameraArray
from gsgan.prepare.clocks import (
    ClockErrors,
    by_time,
    clock_errors,
    moments,
    rate_of,
    unsteady_clocks,
)
from gsgan.prepare.frames import sample
from gsgan.prepare.run import prepare
from gsgan.prepare.sources import recording_notes, video_recording
from gsgan.prepare.stages import StageFolder
from gsgan.prepare.summary import late_clocks
from gsgan.utils.errors import DataError
from gsgan.utils.files import read_json

SIZE = (64, 48)


def write_video(path: Path, times, rate: int = 30, lost: int = 0) -> Path:
    """A grey video with images at ``times``, in units of 1 / rate seconds, without its first
    ``lost`` packets."""
    out = av.open(str(path), "w")
    stream = out.add_stream("libx264", rate=rate)
    stream.width, stream.height = SIZE
    stream.pix_fmt = "yuv420p"
    stream.options = {"g": "12", "bf": "0", "sc_threshold": "0"}
    packets = []
    for time in times:
        grey = np.full((SIZE[1], SIZE[0], 3), 20 + 2 * (time % 100), np.uint8)
        frame = av.VideoFrame.from_ndarray(grey, format="bgr24")
        frame.pts = time
        frame.time_base = Fraction(1, rate)
        packets += stream.encode(frame)
    for packet in [*packets, *stream.encode()][lost:]:
        out.mux(packet)
    out.close()
    return path


def recordings(folder: Path, **times) -> dict:
    return {
        name: video_recording(
            write_video(folder / f"{name}.mp4", *given), rotate=False
        )
        for name, given in times.items()
    }


def common(folder: Path, **times) -> dict:
    """The common numbers of the images of each video."""
    found = by_time(recordings(folder, **times), StageFolder(folder), 1)
    return {
        name: None if source.common is None else source.common
        for name, source in found.sources.items()
    }


def test_clocks_that_agree_keep_their_numbers(tmp_path):
    sources = recordings(tmp_path, a=(range(20),), b=(range(16),))
    found = by_time(sources, StageFolder(tmp_path), 1)
    assert found.sources == sources
    assert found.notes == []


def test_every_other_frame_of_60_per_second_is_paired_with_30(tmp_path):
    sources = recordings(tmp_path, a=(range(40), 60), b=(range(20), 30))
    found = by_time(sources, StageFolder(tmp_path), 1)
    assert found.rate == 30
    assert found.sources["a"].common == {2 * k: k for k in range(20)}
    assert found.sources["b"].common == {k: k for k in range(20)}
    assert "a 60, b 30" in found.notes[0]
    numbers = [number for number, _ in found.sources["a"].images()]
    assert numbers == list(range(20))


def test_frames_that_one_camera_lost_are_left_out(tmp_path):
    kept = [k for k in range(30) if k not in (7, 8, 20)]
    found = common(tmp_path, a=(kept,), b=(range(30),))
    assert found["a"] == dict(enumerate(kept))
    assert found["b"] == {k: k for k in range(30)}


def test_a_recording_that_begins_without_a_key_frame_keeps_its_times(tmp_path):
    found = common(tmp_path, a=(range(36), 30, 5), b=(range(31),))
    assert found["a"] == {i: i + 7 for i in range(24)}


def test_time_stamps_that_do_not_increase_are_refused(tmp_path, monkeypatch):
    sources = recordings(tmp_path, a=(range(6),), b=(range(6),))
    monkeypatch.setattr("gsgan.prepare.clocks._times", lambda *_: np.zeros(6))
    with pytest.raises(DataError, match=r"a\.mp4: its time stamps are missing"):
        by_time(sources, StageFolder(tmp_path), 1)


def test_a_video_that_ends_early_is_named(tmp_path):
    sources = recordings(tmp_path, a=(range(20),), b=(range(20),))
    sources["a"] = replace(sources["a"], count=40)
    (note,) = by_time(sources, StageFolder(tmp_path), 1).notes
    assert "a: only 20 of 40 frames" in note


def test_the_rate_is_that_between_frames_that_were_lost():
    time = np.array([0, 1, 2, 5, 6, 7]) / 30
    video = type("Video", (), {"fps": 21.4})()
    assert rate_of(video, time) == pytest.approx(30)
    assert moments(np.array([0.0, 0.02, 0.034]), 30) == (
        {0: 0, 2: 1},
        pytest.approx(0.0007, abs=1e-4),
    )
    # The last of 60 per second is as near to a moment that it does not show.
    assert list(moments(np.arange(4) / 60, 30)[0]) == [0, 2]


def test_a_header_without_a_length_is_unknown(tmp_path, monkeypatch):
    path = write_video(tmp_path / "a.mp4", range(120))
    monkeypatch.setattr("gsgan.prepare.sources._length", lambda _: -(2**58))
    source = video_recording(path, rotate=False)
    assert source.count is None
    assert recording_notes({"a": source}) == []
    recording, time = sample(path, tmp_path / "images")
    assert recording.count == 60
    assert time[-1] > 3.8


def test_the_length_of_a_recording_that_begins_late_is_unknown(tmp_path):
    """Matroska's duration counts from 0, wherever the first image is."""
    path = write_video(tmp_path / "a.mkv", range(300, 340))
    assert video_recording(path, rotate=False).count is None
    path = write_video(tmp_path / "b.mkv", range(40))
    assert video_recording(path, rotate=False).count == 40


def test_a_project_with_a_camera_of_twice_the_rate(tmp_path):
    project = write_project(tmp_path / "project", 3, 12)
    video = project / "videos" / "cam00.avi"
    video.unlink()
    writer = cv2.VideoWriter(
        str(video), cv2.VideoWriter_fourcc(*"MJPG"), 60, (96, 80)
    )
    images = sorted((project / "images" / "cam00").iterdir())
    for path in [path for path in images for _ in range(2)]:
        writer.write(cv2.imread(str(path)))
    writer.release()
    pose = np.load(project / "pose" / "cam00.npz")
    np.savez(
        project / "pose" / "cam00.npz",
        px=np.repeat(pose["px"], 2, axis=0),
        conf=np.repeat(pose["conf"], 2, axis=0),
        frame_id=np.arange(24),
    )
    masks = project / "masks" / "cam00"
    for k in reversed(range(12)):
        content = (masks / f"{k:06d}.png").read_bytes()
        for j in (0, 1):
            (masks / f"{2 * k + j:06d}.png").write_bytes(content)

    out = prepare(options(project), quiet())
    numbers = read_json(out / "prepare.json")
    assert numbers["fps"] == 30
    assert numbers["cameras"]["cam00"]["frames_written"] == 12
    found = np.load(out / "landmarks3d.npz")
    np.testing.assert_array_equal(found["frame_id"], np.arange(12))
    known = np.isfinite(found["p"]).all(-1)
    np.testing.assert_allclose(
        found["p"][known], skeletons(12)[known], atol=0.02
    )


# ------------------------------------------------ late clocks


def walk(time: np.ndarray, size: float = 1.0) -> np.ndarray:
    """``[F, 33, 3]`` a person who moves all joints, at times in frames; ``size`` 0 stands still."""
    seconds = time / 30
    p = np.repeat(skeletons(2)[:1], len(time), axis=0)
    p[:, :, 0] += size * 0.8 * np.sin(0.7 * seconds)[:, None]
    p[:, :, 1] += size * 0.8 * np.cos(0.9 * seconds)[:, None]
    for j in range(33):
        turn = np.pi * (1 + (7 * j) % 5 / 5) * seconds
        ways = [np.sin(turn + j), np.cos(turn + 2 * j), np.sin(turn + 3 * j)]
        p[:, j] += size * 0.12 * np.stack(ways, axis=-1)
    return p


def filmed(times, noise: float = 3.0, size: float = 1.0):
    """A rig whose cameras show the person at ``times [C, F]``: ``uv`` and confidence."""
    cameras = ring()[: len(times)]
    uv = []
    for camera, time in zip(cameras, times, strict=True):
        p = walk(np.asarray(time, float), size)
        uv.append(seen([camera], p=p)[2][0])
    uv = np.stack(uv)
    uv += noise * np.random.default_rng(0).standard_normal(uv.shape)
    return CameraArray.of(cameras), uv, np.ones(uv.shape[:3])


FRAMES = np.arange(120)


@pytest.mark.parametrize(
    "late",
    [(0, 10.3, 0), (0, 0.6, 0, 0), (0, 2.5, 0, -7.2), (0, 12.4), (0, 0, 0)],
)
def test_late_clocks_are_measured_to_a_tenth_of_a_frame(late):
    delay, gain, other, error = clock_errors(
        *filmed([FRAMES + d for d in late])
    )
    np.testing.assert_allclose(delay, late, atol=0.1)
    assert (error < 0.1).all()
    assert (gain[np.array(late) > 1] > 0.3).all()
    assert np.isnan(other).all()

    # The advice, followed once, leaves less than half a frame.
    followed = [FRAMES + d - round(d) for d in delay]
    shown = [t + d - e for t, d, e in zip(followed, late, delay, strict=True)]
    rest = clock_errors(*filmed(shown)).delay
    assert np.abs(rest).max() <= 0.6


@pytest.mark.parametrize(
    ("delay", "offsets", "wrong"),
    [
        (2.4, None, True),
        (-0.95, None, True),
        (-0.75, None, False),  # as in Pose2Sim's videos
        (0.4, None, False),
        (0.6, {"b": 2}, False),  # what whole offsets may leave
        (1.6, {"b": 2}, True),
    ],
)
def test_a_clock_that_is_a_frame_late_is_an_error(delay, offsets, wrong):
    outcome = SimpleNamespace(
        frames=np.arange(10),
        inputs=SimpleNamespace(sources=("a", "b")),
        options=SimpleNamespace(offsets=offsets),
        solution=SimpleNamespace(
            clocks=ClockErrors(
                delay=np.array([0.0, delay]),
                gain=np.array([0.0, 0.5]),
                other=np.array([np.nan, np.nan]),
                error=np.array([0.1, 0.1]),
            )
        ),
    )
    clocks = late_clocks(outcome)
    assert clocks.wrong == wrong
    corrected = (offsets or {}).get("b", 0) + round(delay)
    if abs(delay) > 0.5:
        assert f"offsets={{b: {corrected}}}" in clocks.notes[0]


@pytest.mark.parametrize("period", [24, 31.5])
@pytest.mark.parametrize("late", [0, 7, -11.4])
def test_a_motion_that_repeats_itself_has_other_delays(period, late):
    """As jumping jacks: the delay is one of those that are whole periods apart, and both are
    named."""
    times = [FRAMES, FRAMES + late, FRAMES]
    clocks = clock_errors(*filmed([time % period for time in times]))
    off = (clocks.delay[1] - late) / period
    assert off == pytest.approx(round(off), abs=0.03)
    between = (clocks.other[1] - clocks.delay[1]) / period
    assert round(between)
    assert between == pytest.approx(round(between), abs=0.1)
    outcome = SimpleNamespace(
        frames=np.arange(10),
        inputs=SimpleNamespace(sources=("a", "b", "c")),
        options=SimpleNamespace(offsets=None),
        solution=SimpleNamespace(clocks=clocks),
    )
    notes = late_clocks(outcome).notes
    advice = [note for note in notes if "set offsets" in note]
    assert all("the motion repeats itself" in note for note in advice)


def said_of(clocks: ClockErrors):
    """What the command says of the clocks of cameras in every frame."""
    names = [f"cam{c}" for c in range(len(clocks.delay))]
    outcome = SimpleNamespace(
        frames=np.arange(10),
        inputs=SimpleNamespace(sources=names),
        options=SimpleNamespace(offsets=None),
        solution=SimpleNamespace(clocks=clocks),
    )
    return late_clocks(outcome)


@pytest.mark.parametrize("frames", [40, 120])
@pytest.mark.parametrize("size", [0, 0.01, 0.03, 0.1, 0.3, 1])
@pytest.mark.parametrize("speed", [0.1, 0.25, 1])
@pytest.mark.parametrize("late", [(0, -3.3), (0, 0.6, 0, -3.3)])
def test_a_delay_that_is_measured_wrong_is_doubtful(frames, size, speed, late):
    """Slow motion and a person who hardly moves: nothing is advised that the motion does not
    show."""
    times = [speed * (np.arange(frames) + d) for d in late]
    clocks = clock_errors(*filmed(times, size=size))
    off = clocks.delay - late
    off = np.abs(off - off[0])
    said = said_of(clocks)
    notes = " ".join(said.notes)
    doubtful = "how late clocks are is uncertain" in notes
    if not off.max() < 0.3:
        assert doubtful
    if size == 0:
        assert "set offsets" not in notes
    if size == speed == 1:
        assert not doubtful


@pytest.mark.parametrize("frames", [40, 120, 300])
def test_a_camera_of_another_rate_is_an_error(frames):
    """60 frames a second that are played at 30, without time stamps that say so."""
    time = np.arange(frames)
    said = said_of(clock_errors(*filmed([time, time / 2, time, time])))
    assert said.wrong
    assert "at another rate" in said.notes[0]
    assert "set offsets" not in " ".join(said.notes)


def test_clocks_without_a_frame_in_common_are_doubtful():
    cameras, uv, conf = filmed([FRAMES, FRAMES])
    conf[0, :60] = 0
    conf[1, 60:] = 0
    said = said_of(clock_errors(cameras, uv, conf))
    assert not said.wrong
    assert "cam0 unknown, cam1 unknown" in said.notes[0]


def test_a_camera_that_loses_frames_without_a_gap_is_named():
    lost = np.delete(np.arange(123), [50, 60, 70])
    drift = unsteady_clocks(*filmed([FRAMES, lost, FRAMES]))
    np.testing.assert_allclose(drift, [0, 3, 0], atol=0.3)
    steady = unsteady_clocks(*filmed([FRAMES, FRAMES + 20, FRAMES]))
    np.testing.assert_allclose(steady, 0, atol=0.3)
