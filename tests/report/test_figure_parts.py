"""The parts of the figures, on images whose numbers are known."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from gsgan.report.figures import images
from gsgan.report.figures.body import (
    agreement,
    disagreement,
    draw_gaussians,
    ellipses,
    part_colours,
)
from gsgan.report.figures.layout import Panel, Settings, Sheet, Unavailable, style, written
from gsgan.report.figures.run import FIGURES
from gsgan.report.figures.subjects import Subject, choose_items, make_shots, measure
from gsgan.report.runs import Run
from gsgan.scene import Camera, Gaussians
from gsgan.skeleton import Densify
from gsgan.splat import ACCURACY, project
from gsgan.utils.errors import ConfigError, DataError

SETTINGS = Settings()


def rendered(figure) -> np.ndarray:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


def rgb(colour: str) -> list[int]:
    return [round(255 * value) for value in to_rgb(colour)]


def pinhole() -> Camera:
    """At the origin, looking along +z; 100 pixels of focal length, 64 x 64 pixels."""
    K = torch.tensor([[[100.0, 0, 32], [0, 100, 32], [0, 0, 1]]])
    return Camera(K, torch.eye(3)[None], torch.zeros(1, 3), (64, 64))


def test_measures_in_closed_form():
    truth = torch.zeros(1, 3, 16, 16)
    truth[..., 4:12, 4:12] = 0.8
    found = measure(truth + 0.1, truth)
    assert found["psnr"] == pytest.approx(20, abs=1e-4)
    assert found["edge_f1"] == 1
    assert found["edge_ratio"] == 1
    same = measure(truth, truth)
    assert same["psnr"] is None  # infinite
    blank = measure(truth, torch.zeros_like(truth))
    assert blank["edge_f1"] is None
    assert blank["edge_ratio"] is None
    assert written(None, 2, " dB") == "n/a"


def test_edges_found_missing_and_invented_have_their_colours():
    truth, edges = np.zeros((8, 8), bool), np.zeros((8, 8), bool)
    truth[1, 1] = truth[6, 6] = True
    edges[1, 2] = edges[6, 1] = True  # one pixel off, and far from any
    painted = images.paint_edges(edges, truth)
    colours = {images.FOUND: (1, 2), images.MISSED: (6, 6), images.INVENTED: (6, 1)}
    for colour, (row, column) in colours.items():
        assert painted[row, column].tolist() == rgb(colour)
    assert (painted != 255).any(-1).sum() == 3


def test_errors_are_levels_of_255_and_share_one_scale():
    truth = torch.zeros(1, 3, 2, 2)
    image = truth.clone()
    image[0, :, 0, 0] = torch.tensor([0.3, -0.3, 0.6])
    assert images.error_levels(image, truth)[0, 0] == pytest.approx(0.4 * 255)
    assert images.scale_end(torch.tensor([0.0, 12.0])) == 15
    assert images.scale_end(torch.zeros(4)) == 5


def test_the_box_lies_where_the_runs_differ():
    runs = torch.zeros(3, 3, 20, 10)
    runs[1, :, 12:16, 6:9] = 1.0
    rows, columns = images.most_disputed(runs, 0.3)
    assert (rows.stop - rows.start, columns.stop - columns.start) == (6, 3)
    assert rows.start <= 12
    assert rows.stop >= 16
    assert (columns.start, columns.stop) == (6, 9)
    whole = images.most_disputed(torch.zeros(2, 3, 5, 5), 1.0)
    assert whole == (slice(0, 5), slice(0, 5))


def test_agreement_of_parts_in_closed_form():
    labels = torch.tensor([[[0, 1, 1, 2], [255, 2, 2, 0]]])
    ours = torch.tensor([[[0, 1, 2, 2], [1, 2, 2, 0]]])
    parts = torch.nn.functional.one_hot(ours, 3).permute(0, 3, 1, 2).float()
    found = agreement(parts, labels)
    assert found["miou"] == pytest.approx((1 / 2 + 3 / 4) / 2)
    assert found["wrong_share"] == pytest.approx(1 / 5)  # 255 is left out
    wrong = disagreement(ours, labels)[0]
    assert wrong[:, 0, 0].tolist() == [1, 1, 1]
    assert wrong[:, 0, 2].tolist() == pytest.approx([0xD5 / 255, 0x5E / 255, 0])
    assert wrong[:, 1, 0].tolist() == [1, 1, 1]
    nobody = torch.zeros(1, 2, 2, dtype=torch.int64)
    blank = torch.nn.functional.one_hot(nobody, 3).permute(0, 3, 1, 2).float()
    assert agreement(blank, nobody) == {"miou": None, "wrong_share": None}


def test_ellipses_are_the_projected_covariances():
    camera = pinhole()
    turn = math.radians(30)
    gaussians = Gaussians(
        means=torch.tensor([[[0.0, 0, 2]]]),
        quats=torch.tensor([[[math.cos(turn / 2), 0, 0, math.sin(turn / 2)]]]),
        scales=torch.tensor([[[0.2, 0.05, 0.01]]]),
        opacities=torch.ones(1, 1),
        features=torch.ones(1, 1, 3),
    )
    seen = project(gaussians, camera, ACCURACY["exact"])
    a, b, angle = ellipses(seen.factors[0].double())
    low = ACCURACY["exact"].low_pass
    lengths = {float(a): float(angle), float(b): float(angle) + math.pi / 2}
    major, minor = max(lengths), min(lengths)
    assert major == pytest.approx(math.sqrt((100 * 0.2 / 2) ** 2 + low), rel=1e-4)
    assert minor == pytest.approx(math.sqrt((100 * 0.05 / 2) ** 2 + low), rel=1e-4)
    assert math.remainder(lengths[major] - turn, math.pi) == pytest.approx(0, abs=1e-4)


def test_ellipses_are_as_wide_as_the_supersampled_image_has_them():
    camera = pinhole()
    gaussians = Gaussians(
        means=torch.tensor([[[0.0, 0, 2]]]),
        quats=torch.tensor([[[1.0, 0, 0, 0]]]),
        scales=torch.tensor([[[0.002, 0.002, 0.002]]]),  # a tenth of a pixel: low-pass matters
        opacities=torch.ones(1, 1),
        features=torch.ones(1, 1, 3),
    )
    accuracy = replace(ACCURACY["high"], supersample=2)
    larger = project(gaussians, camera.resize((128, 128)), accuracy)
    wanted, _, _ = ellipses(larger.factors[0].double())
    axes = Figure().add_subplot()
    draw_gaussians(axes, gaussians, SimpleNamespace(camera=camera), accuracy)
    (drawn,) = axes.collections
    assert 2 * float(drawn.get_widths()[0]) == pytest.approx(2 * float(wanted[0]), rel=1e-4)


def test_every_part_has_the_colour_of_its_bone():
    densify = Densify()
    assert len(part_colours(densify)) == int(densify.part_id.max()) + 1


def test_a_panel_holds_its_image_and_text_fits_its_width():
    image = torch.zeros(1, 3, 4, 2)
    image[0, 0, 3, 1] = 1.0  # the lower right pixel is red
    with style(SETTINGS):
        titles = ["a title wider than its panel", "$x^$"]  # and no formula
        panels = [[Panel(image, "note"), Panel(image)]]
        sheet = Sheet(panels, SETTINGS, width=1.5, titles=titles, names=["row"], foot=0.3)
        drawn = rendered(sheet.figure)
    box = sheet.axes[0, 1].get_window_extent()
    height = drawn.shape[0]
    corner = drawn[round(height - box.y0) - 3, round(box.x1) - 3]
    assert corner.tolist() == [255, 0, 0]
    assert drawn[round(height - box.y1) + 3, round(box.x0) + 3].tolist() == [0, 0, 0]
    long, short = (axes.title for axes in sheet.axes[0])
    assert long.get_window_extent().width <= box.width * 1.01
    assert short.get_fontsize() == long.get_fontsize() < SETTINGS.font
    assert sheet.width <= 1.5 + 1e-9
    assert box.height / sheet.figure.dpi <= SETTINGS.tallest


@pytest.mark.parametrize(
    ("key", "value"),
    [("font", 0), ("dpi", 10**8), ("page", "wide"), ("column", 0.1), ("page", math.inf),
     ("margin", math.nan)],
)  # fmt: skip
def test_settings_that_cannot_be_are_refused(key, value):
    with pytest.raises(ConfigError, match=key):
        Settings(**{key: value})


@pytest.fixture
def data(build):
    return build()[0]


def test_shots_are_spread_over_frames_and_cameras(data):
    def choose(**given):
        keys = {"frames": None, "camera": None, "count": 2} | given
        return choose_items(data, "novel_pose", **keys)

    assert choose() == [("cam00", 4), ("cam01", 5)]
    assert choose(frames=[5, 4]) == [("cam00", 5), ("cam01", 4)]
    assert choose(camera="cam01") == [("cam01", 4), ("cam01", 5)]
    assert choose(one_camera=True) == [("cam00", 4), ("cam00", 5)]
    with pytest.raises(ConfigError, match=r"lacks 99; it has 4-5"):
        choose(frames=[4, 99])
    with pytest.raises(ConfigError, match="cam02 is not in split novel_pose, which has cam00"):
        choose(camera="cam02")
    with pytest.raises(ConfigError, match="split must be one of"):
        choose_items(data, "test", frames=None, camera=None, count=1)


def test_an_empty_split_names_those_with_images(build):
    data = build("data.test_cameras=[]", "data.train_cameras=[cam00,cam01,cam02]")[0]
    with pytest.raises(
        DataError, match=r"no camera is held out.*use split=train, split=novel_pose"
    ):
        choose_items(data, "novel_view", frames=None, camera=None, count=1)


def test_windows_hold_the_joints_and_have_one_size(data):
    items = [("cam00", 0), ("cam01", 3)]
    shots = make_shots(data, "train", items, margin=0.1)
    assert [shot.item for shot in shots] == items
    assert len({shot.truth.shape for shot in shots}) == 1
    for shot in shots:
        height, width = shot.window.size
        pixels, _ = shot.camera.project(shot.frame.skeleton)
        inside = (pixels >= 0) & (pixels <= torch.tensor([width, height]))
        reach, _ = shot.frame.camera.project(shot.frame.skeleton)
        in_picture = (reach >= 0) & (reach <= 32)
        assert bool(inside[in_picture].all())
        assert torch.equal(shot.truth, shot.window.cut(shot.frame.image))


def subject_of(build, *overrides: str) -> Subject:
    data, avatar, _ = build(*overrides)
    model = overrides[0].removeprefix("model=") if overrides else "full"
    return Subject(model, Run(Path("run"), model, {}, 0, {}), data, avatar.eval(), [])


@pytest.mark.parametrize(
    ("model", "figure", "words"),
    [
        ("splat_only", "segmentation", "has no segmentation S: the model leaves it out"),
        ("splat_only", "errors", "no second image"),
        ("image_to_image", "densify", "makes no points"),
    ],
)
def test_a_figure_that_a_model_cannot_have_says_why(build, model, figure, words):
    subject = subject_of(build, f"model={model}")
    shots = make_shots(subject.data, "novel_pose", [("cam00", 4)], 0.2)
    with style(SETTINGS), pytest.raises(Unavailable, match=words):
        FIGURES[figure]([subject], shots, SETTINGS)


def test_data_without_labels_has_no_segmentation_figure(build):
    subject = subject_of(build)
    shot = make_shots(subject.data, "novel_pose", [("cam00", 4)], 0.2)[0]
    bare = replace(shot, frame=replace(shot.frame, labels=None))
    with pytest.raises(Unavailable, match="no part labels"):
        FIGURES["segmentation"]([subject], [bare], SETTINGS)


def test_drawing_leaves_the_avatar_on_its_device(build, monkeypatch):
    """On a GPU, points moved to the CPU for a figure would be missing for the next image."""
    subject = subject_of(build)
    moved: set[int] = set()
    apply = torch.nn.Module._apply

    def watched(self, *given, **more):
        moved.add(id(self))
        return apply(self, *given, **more)

    monkeypatch.setattr(torch.nn.Module, "_apply", watched)
    shots = make_shots(subject.data, "novel_pose", [("cam00", 4)], 0.2)
    with style(SETTINGS):
        FIGURES["densify"]([subject], shots, SETTINGS)
    assert moved  # the copy was
    assert not moved & {id(module) for module in subject.avatar.modules()}


def test_what_is_kept_of_a_painting_is_on_the_cpu(build):
    """Whatever of it shows; nothing else fills memory on the device that painted."""
    subject = subject_of(build)
    shot = make_shots(subject.data, "novel_pose", [("cam00", 4)], 0.2)[0]
    render = subject.avatar.forward

    def painted(*inputs):
        found = render(*inputs)
        tinted = None if found.colour is None else found.colour * 0.5
        return replace(found, corrected=tinted)

    subject.avatar.forward = painted
    kept = subject.paint(shot)
    for name in ("corrected", "alpha", "splat_alpha"):
        assert getattr(kept, name) is None, name
    assert kept.features.shape[1] == 3
    assert kept.segmentation is not None
    assert kept.gaussians is not None
    want = painted(*shot.frame.inputs).corrected
    assert torch.equal(subject.colour(shot), shot.window.cut(want).clamp(0, 1))


def test_a_splat_only_run_stands_for_splatting_alone(build):
    """In place of Step I's colour, whose column it takes."""
    full, splat = subject_of(build), subject_of(build, "model=splat_only")
    shots = make_shots(full.data, "novel_pose", [("cam00", 4)], 0.2)
    with style(SETTINGS):
        alone = images.canny([full], shots, SETTINGS).numbers["cam00/000004"]
        both = images.canny([full, splat], shots, SETTINGS).numbers["cam00/000004"]
    assert list(alone) == ["full", "Step I's colour"]
    assert list(both) == ["full", "splat_only"]
