"""`gsgan.bench speed`: stages, precision and memory of a tiny avatar, and error messages."""

import json
import platform

import pandas as pd
import pytest
import torch
from commands import refused

from gsgan.bench.__main__ import main
from gsgan.bench.common import cpu_name, environment, number, sentence
from gsgan.bench.speed import (
    deciles,
    in_batches,
    make_painter,
    measure,
    spread,
    text,
)
from gsgan.model.avatar import UNWATCHED, watch_nothing
from gsgan.utils.errors import ConfigError

ALL = [
    "solve",
    "window",
    "skeleton",
    "bones",
    "densify",
    "Ψ",
    "F",
    "S",
    "p₂D",
    "Ω",
]
ALL += ["pose encoder", "UNet", "paste"]


@pytest.fixture
def small(build):
    data, avatar, frame = build()
    with (
        torch.no_grad()
    ):  # a trained one: where the UNet paints and Gaussians differ
        for parameter in avatar.parameters():
            parameter += 0.05 * torch.randn(
                parameter.shape, generator=torch.manual_seed(1)
            )
    return data, avatar.eval(), frame


def test_the_median_and_deciles():
    assert deciles(range(11)) == {
        "median": 5.0,
        "p10": 1.0,
        "p90": 9.0,
        "minimum": 0.0,
    }
    assert deciles([7.0]) == dict.fromkeys(
        ("median", "p10", "p90", "minimum"), 7.0
    )


def test_every_stage_is_timed_and_the_avatar_is_left_unwatched(small):
    _, avatar, frame = small
    ticks = []
    painter = make_painter(avatar)
    times = measure(
        avatar,
        painter,
        [frame],
        count=3,
        warmup=2,
        tick=lambda: ticks.append(1),
    )
    assert list(times.index) == [*ALL, "between stages", "end to end"]
    assert len(ticks) == 5
    stages = times.loc[ALL]
    assert (stages.p10 > 0).all()
    assert (
        (stages.p10 <= stages["median"]) & (stages["median"] <= stages.p90)
    ).all()
    assert avatar.stage is watch_nothing
    assert avatar.stage("F") is UNWATCHED
    avatar.generator.forward = None  # a stage that fails
    with pytest.raises(TypeError, match="not callable"):
        measure(avatar, painter, [frame], count=1, warmup=0)
    assert avatar.stage is watch_nothing


@pytest.mark.parametrize(
    ("model", "absent", "there"),
    [
        ("wo_seg", {"S"}, {"F", "UNet"}),
        ("splat_only", {"S", "UNet", "p₂D", "Ω", "pose encoder"}, {"Ψ", "F"}),
        ("image_to_image", {"densify", "Ψ", "F"}, {"p₂D", "UNet"}),
        ("lbs_splat", {"densify", "Ψ", "UNet"}, {"surface", "F"}),
    ],
)
def test_what_a_model_lacks_has_no_stage(build, model, absent, there):
    few = ["model.surface.points=100"] if model == "lbs_splat" else []
    _, avatar, frame = build(f"model={model}", *few)
    painter = make_painter(avatar.eval())
    stages = set(measure(avatar, painter, [frame], count=1, warmup=0).index)
    assert there <= stages
    assert not absent & stages


def test_batches_are_timed_per_image(small):
    *_, frame = small
    sizes = []
    times = in_batches(
        lambda batch: sizes.append(len(batch)), [frame, frame], None, 3, 7
    )
    assert sizes == [3, 3, 3]
    assert 0 < times["minimum"] <= times["median"]


def test_precision_reaches_the_networks_and_not_the_image_type(small):
    _, avatar, frame = small
    full, half = (
        make_painter(avatar)(frame),
        make_painter(avatar, "bf16-mixed")(frame),
    )
    assert half.dtype == full.dtype == torch.float32
    assert 0 < (half - full).abs().max() < 0.1


def test_the_frames_are_spread_over_a_split(small):
    data, _, _ = small
    assert [int(f.frame_id) for f in spread(data, 2, "novel_pose")] != []
    assert len(spread(data, 99)) == len(data.dataset("novel_pose"))
    data.dataset("novel_view").items = ()
    with pytest.raises(ConfigError, match="novel_view"):
        spread(data, 2, "novel_view")


