"""``gsgan.evaluate predictions=``: any method's images, scored like those of a run."""

import csv
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from commands import arguments as tiny_arguments
from commands import refused

from gsgan.utils.errors import GsganError

DATA = (
    "data=capture",
    "data.size=32",
    "data.crop=null",
    "size=tiny",
    "lpips.nets=[]",
)
PROTOCOL = (
    "protocol=paper_thuman4",
    "protocol.train_cameras=[cam00,cam01]",
    "data.size=32",
    "protocol.test_cameras=[cam02]",
    "protocol.train_frames=0-3",
    "protocol.test_frames=0-3",
)


@pytest.fixture(scope="session")
def given(capture: Path) -> list[str]:
    return [*DATA, f"data.root={capture}"]


@pytest.fixture(scope="session")
def painted(
    run: Path, capture: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The images of the tiny run as another method would leave them: 8-bit PNGs."""
    from configs import build_data, load_avatar

    from gsgan.run.stored import load_config

    root = tmp_path_factory.mktemp("others") / "other"
    data = build_data(load_config(run))
    avatar, _ = load_avatar(run, load_config(run), data)
    for split in ("novel_view", "novel_pose"):
        dataset = data.dataset(split)
        for i, (camera, frame) in enumerate(dataset.items):
            with torch.no_grad():
                image = avatar(*dataset[i].inputs).image[0].clamp(0, 1)
            pixels = (image * 255).round().byte().permute(1, 2, 0).numpy()
            path = root / split / camera / f"{frame:04d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), pixels[..., ::-1])
    return root


def test_a_trained_avatar_is_loaded_without_measuring_the_scene_again(
    run, monkeypatch
):
    """It would read images of every camera, which takes a minute of a long capture."""
    from configs import build_data, load_avatar

    from gsgan.run.stored import load_config

    config = load_config(run)
    data = build_data(config)
    monkeypatch.setattr("gsgan.data.datamodule.scene_info", None)
    avatar, _ = load_avatar(run, config, data)
    assert avatar.poses is not None


@pytest.fixture
def copy(painted: Path, tmp_path: Path) -> Path:
    return shutil.copytree(painted, tmp_path / "mine" / "other")


def scores(folder: Path) -> dict:
    return json.loads((folder / "metrics.json").read_text())


def test_images_of_a_run_score_as_the_run_does(run, painted, given, inside):
    """Up to the rounding to 8 bits: 0.5/255 at most a value, and the floor is the very same."""
    result = inside(
        "evaluate", f"predictions={painted}", "method=other", *given
    )
    assert result.returncode == 0, result.stderr
    out = painted.with_name("other_scores")
    own, others = scores(run), scores(out)
    for split, variants in others.items():
        assert set(variants) == {"full", "floor"}
        assert variants["floor"] == {**own[split]["floor"], "marks": []}
        for metric in ("psnr", "psnr_person", "ssim", "ssim_person"):
            a, b = (x[split]["full"][metric] for x in (own, others))
            assert a == pytest.approx(b, abs=0.05)
        assert (
            variants["full"]["miou_reason"]
            == "predictions are images, not a segmentation"
        )
        assert variants["full"]["images"] == own[split]["full"]["images"]
    facts, runs = (
        json.loads((f / "facts.json").read_text()) for f in (out, run)
    )
    for key in (
        "name",
        "fingerprint",
    ):  # where it lies may have been another folder
        assert facts["data"][key] == runs["data"][key]
    assert (facts["method"], facts["model"], facts["seed"]) == (
        "other",
        None,
        None,
    )
    assert (runs["method"], runs["model"], runs["seed"]) == ("gsgan", "full", 0)
    assert runs["iterations"] == 16
    assert 0 < runs["train_seconds"] < 600
    stored = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)[
        "gsgan"
    ]["code"]
    assert runs["trained_by"] == stored
    assert facts["trained_by"] is None
    # a checkout: the run was trained and scored by the same code
    if runs["commit"] is not None:
        assert [code.removesuffix("+changes") for code in stored] == [
            runs["commit"]
        ]
    assert "other" in result.stdout
    assert {p.name for p in (out / "grids").iterdir()} == {
        "novel_view.png",
        "novel_pose.png",
    }


def test_the_csv_holds_every_image_and_its_mean_is_the_score(run):
    with (run / "scores.csv").open() as stream:
        lines = list(csv.DictReader(stream))
    for split, variants in scores(run).items():
        for variant, means in variants.items():
            held = [
                x
                for x in lines
                if (x["split"], x["variant"]) == (split, variant)
            ]
            assert len(held) == means["images"]
            for metric in (
                "psnr",
                "psnr_person",
                "ssim",
                "ssim_person",
                "edge_ratio",
            ):
                values = [float(x[metric]) for x in held]
                mean = sum(values) / len(values)
                assert mean == pytest.approx(means[metric], abs=1e-9)
            cameras = {x["camera"] for x in held}
            assert cameras == set(means["cameras"])
            for camera in cameras:
                own = [float(x["psnr"]) for x in held if x["camera"] == camera]
                expected = means["cameras"][camera]["psnr"]
                assert sum(own) / len(own) == pytest.approx(expected, abs=1e-9)


def test_poses_are_aligned_on_the_images_that_are_scored(
    run, capture, inside, tmp_path
):
    own = tmp_path / "on_body"
    words = ("model=splat_only", "effects.body_points=on")
    trained = inside("train", *tiny_arguments(capture, own), *words)
    assert trained.returncode == 0, trained.stderr
    aligning = ("align=pose", "splits=[novel_pose]")
    result = inside("evaluate", f"run={own}", *aligning)
    assert result.returncode == 0, result.stderr
    aligned = scores(own / "aligned" / "novel_pose")["novel_pose"]["full"]
    assert "body poses aligned on the scored images" in aligned["marks"]
    assert aligned["psnr"] > scores(own)["novel_pose"]["full"]["psnr"]

    # Points on the skeleton do not follow a body's joints.
    refused(inside("evaluate", f"run={run}", *aligning), "align=pose")


def test_a_run_is_scored_on_another_capture_against_the_distance_from_training(
    run, capture, inside, tmp_path
):
    """The capture itself under another name: poses are solved, though it has some."""
    own = shutil.copytree(run, tmp_path / "run")
    other = shutil.copytree(capture, tmp_path / "other")
    result = inside(
        "evaluate",
        f"run={own}",
        f"+other_capture.root={other}",
        "+other_capture.test_frames=4-5",
    )
    assert result.returncode == 0, result.stderr
    folder = own / "on" / "other"
    for variants in scores(folder).values():
        assert "on another capture: other" in variants["full"]["marks"]
    assert inside("evaluate", f"run={own}", "drive=skeleton").returncode == 0
    solved, found = scores(own / "by_skeleton"), scores(folder)
    assert scores(own) == scores(run)  # the run's own stay
    for split in found:
        assert solved[split]["full"]["marks"][-1] == "driven by skeletons alone"
        # A run this short paints alike from any S, so S itself is compared.
        given = scores(own)[split]["full"]["miou"]
        assert solved[split]["full"]["miou"] != given
        assert found[split]["full"]["psnr"] == pytest.approx(
            solved[split]["full"]["psnr"]
        )
        assert found[split]["full"]["flicker"] > 0
        assert found[split]["full"]["warped_flicker"] > 0
    with (folder / "distance.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == sum(
        variants["full"]["images"] for variants in found.values()
    )
    assert len({row["distance"] for row in rows}) > 2
    # of the pose alone
    assert len({(row["frame"], row["distance"]) for row in rows}) == 6
    assert cv2.imread(str(folder / "distance.png")) is not None
    assert "by distance from the training poses" in result.stdout
    for arguments, named in (
        (["+other_capture.source.motion=far"], "Key 'source' is not in struct"),
        (
            [f"other_capture={other}", "data_root=a"],
            "data_root= cannot be given with other_capture=",
        ),
    ):
        refused(inside("evaluate", f"run={own}", *arguments), named)


def test_the_ground_truth_as_prediction_on_white(
    capture, given, inside, tmp_path
):
    """On white, given as it is or as alpha: the truth scores nothing but its own 8-bit rounding."""
    from gsgan.data.datamodule import GsganData
    from gsgan.metrics.regions import on_background

    data = GsganData(str(capture), size=32)
    for kind in ("opaque", "alpha"):
        for split in ("novel_view", "novel_pose"):
            dataset = data.dataset(split)
            for i, (camera, frame) in enumerate(dataset.items):
                f = dataset[i]
                cover = f.mask.clamp_min(1e-6)
                colour = (
                    f.image / cover
                    if kind == "alpha"
                    else on_background(f.image, f.mask, 1.0)
                )
                planes = (
                    [colour[0], f.mask[0]] if kind == "alpha" else [colour[0]]
                )
                pixels = (
                    (torch.cat(planes).clamp(0, 1) * 255)
                    .round()
                    .byte()
                    .permute(1, 2, 0)
                )
                path = tmp_path / kind / f"{camera}_{frame}.png"
                path.parent.mkdir(exist_ok=True)
                order = [2, 1, 0, 3] if kind == "alpha" else [2, 1, 0]
                cv2.imwrite(
                    str(path), np.ascontiguousarray(pixels.numpy()[..., order])
                )
    named = "predictions_pattern='{camera}_{frame}.png'"
    for kind in ("opaque", "alpha"):
        result = inside(
            "evaluate",
            f"predictions={tmp_path / kind}",
            named,
            *given,
            *PROTOCOL,
        )
        assert result.returncode == 0, result.stderr
        found = scores(tmp_path / f"{kind}_scores")["novel_view"]
        psnr = found["full"]["psnr"]
        assert psnr is None or psnr > 45  # equal pictures are counted apart
        assert 0 < found["floor"]["psnr"] < 25
        record = found["full"]["protocol"]
        assert record["measures"]["background"] == "white"
        assert not any("alpha" in said for said in record["departures"])


def test_a_run_is_scored_on_white_by_request(run, inside, tmp_path):
    """By the alpha that each of its pictures has; the table is marked."""
    from configs import build_data, load_avatar

    from gsgan.metrics.image import psnr
    from gsgan.metrics.regions import on_background
    from gsgan.run.stored import load_config

    copy = shutil.copytree(run, tmp_path / "copy")
    result = inside(
        "evaluate", f"run={copy}", "background=white", "grid_rows=1"
    )
    assert result.returncode == 0, result.stderr
    assert "scored on white" in result.stdout
    on_white = copy / "on_white"
    assert "scored on white" in (on_white / "metrics.md").read_text()
    assert scores(copy) == scores(run)  # its own stay
    shown = cv2.imread(str(on_white / "grids" / "novel_pose.png"))
    assert (shown[-1, 0] == 255).all()  # the truth's corner
    # and the painted one, fourth
    assert (shown[-1, 3 * shown.shape[1] // 5 + 1] > 128).all()
    black, white = scores(run), scores(on_white)
    data = build_data(load_config(run))
    avatar, _ = load_avatar(run, load_config(run), data)
    for split, variants in white.items():
        found: dict[str, list[float]] = {name: [] for name in variants}
        for i in range(len(data.dataset(split))):
            frame = data.dataset(split)[i]
            with torch.no_grad():
                painting = avatar(*frame.inputs)
            truth = on_background(frame.image, frame.mask, 1.0)
            for name, picture in (
                (
                    "full",
                    (painting.image.clamp(0, 1), painting.alpha.clamp(0, 1)),
                ),
                ("splat", (painting.colour.clamp(0, 1), painting.splat_alpha)),
                (
                    "floor",
                    (torch.zeros_like(truth), torch.zeros_like(frame.mask)),
                ),
            ):
                found[name].append(
                    float(psnr(on_background(*picture, 1.0).clamp(0, 1), truth))
                )
        for name, values in variants.items():
            assert values["psnr"] == pytest.approx(
                sum(found[name]) / len(found[name]), abs=1e-3
            )
            assert abs(values["psnr"] - black[split][name]["psnr"]) > 0.1
            assert "scored on white" in values["marks"]
            assert "scored on white" not in black[split][name]["marks"]


def test_another_background_departs_from_the_protocol(copy, given, inside):
    arguments = [
        f"predictions={copy}",
        "splits=[novel_view]",
        *given,
        *PROTOCOL,
    ]
    for word in ("null", "white"):
        result = inside("evaluate", *arguments, f"background={word}")
        refused(result, "has a black background, expected white", "with alpha")
    result = inside("evaluate", *arguments, "background=black")
    assert result.returncode == 0, result.stderr
    folder = copy.with_name("other_scores")
    full = scores(folder)["novel_view"]["full"]
    assert full["marks"] == ["scored on black"]
    departure = "background is black, asked for: white"
    assert departure in full["protocol"]["departures"]
    assert (
        "departs from paper_thuman4: " + departure
        in (folder / "metrics.md").read_text()
    )


def resize(path: Path) -> None:
    cv2.imwrite(str(path), np.zeros((16, 32, 3), np.uint8))


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (Path.unlink, ("lacks 1 of 8", "camera cam01, frame 5")),
        (resize, ("camera cam01, frame 5", "32x16", "32x32")),
        (
            lambda path: path.write_bytes(path.read_bytes()[:70]),
            ("cam01/0005.png",),
        ),
        (
            lambda path: shutil.copy(path, path.with_name("5.png")),
            ("frame 5 twice",),
        ),
        (lambda path: path.write_bytes(b""), ("cam01/0005.png",)),
    ],
)
def test_one_wrong_image_is_named_and_nothing_is_written(
    copy, given, inside, damage, words
):
    damage(copy / "novel_pose" / "cam01" / "0005.png")
    refused(inside("evaluate", f"predictions={copy}", *given), *words)
    assert not copy.with_name("other_scores").exists()


def test_arguments_that_do_not_fit_together_are_refused(
    run, copy, given, compose
):
    from configs import evaluate_config

    here = f"predictions={copy}"
    for arguments, words in (
        ([], ("give either run=", "predictions=")),
        ([f"run={run}", here], ("give either run=",)),
        ([here], ("data is not set", "data.root")),
        ([f"run={run}", *given], ("data= cannot be given with run=",)),
        ([f"run={run}", "method=x"], ("method= cannot be given with run=",)),
        (
            [here, *given, "data_root=/x"],
            ("data_root= cannot be given with predictions=",),
        ),
        (
            [here, *given, "drive=skeleton"],
            ("drive= cannot be given with predictions=",),
        ),
        ([f"run={run}", "drive=body"], ("drive must be skeleton or null",)),
        ([f"run={run}", "align=image"], ("align must be pose or null",)),
        (
            [here, *given, "splits=[]"],
            ("splits must be a list of novel_view and novel_pose",),
        ),
        (
            [here, *given, "predictions_pattern=x.png"],
            ("must have {frame} and {camera}",),
        ),
        (
            [here, *given, "background=grey"],
            ("background must be black, white or null",),
        ),
        (
            [f"run={run}", "background=grey"],
            ("background must be black, white or null", "'grey'"),
        ),
        ([here, *given, f"out={copy}/scores"], ("is inside the predictions",)),
        ([here, *given, f"out={run}"], ("a run folder",)),
        ([f"predictions={copy}/no", *given], ("other/no is not a folder",)),
    ):
        with pytest.raises(GsganError) as caught:
            evaluate_config(compose("evaluate", *arguments))
        for word in words:
            assert word in str(caught.value)


def test_another_methods_scores_are_not_overwritten(copy, given, inside):
    arguments = [f"predictions={copy}", "splits=[novel_pose]", *given]
    out = copy.parent / "kept"
    assert (
        inside("evaluate", *arguments, "method=one", f"out={out}").returncode
        == 0
    )
    refused(
        inside("evaluate", *arguments, "method=two", f"out={out}"),
        "scores of one, not of two",
    )
    (copy / "novel_pose" / "notes.txt").write_text(
        "mine"
    )  # other files are ignored
    assert (
        inside("evaluate", *arguments, "method=one", f"out={out}").returncode
        == 0
    )


def test_seconds_of_a_resumed_training_add_up(tiny, monkeypatch):
    """Parts before an interruption count."""
    from types import SimpleNamespace

    from configs import build_training

    from gsgan.train import module as training

    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(training.time, "monotonic", lambda: clock.now)

    def part(before: dict | None, seconds: float) -> dict:
        _, module = build_training(tiny("model=splat_only"))
        if before is not None:
            module.on_load_checkpoint(before)
        module.on_train_start()
        clock.now += seconds
        checkpoint: dict = {}
        module.on_save_checkpoint(checkpoint)
        module.on_train_end()
        clock.now += 1000.0  # what comes after the training is not counted
        assert module.train_seconds == checkpoint["gsgan"]["train_seconds"]
        return checkpoint

    first = part(None, 5.0)
    assert first["gsgan"]["train_seconds"] == 5.0
    assert part(first, 2.5)["gsgan"]["train_seconds"] == 7.5


def test_cameras_of_several_sizes_share_one_grid(tmp_path):
    from gsgan.evaluate.grids import CAPTION_HEIGHT, write_grid

    small, large = torch.ones(3, 2, 5), torch.ones(3, 4, 3)
    path = tmp_path / "grid.png"
    write_grid([{"x": small}, {"x": large}], path, minimum=1)
    shown = cv2.imread(str(path))[CAPTION_HEIGHT:]
    assert shown.shape == (8, 5, 3)
    assert (shown[:2] == 255).all()
    assert (shown[2:4] == 0).all()
    assert (shown[4:, :3] == 255).all()
    assert (shown[4:, 3:] == 0).all()
