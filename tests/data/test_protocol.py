"""Protocols: who trains, who tests, and what is written beside the numbers."""

import json
from dataclasses import replace

import pytest
from make import write_tiny_capture

from gsgan.data.datamodule import GsganData
from gsgan.data.formats.capture import read_capture
from gsgan.data.metric_variants import CHOICES, MetricVariants
from gsgan.data.protocol import Protocol
from gsgan.data.splits import parse_frames, protocol_splits
from gsgan.utils.config import config_folder
from gsgan.utils.errors import ConfigError, DataError

NAMES = sorted(
    {p.stem for p in (config_folder() / "protocol").glob("*.yaml")} - {"none"}
)
SCORED = {
    "zju_humannerf": 16,
    "paper_zju": 16,
    "zju_gauhuman": 17,
}  # frames a camera
SCORED |= {"thuman4_posevocab": 500, "paper_thuman4": 500}
ONE = Protocol(
    "one",
    train_cameras=[0],
    test_cameras=None,
    train_frames="0-5",
    test_frames="0-9:4",
)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_tiny_capture(
        tmp_path_factory.mktemp("capture"), cameras=4, frames=10
    )


@pytest.fixture(scope="module")
def layout(root):
    return read_capture(root)


def test_frames_may_have_a_step():
    assert parse_frames("0-495:5", "x")[:3] == (0, 5, 10)
    assert len(parse_frames("0-495:5", "x")) == 100
    assert len(parse_frames("0-480:30", "x")) == 17
    assert parse_frames(["0-6:3", 1], "x") == (0, 1, 3, 6)
    with pytest.raises(ConfigError, match=r"^x .*"):
        parse_frames("0-9:0", "x")


@pytest.mark.parametrize(
    "value",
    ["0-99999999999", "5000000000", 10**10, "9" * 5000, ["0-600", "601-1200"]],
)
def test_frames_without_end_are_refused(value, monkeypatch):
    monkeypatch.setattr("gsgan.data.splits.MAX_LISTED_FRAMES", 1000)
    with pytest.raises(ConfigError, match=r"^x"):
        parse_frames(value, "x")


def test_one_camera_trains_and_the_others_test_every_fourth_frame(layout):
    splits = protocol_splits(layout, ONE)
    assert splits.train_cameras == ("cam00",)
    assert splits.test_cameras == ("cam01", "cam02", "cam03")
    assert tuple(splits.items["train"]) == tuple(("cam00", f) for f in range(6))
    # 0 and 4 train (from another camera): a novel view; 8 does not: a novel pose
    assert tuple(splits.items["novel_view"]) == tuple(
        (f"cam0{c}", f) for c in (1, 2, 3) for f in (0, 4)
    )
    assert tuple(splits.items["novel_pose"]) == tuple(
        (f"cam0{c}", 8) for c in (1, 2, 3)
    )
    assert splits.reasons == {}


def test_new_poses_seen_by_a_camera_that_trains(layout):
    protocol = Protocol(
        "poses",
        train_cameras=["cam00", "cam02", "cam03"],
        test_cameras=["cam02"],
        train_frames="0-6",
        test_frames="7-99",
    )
    splits = protocol_splits(layout, protocol)
    assert tuple(splits.items["novel_pose"]) == (
        ("cam02", 7),
        ("cam02", 8),
        ("cam02", 9),
    )
    assert splits.reasons == {"novel_view": "protocol poses has none"}
    assert (
        "90 frames of protocol poses are not usable or do not exist: 10-99"
        in (splits.notes)
    )


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        (
            {"train_cameras": [21]},
            DataError,
            "one .*camera 21.* 4: cam00, cam01",
        ),
        ({"train_cameras": [-1]}, DataError, "camera -1"),
        (
            {"test_cameras": ["cam9"]},
            DataError,
            "camera cam9.* 4: cam00",
        ),
        (
            {"test_cameras": [0]},
            ConfigError,
            "frame 0 .*cam00",
        ),
        (
            {"train_frames": "50-60"},
            DataError,
            "cameras cam00",
        ),
        (
            {"train_frames": {"377": "0-3"}},
            ConfigError,
            r"protocol\.subject.*None",
        ),
        (
            {"test_frames": "x"},
            ConfigError,
            r"protocol\.test_frames",
        ),
        ({"scale": 0}, ConfigError, r"protocol\.scale"),
        (
            {"train_cameras": None},
            ConfigError,
            r"protocol\.train_cameras.*protocol\.test_cameras",
        ),
    ],
)
def test_protocols_that_do_not_fit(layout, changes, error, message):
    with pytest.raises(error, match=message):
        protocol_splits(layout, replace(ONE, **changes))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        *((name, "x", "'x'") for name in CHOICES),
        ("background", "grey", "black.*white.*'grey'"),
        ("psnr_pooling", "split", "image.*channels"),
        ("eight_bits", True, "rounded.*True"),
        ("truth_outline", 0.5, r"soft.*0\.5"),
        ("ssim_window", 7, "uniform.*7"),
        ("lpips_channels", "RGB", "bgr.*'RGB'"),
        (
            "region",
            "mask",
            "body_box_cleared.*'mask'",
        ),
        ("lpips_region", None, "mask_crop_512.*None"),
        (
            "lpips_range",
            [0, 255],
            r"\[-1\.0, 1\.0\].*\(0, 255\)",
        ),
        ("ssim_range", True, r"2\.0.*True"),
    ],
)
def test_measures_are_named_ones(name, value, message):
    with pytest.raises(
        ConfigError, match=f"protocol.measures.{name}.*{message}"
    ):
        MetricVariants(**{name: value})


