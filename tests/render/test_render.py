"""``gsgan.render``: images of evaluation, cameras, backgrounds, clear messages."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from commands import refused
from configs import build_data, build_training, load_avatar
from make import write_tiny_capture
from omegaconf import OmegaConf
from PIL import Image

from gsgan.body.shape import free_space
from gsgan.data.metric_variants import MetricVariants
from gsgan.evaluate.predictions import Preparation
from gsgan.evaluate.scores import make_predictor
from gsgan.render import run as render_run
from gsgan.run.runs import Run, load
from gsgan.run.stored import CHECKPOINT, CONFIG, load_config
from gsgan.skeleton import MEDIAPIPE33
from gsgan.utils.provenance import SOURCE_TYPE, verify


def read(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


@pytest.fixture
def motion(tmp_path, landmarks):
    path = tmp_path / "a.npz"
    np.savez(path, p=1.1 * landmarks, fps=30)
    return path


@pytest.fixture
def render(inside, bare, tmp_path):
    """Runs the command on the run that needs no body pose."""

    def run(*args: str):
        return inside("render", f"run={bare}", *args)

    return run


@pytest.fixture
def fitted(capture, tiny, tmp_path):
    """A run that has just begun, of an avatar on a body whose shape `gsgan.fit` wrote."""
    root = shutil.copytree(capture, tmp_path / "fitted")
    shape = replace(free_space().neutral(), offsets=0.02 * torch.ones(33, 3))
    shape.stretch[2] = 1.2
    np.savez(root / "body_shape.npz", **shape.arrays())
    config = tiny(f"data.root={root}", "effects.body_points=on")
    return begun(config, tmp_path / "run")


def begun(config, folder: Path) -> Path:
    """A run folder of an avatar near its start."""
    _, module = build_training(config)
    with torch.no_grad():
        for parameter in module.avatar.splats.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
    checkpoint = {"state_dict": module.state_dict()}
    module.on_save_checkpoint(checkpoint)
    for name in (CHECKPOINT, CONFIG):
        (folder / name).parent.mkdir(parents=True)
    torch.save(checkpoint, folder / CHECKPOINT)
    OmegaConf.save(config, folder / CONFIG)
    return folder


def expected(
    run: Path, split: str, background: str, solve: bool
) -> dict[tuple[str, int], np.ndarray]:
    """What evaluation scores, as bytes, by camera and frame."""
    config = load_config(run)
    data = build_data(config)
    predict = make_predictor(load_avatar(run, config, data)[0], solve=solve)
    prepare = Preparation(MetricVariants(background=background), None)
    found = {}
    dataset = data.dataset(split)
    for i, item in enumerate(dataset.items):
        if item[0] != dataset.items[0][0]:  # one camera
            continue
        image = prepare.image(predict(dataset[i], item), "full", None)
        found[item] = (image[0] * 255).round().byte().permute(1, 2, 0).numpy()
    return found


@pytest.mark.parametrize(
    ("name", "background", "split", "drive"),
    [
        ("bare", "black", "novel_pose", "null"),
        ("bare", "white", "novel_view", "skeleton"),
        ("run", "white", "novel_pose", "null"),
        ("run", "white", "novel_pose", "skeleton"),
        ("fitted", "black", "novel_pose", "skeleton"),
    ],
)
def test_held_out_frames_are_the_scored_images(
    inside, tmp_path, request, name, background, split, drive
):
    """Byte for byte, also of an avatar on a body that skeletons alone drive."""
    folder = request.getfixturevalue(name)
    scored = expected(folder, split, background, drive == "skeleton")
    for camera in dict.fromkeys(camera for camera, _ in scored):
        out = tmp_path / camera
        given = (
            f"run={folder}",
            f"motion={split}",
            f"camera={camera}",
            f"out={out}",
        )
        result = inside(
            "render", *given, f"background={background}", f"drive={drive}"
        )
        assert result.returncode == 0, result.stderr
        frames = {frame for c, frame in scored if c == camera}
        assert {p.name for p in out.glob("*.png")} == {
            f"{frame:06d}.png" for frame in frames
        }
        for frame in frames:
            np.testing.assert_array_equal(
                read(out / f"{frame:06d}.png"), scored[camera, frame]
            )
    if name == "fitted":  # the data's poses give other images
        given = expected(folder, split, background, solve=False)
        assert all((given[item] != scored[item]).any() for item in scored)


def test_a_motion_of_another_person(render, motion, tmp_path):
    result = render(
        f"motion={motion}",
        "out=frames",
        "fps=15",
        "start=1",
        "frames=4",
        "pixels=40",
    )
    assert result.returncode == 0, result.stderr
    assert (
        "a.npz: 12 frames at 30 per second, metres, Z up -> 6 frames at 15"
        in result.stdout
    )
    assert "distance from the training poses, in deviations: " in result.stdout
    assert "on the subject's bones" in result.stdout
    files = sorted((tmp_path / "frames").glob("*.png"))
    assert [p.name for p in files] == [f"{i:06d}.png" for i in range(1, 5)]
    assert read(files[0]).shape == (40, 40, 3)
    assert (read(files[0]) != read(files[3])).any()
    assert verify(files[0]).source_type == SOURCE_TYPE


def test_smoothing_delays_all_frames_but_the_first(render, motion, tmp_path):
    given = (f"motion={motion}", "pixels=32", "frames=4", "camera=cam00")
    for folder, options in (
        ("plain", ()),
        (
            "smooth",
            ("smooth.enabled=true", "smooth.min_cutoff=0.2", "smooth.beta=0"),
        ),
    ):
        result = render(*given, f"out={folder}", *options)
        assert result.returncode == 0, result.stderr
        assert (", smoothed" in result.stdout) == (folder == "smooth")
    same = []
    for name in ("000000.png", "000003.png"):
        plain = read(tmp_path / "plain" / name)
        same.append(bool((plain == read(tmp_path / "smooth" / name)).all()))
    assert same == [True, False]
    wrong = render(*given, "out=x", "smooth.enabled=true", "smooth.max_pause=0")
    refused(wrong, "smooth.max_pause")


def test_clips_become_one_motion(render, motion, landmarks, tmp_path):
    other = tmp_path / "b.npz"
    # with a face, which this avatar has not
    p = np.full((len(landmarks), 105, 3), np.nan)
    p[:, :33], p[:, 75:] = landmarks[::-1], landmarks[:, :30]
    np.savez(other, p=0.9 * p, fps=30)
    result = render(
        f"motion=[{motion},{other}]",
        "transition=0.2",
        "out=frames",
        "pixels=32",
    )
    assert result.returncode == 0, result.stderr
    assert f"face in {len(p)}; 0.2 s from each to the next" in result.stdout
    between = 5  # frames at 30 per second
    assert (
        len(list((tmp_path / "frames").glob("*.png")))
        == 2 * len(landmarks) + between
    )
    refused(render("motion=[]", "out=none"), "names no file")
    refused(
        render(f"motion=[{motion},gone.pose]", "out=none"),
        "gone.pose does not exist",
    )


def test_a_run_without_its_dataset(render, bare, motion, tmp_path):
    copy = shutil.copytree(bare, tmp_path / "copy")
    config = copy / ".hydra" / "config.yaml"
    config.write_text(
        config.read_text().replace("root: /", "root: /no/longer/there/")
    )
    ok = render(f"run={copy}", f"motion={motion}", "out=1.5", "frames=1")
    assert ok.returncode == 0, ok.stderr


def test_the_subjects_own_motion_is_left_alone(render, capture, tmp_path):
    path = tmp_path / "own.npz"
    with np.load(capture / "landmarks3d.npz") as held:
        np.savez(path, p=held["p"][:4], conf=held["conf"][:4], fps=30)
    result = render(f"motion={path}", "camera=cam00", "out=a")
    assert "bones as they are" in result.stdout, result.stderr
    assert render("motion=train", "camera=cam00", "out=b").returncode == 0
    np.testing.assert_array_equal(
        read(tmp_path / "a/000002.png"), read(tmp_path / "b/000002.png")
    )
    again = render(f"motion={path}", "out=c", "retarget=true", "frames=1")
    assert "on the subject's bones" in again.stdout, again.stderr


def test_the_up_axis_of_a_rig_can_be_given(render, tmp_path):
    from conventions import write_bvh
    from mannequin import choreography, mannequin

    person = mannequin()
    signing = choreography(person).at(21 + np.arange(2) / 30)
    path = write_bvh(tmp_path / "a.bvh", person, signing, 1 / 30, scale=100.0)
    for given, up in (((), "Z up"), (("up=-y",), "-Y up")):
        result = render(f"motion={path}", f"out={up[0]}", *given)
        assert result.returncode == 0, result.stderr
        assert up in result.stdout


def test_a_body_pose_drives_an_avatar_with_a_body(
    inside, run, capture, tmp_path
):
    motion = f"motion={capture / 'body_pose.npz'}"
    result = inside(
        "render", f"run={run}", motion, "retarget=false", "out=a", "frames=2"
    )
    assert result.returncode == 0, result.stderr


def test_residuals_can_be_distilled(inside, on_body, tmp_path):
    images = []
    for value in ("false", "true"):
        given = [
            "motion=train",
            "frames=1",
            f"distilled={value}",
            f"out={tmp_path / value}",
        ]
        result = inside("render", f"run={on_body()}", *given)
        assert result.returncode == 0, result.stderr
        images.append(read(next((tmp_path / value).glob("*.png"))) / 255)
    assert 0 < np.abs(images[0] - images[1]).max() < 0.5


def test_a_video(render, tmp_path):
    av = pytest.importorskip("av")
    result = render(
        "motion=novel_pose", "background=white", "out=a.mp4", "fps=7.5"
    )
    assert result.returncode == 0, result.stderr
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        frames = [
            f.to_ndarray(format="rgb24") for f in container.decode(video=0)
        ]
        assert (stream.codec_context.name, float(stream.average_rate)) == (
            "h264",
            7.5,
        )
    assert [f.shape for f in frames] == [(32, 32, 3)] * 2
    assert verify(tmp_path / "a.mp4").synthetic
    refused(render("out=a.mp4"), "exists; give overwrite=true")
    assert (
        render(
            "out=a.mp4", "overwrite=true", "frames=2", "pixels=33"
        ).returncode
        == 0
    )
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert container.streams.video[0].width == 34  # H.264 has even sides


def test_frames_of_two_renders_are_never_mixed(render, motion, tmp_path):
    given = (f"motion={motion}", "out=frames", "pixels=16")
    assert render(*given).returncode == 0
    refused(render(*given, "frames=2"), "holds a render; give overwrite=true")
    assert render(*given, "frames=2", "overwrite=true").returncode == 0
    names = {path.name for path in (tmp_path / "frames").iterdir()}
    assert names == {"000000.png", "000001.png", "render.json"}


def test_backgrounds(render, tmp_path):
    cv2.imwrite(
        str(tmp_path / "wall.png"), np.full((20, 50, 3), (30, 20, 10), np.uint8)
    )
    for name, colour in (
        ("red", (255, 0, 0)),
        ("#0a141e", (10, 20, 30)),
        ("wall.png", (10, 20, 30)),
    ):
        result = render(
            "motion=novel_pose",
            f"background='{name}'",
            f"out={name.strip('#')}.d/x",
        )
        assert result.returncode == 0, result.stderr
        assert (
            tuple(
                read(tmp_path / f"{name.strip('#')}.d" / "x" / "000004.png")[
                    0, 0
                ]
            )
            == colour
        )
    assert (
        render("motion=novel_pose", "background=alpha", "out=clear").returncode
        == 0
    )
    assert render("motion=novel_pose", "out=black").returncode == 0
    clear, black = (
        read(tmp_path / x / "000004.png").astype(float)
        for x in ("clear", "black")
    )
    assert clear.shape == (32, 32, 4)
    assert clear[0, 0, 3] == 0
    np.testing.assert_allclose(
        clear[..., :3] * clear[..., 3:] / 255, black, atol=1.5
    )
    refused(render("background=alpha", "out=a.mp4"), "needs PNG files")
    refused(
        render("background=nocolour", "out=a"), "is neither a colour nor a file"
    )


def test_cameras(render, bare, capture, motion, tmp_path):
    still = ("out=orbit", "frames=8", "orbit.turns=1")
    result = render(*still)
    assert "frame 4 of novel_pose, held still" in result.stdout, result.stderr
    files = sorted((tmp_path / "orbit").glob("*.png"))
    assert len(files) == 8
    sizes = [(read(p).max(-1) > 60).sum() for p in files]
    assert min(sizes) > 0
    calibration = json.loads((capture / "cameras.json").read_text())
    one = tmp_path / "one.json"
    one.write_text(json.dumps({"cam00": calibration["cam00"]}))
    assert (
        render(
            f"motion={motion}", f"camera={one}", "out=a", "frames=1"
        ).returncode
        == 0
    )
    assert (
        render(
            f"motion={motion}", "camera=cam00", "out=b", "frames=1"
        ).returncode
        == 0
    )
    np.testing.assert_array_equal(
        read(tmp_path / "a/000000.png"), read(tmp_path / "b/000000.png")
    )
    path = tmp_path / "path.json"
    path.write_text(json.dumps(calibration))
    assert (
        render(
            f"motion={motion}", f"camera={path}", "out=c", "frames=3"
        ).returncode
        == 0
    )
    refused(
        render(f"motion={motion}", f"camera={path}", "out=d"),
        "3 cameras; expected 1, or 12",
    )
    refused(
        render(f"motion={motion}", "camera=cam77", "out=d"),
        "neither a camera",
        "cam00, cam01, cam02",
    )


def test_a_calibration_without_a_unit_needs_one(
    render, capture, motion, tmp_path
):
    """nerfstudio's scene of a camera in cm gives the image of the camera itself."""
    cam = json.loads((capture / "cameras.json").read_text())["cam00"]
    R, t, K = (np.array(cam[key], dtype=float) for key in ("R", "t", "K"))
    pose = np.eye(4)
    pose[:3, :3] = R.T @ np.diag([1, -1, -1])
    pose[:3, 3] = -R.T @ t.reshape(3) * 100
    w, h = cam["size"]
    names = ("fl_x", "fl_y", "cx", "cy", "w", "h")
    values = (K[0, 0], K[1, 1], K[0, 2], K[1, 2], w, h)
    scene = dict(zip(names, values, strict=True))
    frame = {"file_path": "cam00.png", "transform_matrix": pose.tolist()}
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(scene | {"frames": [frame]}))

    given = (f"motion={motion}", "frames=1")
    refused(render(*given, f"camera={path}", "out=a"), "camera_unit=m")
    bad = render(*given, f"camera={path}", "camera_unit=ft", "out=a")
    refused(bad, "camera_unit=ft")
    result = render(*given, f"camera={path}", "camera_unit=cm", "out=a")
    assert result.returncode == 0, result.stderr
    render(*given, "camera=cam00", "out=b")
    np.testing.assert_allclose(
        read(tmp_path / "a/000000.png").astype(int),
        read(tmp_path / "b/000000.png").astype(int),
        atol=1,
    )


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ((), "out is not set"),
        (("out=a.avi",), "must be a .mp4 file, or a folder"),
        (("out=a", "motion=none.bvh"), "motion=none.bvh does not exist"),
        (("out=a", "fps=0"), "fps must be a number above 0"),
        (
            ("out=a", "motion=novel_pose", "start=9"),
            "start=9: the motion has 2 frames",
        ),
        (("out=a", "orbit.elevation=90"), "orbit.elevation must be"),
        (("out=a", "retarget=maybe"), "retarget must be one of auto"),
        (("out=a", "drive=body"), "drive must be one of None, skeleton"),
        (
            ("out=a", "motion=[a.npz,b.npz]", "retarget=false"),
            "is not supported for a list",
        ),
        (("out=a", "camera=0"), "camera=0 is neither a camera"),
        (
            ("out=a.npz/frames",),
            "a.npz/frames cannot be written (Not a directory)",
        ),
        (("out=a.npz/a.mp4",), "a.npz/a.mp4 cannot be written (File exists)"),
    ],
)
def test_one_clear_sentence(render, tmp_path, motion, args, message):
    extra = () if any("motion" in a for a in args) else (f"motion={motion}",)
    refused(render(*args, *extra), message)
    assert not list(tmp_path.glob("a*/*.png"))


