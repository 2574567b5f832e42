"""`gsgan.prepare` from one video of one uncalibrated camera."""

import importlib.util
import json
import shutil
import struct
import sys
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from configs import prepare_options
from one_person import film, turning, world_landmarks
from rich.console import Console

from gsgan.data.formats.capture import read_capture
from gsgan.prepare.frames import look, sample
from gsgan.prepare.mediapipe import SCRIPT
from gsgan.prepare.one_camera import (
    Detected,
    doubtful_poses,
    with_right_sides,
)
from gsgan.prepare.one_view import Seen, solve_view
from gsgan.prepare.options import Options
from gsgan.prepare.run import prepare
from gsgan.prepare.sources import FOCAL_KEY, read_metadata
from gsgan.skeleton import MEDIAPIPE33
from gsgan.skeleton.hands import HAND
from gsgan.skeleton.joints import ALL, BODY, HANDS, LEFT, WRIST_JOINTS
from gsgan.utils.errors import ConfigError, DataError

TALL = 1.88  # metres, the person of `turning`


def aligned(p, truth):
    """Points after the rigid motion that brings them nearest to the true ones."""
    a, b = p - p.mean((0, 1)), truth - truth.mean((0, 1))
    U, _, V = np.linalg.svd(np.einsum("fni,fnj->ij", a, b))
    return a @ U @ np.diag([1, 1, np.linalg.det(U @ V)]) @ V + truth.mean(
        (0, 1)
    )


def options(video, **more) -> Options:
    folder = video.parent
    given = {
        "source": str(video),
        "out": str(folder / "capture"),
        "landmarks": str(folder / "landmarks"),
        "masks": str(folder / "masks"),
        "hands": False,
        "landmark_noise": 0.002,
        "height": TALL,
        "focal": 520 / np.hypot(360, 640) * np.hypot(36, 24),
    }
    return prepare_options(**given | more)


@pytest.fixture(scope="session")
def filmed(tmp_path_factory):
    return film(tmp_path_factory.mktemp("one_video"))


@pytest.mark.slow
@pytest.mark.parametrize("guess", [1.2, 0.9])  # over the true focal length
def test_focal_length_and_landmarks_are_found(guess):
    truth = turning(48)
    u = truth[..., :2] / truth[..., 2:] / guess
    seen = Seen(
        *map(
            torch.tensor,
            (
                u,
                np.ones(u.shape[:2]),
                world_landmarks(truth),
                np.arange(48) / 10,
            ),
        )
    )
    found = solve_view(seen, noise=0.001, height=TALL)
    error = np.linalg.norm(aligned(found.p.numpy(), truth) - truth, axis=-1)
    assert guess * found.focal == pytest.approx(1, abs=0.05)
    assert np.median(error) < 0.025


def test_a_video_becomes_a_capture_that_training_reads(
    filmed, tmp_path, monkeypatch
):
    # Given landmarks are of the video's own pixels, however large it is.
    monkeypatch.setattr("gsgan.prepare.one_camera.MAX_SIDE", 400)
    out = prepare(
        options(filmed, out=str(tmp_path / "capture")), Console(quiet=True)
    )
    capture, numbers = (
        read_capture(out),
        json.loads((out / "prepare.json").read_text()),
    )
    assert list(capture.cameras) == ["me"]
    found = np.load(out / "landmarks3d.npz")
    p, truth = found["p"], turning(18)[found["frame_id"]]
    assert len(p) >= 16
    assert np.median(np.linalg.norm(aligned(p, truth) - truth, axis=-1)) < 0.03
    # feet on the ground, z upwards
    assert np.abs(np.percentile(p[:, 29:33, 2], 50)) < 0.06
    notes = " ".join(numbers["notes"])
    assert "3.4 seconds are short" in notes
    assert "focal" in notes