def test_measures_take_what_yaml_gives():
    assert MetricVariants(lpips_range=[0, 1]).lpips_range == (0.0, 1.0)
    assert MetricVariants(ssim_range=2).ssim_range == 2
    assert not MetricVariants().needs_body_box
    assert all(
        getattr(MetricVariants(), name) == choices[0]
        for name, choices in CHOICES.items()
    )


def test_frames_by_subject():
    protocol = replace(
        ONE, train_frames={377: "0-569"}, test_frames={377: "0-569:30"}
    )
    assert replace(protocol, subject="377").frames("train") == "0-569"
    assert replace(protocol, subject=377).record()["test_frames"] == "0-569:30"
    with pytest.raises(ConfigError, match=r"protocol\.subject.*378.*377"):
        replace(protocol, subject=378).frames("test")


def test_departures_are_said():
    same = replace(ONE, scale=0.5)
    assert list(same.departures(lpips_nets=["vgg"], scales=[0.5, 0.5])) == []
    other = replace(
        ONE, measures=MetricVariants(background="white", lpips_range=(0, 1))
    )
    said = list(other.departures(lpips_nets=["alex"], scales=[0.25, 1]))
    assert said == [  # what the measures ask for is done
        "LPIPS is not computed with vgg, as requested (lpips.nets)",
        "images are scored at scale 0.25, requested: 1 (data.size)",
    ]
    assert "cut round the person" in next(
        ONE.departures(lpips_nets=["vgg"], scales=None)
    )
    assert set(CHOICES) == set(ONE.record()["measures"])


def test_the_data_follows_the_protocol_and_records_it(root):
    data = GsganData(str(root), size=16, protocol=replace(ONE, scale=0.5))
    assert len(data.dataset("train")) == 6
    assert data.eval_names == ("novel_view", "novel_pose")
    record = data.protocol_record(["vgg"])
    assert json.loads(json.dumps(record)) == record  # plain values
    assert record["name"] == "one"
    (padded,) = record[
        "departures"
    ]  # 16 of 32 pixels, but the pictures are 32 x 24
    assert padded.startswith("images are padded to squares with black")
    whole = GsganData(str(root), protocol=ONE).protocol_record(["vgg"])
    assert whole["departures"] == []
    assert GsganData(str(root)).protocol_record(["vgg"]) is None
    cut = GsganData(
        str(root), size=16, crop="person", protocol=ONE
    ).protocol_record(["vgg"])
    assert len(cut["departures"]) == 1


def test_cameras_of_other_sizes_depart_from_the_scale(root):
    data = GsganData(str(root), size=16, protocol=replace(ONE, scale=0.5))
    name, camera = list(data.layout.cameras.items())[-1]
    data.layout.cameras[name] = replace(camera, size=(48, 64))
    departures = data.protocol_record(["vgg"])["departures"]
    assert (
        "images are scored at scale 0.25, requested: 0.5 (data.size)"
        in departures
    )


@pytest.mark.parametrize("name", NAMES)
def test_every_protocol_composes_and_is_whole(compose, name):
    from hydra.utils import instantiate

    overrides = [
        "data=capture",
        "data.root=/none",
        f"protocol={name}",
        "size=tiny",
    ]
    if "humannerf" in name or name == "paper_zju":
        overrides.append("protocol.subject=394")
    config = compose("train", *overrides)
    data = instantiate(config.data)
    assert data.crop is None
    assert data.protocol.name == name
    assert data.size == (512 if "zju" in name else None)
    record = json.loads(json.dumps(data.protocol.record()))
    assert record["source"]
    assert parse_frames(record["train_frames"], "x")
    assert len(parse_frames(record["test_frames"], "x")) == SCORED[name]


def test_the_frames_of_zju_are_those_that_were_scored(compose):
    """ceil(n / 30) pictures a camera: the published counts."""
    config = compose("train", "data=capture", "protocol=zju_humannerf")
    counts = {
        k: len(parse_frames(v, k))
        for k, v in config.protocol.test_frames.items()
    }
    assert counts == {377: 19, 386: 18, 387: 18, 392: 19, 393: 22, 394: 16}