def test_the_machine_is_described_without_its_host(tmp_path):
    where = environment(torch.device("cpu"))
    assert f"torch {where['versions']['torch']}" in sentence(where)
    host = platform.node()
    assert len(host) < 4 or host not in json.dumps(where)
    listing = tmp_path / "cpuinfo"
    listing.write_text(
        "processor : 0\nmodel name : Abacus 3000\nmodel name : Second\n"
    )
    assert cpu_name(listing) == "Abacus 3000"
    assert cpu_name(tmp_path / "absent") == (
        platform.processor() or platform.machine()
    )


@pytest.mark.parametrize(
    ("value", "digits", "shown"),
    [
        (None, 3, "–"),
        (float("inf"), 3, "∞"),
        (0.0, 3, "0.00"),
        (1.2345, 3, "1.23"),
        (12345.6, 3, "12346"),
        (1.26e-5, 2, "1.3e-05"),
    ],
)
def test_numbers_have_their_significant_digits(value, digits, shown):
    assert number(value, digits) == shown


def test_the_table_adds_up():
    rows = {
        "F": (6, 5, 7, 4),
        "UNet": (3, 2, 4, 2),
        "between stages": (1, 1, 1, 1),
        "end to end": (10, 9, 12, 8),
    }
    times = pd.DataFrame(rows, index=["median", "p10", "p90", "minimum"]).T
    settings = {"avatar": "untrained avatar", "image": "512 x 512"}
    page = text(
        times, environment(torch.device("cpu")), settings, ["untrained weights"]
    )
    assert "| F | 6.00 | 5.00 | 7.00 | 4.00 | 60% |" in page
    assert (
        "| **end to end** | 10.0 | 9.00 | 12.0 | 8.00 | 100.0 frames/s |"
        in page
    )
    assert "- untrained weights" in page


@pytest.mark.slow
def test_the_command_times_a_run(run, tmp_path, inside):
    out = tmp_path / "out"
    given = [
        f"run={run}",
        "frames=2",
        "warmup=1",
        "poses=2",
        f"hydra.run.dir={out}",
    ]
    done = inside("bench", "speed", *given)
    assert done.returncode == 0, done.stderr
    found = json.loads((out / "speed.json").read_text())
    assert list(found["times_ms"]["stages"]) == ALL
    assert found["settings"]["avatar"] == f"trained run {run.name}"
    assert found["settings"]["precision"] == "32-true"
    assert found["where"]["threads"] >= 1
    assert (
        0
        < found["times_ms"]["batches"]["minimum"]
        <= found["times_ms"]["batches"]["median"]
    )
    page = (out / "speed.md").read_text()
    assert "- in batches of 8: " in page
    assert "| UNet |" in page
    # denormals are there again
    assert torch.tensor([1e-310], dtype=torch.float64) * 1 > 0


def test_the_command_times_an_untrained_avatar_at_its_size(
    capture, tmp_path, inside
):
    out = tmp_path / "out"
    given = [
        "size=tiny",
        "size.image=64",
        f"data.root={capture}",
        "frames=1",
        "warmup=0",
    ]
    done = inside(
        "bench", "speed", *given, "model=splat_only", f"hydra.run.dir={out}"
    )
    assert done.returncode == 0, done.stderr
    found = json.loads((out / "speed.json").read_text())
    assert found["settings"]["image"] == "64 x 64"
    assert "untrained weights" in found["marks"][0]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("frames=0", ["frames"]),
        ("warmup=-1", ["warmup"]),
        ("threads=0", ["threads"]),
        ("channels_last=maybe", ["channels_last"]),
        ("precision=8-bit", ["precision", "32-true"]),
        ("backend=vulkan", ["backend", "native"]),
        ("run=/nowhere", ["/nowhere", "not a run folder"]),
        ("device=cuda:99", ["device=cuda:99"]),
    ],
)
def test_what_makes_no_sense_ends_in_one_sentence(inside, given, words):
    refused(inside("bench", "speed", given), *words)


@pytest.mark.parametrize("words", [(), ("trade-off", "run=x")])
def test_another_subject_is_refused(monkeypatch, words):
    monkeypatch.setattr("sys.argv", ["bench", *words])
    with pytest.raises(SystemExit, match="the first word must be speed"):
        main()