def test_other_folders_are_not_touched(render, motion, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "000000.png").write_text("mine")
    for more in ((), ("overwrite=true",)):
        refused(
            render(f"motion={motion}", "out=mine", *more), "holds no render"
        )
    assert (tmp_path / "mine" / "000000.png").read_text() == "mine"


def test_the_picture_of_the_avatar(bare, landmarks):
    """`Avatar.render` is `Avatar.forward` on a background."""
    avatar = load(bare, device="cpu")
    config = load_config(bare)
    frame = build_data(config).dataset("train")[0]
    with torch.no_grad():
        painting = avatar(
            frame.skeleton, torch.ones(1, 33), frame.camera, maps=False
        )
    image = avatar.render(frame.skeleton, frame.camera)
    assert torch.equal(image, painting.image.clamp(0, 1))
    assert painting.features is None


@pytest.mark.parametrize(("out", "left"), [("a", 3), ("a.mp4", 0)])
def test_what_is_left_when_a_later_frame_fails(
    render, motion, tmp_path, monkeypatch, out, left
):
    painted, eight_bits = [], render_run.eight_bits

    def failing(*given):
        painted.append(given)
        if len(painted) == 4:
            raise ValueError("the skeleton is too small")
        return eight_bits(*given)

    monkeypatch.setattr(render_run, "eight_bits", failing)
    result = render(f"motion={motion}", f"out={out}")
    refused(result, "frame 3 cannot be rendered (the skeleton is too small)")
    assert len(list(tmp_path.glob("a*/*.png"))) == left
    assert not (tmp_path / "a.mp4").exists()