def test_a_video_that_ends_early_is_in_doubt(filmed, tmp_path):
    folder = shutil.copytree(filmed.parent, tmp_path / "film")
    content = filmed.read_bytes()
    (folder / "me.avi").write_bytes(content[: len(content) * 8 // 10])
    out = prepare(options(folder / "me.avi"), Console(quiet=True))
    notes = " ".join(json.loads((out / "prepare.json").read_text())["notes"])
    assert "of the frames that the video should have can be decoded" in notes


def spoiled(filmed, tmp_path, change):
    """The film with changed landmarks."""
    folder = shutil.copytree(filmed.parent, tmp_path / "film")
    arrays = dict(np.load(folder / "landmarks/me.npz"))
    change(arrays)
    np.savez(folder / "landmarks/me.npz", **arrays)
    return folder / "me.avi"


def nobody(arrays):
    arrays["conf"][:] = 0


# OpenPose's BODY_25, by the numbers of MediaPipe's landmarks; neck and middle of the hips are
# between two, and the small toes, which MediaPipe lacks, are not found.
BODY_25 = [
    *[(0,), (11, 12), (12,), (14,), (16,), (11,), (13,), (15,), (23, 24)],
    *[(24,), (26,), (28,), (23,), (25,), (27,), (5,), (2,), (8,), (7,)],
    *[(31,), None, (29,), (32,), None, (30,)],
]


def write_openpose(folder):
    """The film's landmarks as OpenPose's files, one per frame."""
    pixels = np.load(folder / "landmarks/me.npz")["px"] - 0.5
    out = folder / "openpose/me_json"
    out.mkdir(parents=True)
    for f, px in enumerate(pixels):
        keypoints = []
        for landmarks in BODY_25:
            if landmarks is None:
                keypoints += [0, 0, 0]
            else:
                keypoints += [*px[list(landmarks)].mean(0).tolist(), 0.9]
        people = [{"pose_keypoints_2d": keypoints}]
        text = json.dumps({"version": 1.3, "people": people})
        (out / f"me_{f:012d}_keypoints.json").write_text(text)
    return out.parent


def test_openposes_landmarks_are_lifted(filmed, tmp_path):
    """They have no depth: the lifter alone gives it."""
    folder = shutil.copytree(filmed.parent, tmp_path / "film")
    given = options(folder / "me.avi", landmarks=str(write_openpose(folder)))
    out = prepare(given, Console(quiet=True))
    found = np.load(out / "landmarks3d.npz")
    p, truth = found["p"], turning(18)[found["frame_id"]]
    assert len(p) >= 16
    assert np.median(np.linalg.norm(aligned(p, truth) - truth, axis=-1)) < 0.05


def hips_cut_off(arrays):
    arrays["px"][:, 23:25, 1] = 700


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (nobody, " 0 of 18 "),
        (hips_cut_off, "shoulders or hips"),
    ],
)
def test_videos_without_a_whole_person_end_in_one_sentence(
    filmed, tmp_path, change, message
):
    with pytest.raises(DataError, match=message):
        prepare(options(spoiled(filmed, tmp_path, change)), Console(quiet=True))


def test_long_large_videos_are_sampled(tmp_path):
    video = cv2.VideoWriter(
        str(tmp_path / "me.avi"),
        cv2.VideoWriter_fourcc(*"MJPG"),
        60,
        (2400, 16),
    )
    for f in range(330):
        video.write(np.full((16, 2400, 3), f // 2, np.uint8))
    video.release()
    recording, time = sample(tmp_path / "me.avi", tmp_path / "frames")
    assert recording.size == (13, 1920)
    np.testing.assert_allclose(np.diff(time), 1 / 12, atol=1e-3)
    assert list(recording.files) == list(range(0, 330, 5))


def test_vertical_phone_videos_are_turned_as_their_metadata_say(tmp_path):
    path = tmp_path / "me.mp4"
    video = cv2.VideoWriter(
        str(path), cv2.VideoWriter_fourcc(*"mp4v"), 10, (64, 32)
    )
    stored = np.zeros((32, 64, 3), np.uint8)
    stored[:, :32] = 255  # the left half
    for _ in range(12):
        video.write(stored)
    video.release()
    content = bytearray(path.read_bytes())
    # of the track's matrix: version and times are before it
    at = content.find(b"tkhd") + 44
    content[at : at + 36] = struct.pack(
        ">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30
    )
    path.write_bytes(content)
    recording, _ = sample(path, tmp_path / "frames")
    image = cv2.imread(str(recording.files[0]), cv2.IMREAD_GRAYSCALE)
    assert recording.size == image.shape == (64, 32)
    assert image[:24].mean() > 200  # a quarter turn clockwise: left is up
    assert image[40:].mean() < 50


@pytest.mark.parametrize(
    ("stated", "found"), [("26", 26), ("26.500000", 26.5), ("", None)]
)
def test_the_focal_length_that_a_phone_states(tmp_path, stated, found):
    av, path = pytest.importorskip("av"), tmp_path / "phone.mov"
    with av.open(
        str(path), "w", options={"movflags": "use_metadata_tags"}
    ) as file:
        if stated:
            file.metadata[FOCAL_KEY] = stated
        stream = file.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        file.mux(
            stream.encode(
                av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8))
            )
        )
        file.mux(stream.encode())
    assert read_metadata(path).focal == found