def test_a_swapped_motion_is_refused_and_an_extreme_frame_is_not(
    render, landmarks, tmp_path
):
    swapped = 1.1 * landmarks[:, list(MEDIAPIPE33.mirror)]
    np.savez(tmp_path / "a.npz", p=swapped, fps=30)
    refused(
        render(f"motion={tmp_path / 'a.npz'}", "out=a"),
        "a.npz",
        "left and right are swapped",
    )
    mixed = np.concatenate([1.1 * landmarks, swapped[:2]])
    np.savez(tmp_path / "b.npz", p=mixed, fps=30)
    result = render(f"motion={tmp_path / 'b.npz'}", "out=b", "start=11")
    assert result.returncode == 0, result.stderr
    assert len(list((tmp_path / "b").glob("*.png"))) == 3


SPLATS = ("model=splat_only", "effects=none")
CROPPED = "data.crop={_target_:gsgan.data.crop.PersonCrop,margin:0.05}"


def test_crops_at_the_images_own_scale_are_as_large_as_the_largest(
    inside, tiny, tmp_path
):
    """With data.size=null every frame's crop has a size of its own."""
    config = tiny(*SPLATS, "data.size=null", CROPPED)
    run = begun(config, tmp_path / "run")
    dataset = build_data(config).dataset("train")
    camera = dataset.items[0][0]
    sizes = {dataset.camera(x).size for x in dataset.items if x[0] == camera}
    assert len(sizes) > 1
    result = inside("render", f"run={run}", "motion=train", "out=a")
    assert result.returncode == 0, result.stderr
    shown = {read(path).shape[:2] for path in tmp_path.glob("a/*.png")}
    assert shown == {max(sizes)}