@pytest.mark.parametrize(
    ("codec", "pixels", "transfer", "said"),
    [
        ("mpeg4", "yuv420p", None, None),
        ("libx265", "yuv420p10le", None, None),
        ("libx265", "yuv420p10le", 18, "HLG"),
        ("libx265", "yuv420p10le", 16, "PQ"),
    ],
)
def test_phones_videos_of_10_bits_are_read_and_hdr_is_named(
    tmp_path, codec, pixels, transfer, said
):
    av, path = pytest.importorskip("av"), tmp_path / "phone.mp4"
    if codec not in av.codecs_available:
        pytest.skip(f"PyAV was built without {codec}")
    picture = np.full((48, 64, 3), (200, 40, 90), np.uint8)
    with av.open(str(path), "w") as file:
        stream = file.add_stream(codec, rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, pixels
        if codec == "libx265":
            stream.options = {"x265-params": "pools=none:log-level=error"}
        if transfer:
            stream.codec_context.color_trc = transfer
        for _ in range(3):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
    assert read_metadata(path).hdr == said
    if said == "HLG":  # read as PQ is; OpenCV takes five seconds for either
        return
    recording, times = sample(path, tmp_path / "frames")
    found = cv2.imread(str(recording.files[0]))[24, 32]
    assert len(times) == 3
    if said is None:
        np.testing.assert_allclose(found, [90, 40, 200], atol=12)


@pytest.mark.parametrize(
    ("box", "fact"),
    [
        ((0.5, 0.1, 0.4, 0.9), r"\[0\.5, 0\.1"),
        ((0, 0, 400, 300), r"400"),
        ((0.1, 0.1), r"0\.1"),
    ],
)
def test_a_person_is_a_box_in_shares_of_the_image(filmed, box, fact):
    with pytest.raises(ConfigError, match=fact):
        options(filmed, person=box, landmarks="mediapipe")


def test_one_of_two_people_is_followed(monkeypatch):
    """The box moves with the joints that are sure; whoever is beside it is painted over."""
    monkeypatch.setitem(sys.modules, "mediapipe", SimpleNamespace())
    spec = importlib.util.spec_from_file_location("detect_tool", SCRIPT)
    detect = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(detect)
    follower = detect.Follower([0.1, 0.1, 0.3, 0.9])
    image = np.zeros((200, 400, 3), np.uint8)
    for step in range(30):
        left = 40 + 5 * step
        image[:] = 0
        image[20:180, left : left + 80] = (0, 0, 255)  # the person, who walks
        image[20:180, left + 120 : left + 200] = (255, 0, 0)  # another, beside
        shown = follower.alone(image)
        assert (shown[100, left : left + 80] == (0, 0, 255)).all()
        assert not (shown[100] == (255, 0, 0)).all(-1)[left + 120 :].any()
        joints = np.tile([[left, 20.0], [left + 80.0, 180.0]], (17, 1))[:33]
        conf = np.ones(33) if step % 7 else np.zeros(33)  # not found at times
        follower.follow(joints.astype(np.float32), conf)


def test_a_moving_camera_is_measured(tmp_path):
    wall = np.random.default_rng(0).integers(0, 255, (40, 60), np.uint8)
    wall = cv2.resize(wall, None, fx=16, fy=16, interpolation=cv2.INTER_CUBIC)
    paths = [tmp_path / f"{f}.png" for f in range(10)]
    for f, path in enumerate(paths):
        cv2.imwrite(str(path), wall[:480, 8 * f : 8 * f + 640])
    px = np.full((10, 33, 2), 320.0) + np.random.default_rng(1).uniform(
        -60, 60, (10, 33, 2)
    )
    assert look(paths, px)[1] == pytest.approx(72 / 800, rel=0.1)
    assert look([paths[0]] * 10, px)[1] < 0.002


def test_a_frame_without_a_landmark_hides_no_doubtful_pose():
    errors = np.array(
        [[1.0, 2], [np.nan, 2], [np.nan, np.nan], [20, 30], [2, 2]]
    )
    assert doubtful_poses(errors).tolist() == [False, False, False, True, False]


@pytest.mark.parametrize("with_body", [True, False])
def test_hands_follow_the_sides_of_the_body(with_body):
    """Frames in which a detector exchanges left and right, of hands and body or of the body alone;
    in one of them a hand was not seen."""
    frames = 24
    x = turning(frames)
    rng = np.random.default_rng(0)
    px = np.full((frames, ALL, 2), np.nan)
    px[:, :BODY] = 500 * x[..., :2] / x[..., 2:]
    hands = px[:, WRIST_JOINTS].repeat(HAND, axis=1)
    hands[:, 1:HAND] += rng.normal(0, 10, (frames, HAND - 1, 2))
    hands[:, HAND + 1 :] += rng.normal(0, 10, (frames, HAND - 1, 2))
    px[:, HANDS] = hands
    right = Detected(
        px=px,
        conf=np.isfinite(px).all(-1) * 1.0,
        world=world_landmarks(x),
        hand_z=rng.normal(0, 1, (frames, 2 * HAND)),
        faces=np.ones(frames, np.int64),
    )
    right.conf[12, LEFT] = 0

    wrong = replace(
        right,
        px=right.px.copy(),
        conf=right.conf.copy(),
        world=right.world.copy(),
        hand_z=right.hand_z.copy(),
    )
    mixed = [5, 6, 12, 19]
    mirror = list(MEDIAPIPE33.mirror)
    for values in (wrong.px[:, :BODY], wrong.conf[:, :BODY], wrong.world):
        values[mixed] = values[mixed][:, mirror]
    if with_body:
        for values in (wrong.px[:, HANDS], wrong.conf[:, HANDS], wrong.hand_z):
            values[mixed] = np.roll(values[mixed], HAND, axis=1)
    found = with_right_sides(wrong, np.arange(frames) / 12)
    for name in ("px", "conf", "world", "hand_z"):
        np.testing.assert_array_equal(
            getattr(found, name), getattr(right, name)
        )


@pytest.mark.parametrize(
    ("more", "fact"),
    [
        ({"calibration": "intri.yml"}, "calibration is not used"),
        ({"height": 178}, "height .* 178"),
    ],
)
def test_a_calibration_and_a_height_in_centimetres_are_refused(
    filmed, more, fact
):
    with pytest.raises(ConfigError, match=fact):
        options(filmed, **more)