def test_images_that_are_not_square_keep_their_shape(inside, tiny, tmp_path):
    write_tiny_capture(tmp_path / "wide", frames=4, size=(48, 32))
    config = tiny(*SPLATS, f"data.root={tmp_path / 'wide'}", "data.size=null")
    run = begun(config, tmp_path / "run")
    motion = ("motion=train", "frames=1")
    for more, size in (("pixels=null", (32, 48)), ("pixels=64", (64, 96))):
        out = f"out=a{size[0]}"
        result = inside("render", f"run={run}", *motion, more, out)
        assert result.returncode == 0, result.stderr
        (path,) = tmp_path.glob(f"a{size[0]}/*.png")
        assert read(path).shape[:2] == size


@pytest.mark.parametrize("effect", ["project", "undistort"])
def test_a_camera_of_the_data_keeps_the_lens_that_was_rendered_in_training(
    tiny, tmp_path, landmarks, effect
):
    root = tmp_path / "lens"
    write_tiny_capture(root, dist=(-0.2, 0.05, 0, 0, 0))
    config = tiny(
        "model=splat_only",
        f"data.root={root}",
        f"effects.distortion={effect}",
        "effects.body_points=off",
    )
    run = Run.load(begun(config, tmp_path / "run"), device="cpu")
    drive = SimpleNamespace(p=landmarks, camera=None)
    options = OmegaConf.create({"camera": "cam00", "pixels": None})
    seen, _ = render_run._cameras(options, run, drive)
    assert (seen.dist is not None) == (effect == "project")
