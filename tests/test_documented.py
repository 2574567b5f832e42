"""Every command of the README and the docs runs: as written, but tiny.

A line whose arguments another line of the command has too is composed, not run. Lines that are
only in docs/ are composed, and run with the slow tests.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from commands import ROOT, TINY

# A GPU's settings: one kind of machine runs the tests.
ELSEWHERE = ("trainer=gpu", "trainer=ddp")
REPORTS = ("ablation", "ablation_skeleton", "gan")  # blocks of docs/ablations.md
SMALL_BENCH = {
    "raster": [
        *("repeats=1", "gaussians=[300]", "channels=[3]", "sizes=[32]", "reference.gaussians=300"),
        *("reference.size=32", "compare_at=[300]", "windows=1", "window=16"),
        "memory=false",
    ],
    "speed": ["size=tiny", "frames=2", "warmup=1", "poses=2", "data.root=/path/to/capture"],
    "trade-off": [
        *("settings.accuracies=[draft]", "settings.scales=[0.5]", "settings.backends=[]"),
        *("settings.precisions=[]", "settings.windows=[]", "repeats=1", "pictures=1"),
    ],
    "roofline": ["sizes=[tiny]", "frames=2", "warmup=1", "poses=2", "data.root=/path/to/capture"],
    "effects": [
        *("train=false", "only=[distortion]"),
        "base=['size=tiny','data.source.frames=2','data.source.test_frames=1','data.body=none',"
        "'data.source.train_cameras=2','data.source.test_cameras=1',"
        "'data.source.rays_per_pixel=1']",
    ],
}


SIGNING = ("skeleton=holistic", "33_hands", "sign_demo", "paper_slp")  # need hands, or a face too
FEW = {"segmentation": 2, "step_one": 2, "step_two": 4, "discriminator_start": 1, "epoch": 4}


README = [ROOT / "README.md"]


def documented(pages: list[Path]) -> list[str]:
    """Every ``python -m gsgan.…`` of the pages, once."""
    text = "\n".join(page.read_text() for page in pages)
    blocks = re.findall(r"```bash\n(.*?)```", text, flags=re.DOTALL)
    lines = [line.split("#")[0].strip() for block in blocks for line in block.splitlines()]
    return sorted({line for line in lines if line.startswith("python -m gsgan.")})


def is_part(line: str, lines: list[str]) -> bool:
    """Whether another line has all words of this one."""
    return any(set(line.split()) < set(other.split()) for other in lines)


@pytest.fixture(scope="session")
def model_file(shared) -> Callable[[str], Path]:
    """A model file like SMPL's or SMPL-X's, of the default person, by kind."""
    from writers.smpl import write_smpl

    def run(kind: str) -> Path:
        suffix = "pkl" if kind == "smpl" else "npz"
        return shared(f"{kind}.{suffix}", lambda path: write_smpl(path, kind=kind))

    return run


@pytest.fixture
def place(capture, run, bare, model_file, tmp_path_factory) -> Callable[[str], str]:
    """Puts real, tiny files in the place of a documented line's placeholders."""

    def folder() -> Path:
        return tmp_path_factory.mktemp("documented")

    def zju() -> Path:
        from writers import zju
        from writers.common import make_subject

        return zju.write_original(folder() / "CoreView_377", make_subject(model_file("smpl")))

    def rig(name: str) -> Path:
        from writers.avatarrex import write_avatarrex
        from writers.smplx_rig import smplx_subject
        from writers.thuman4 import write_thuman4

        write = write_thuman4 if name == "subject00" else write_avatarrex
        return write(folder() / name, smplx_subject(model_file("smplx")))

    def take() -> Path:
        from writers.common import make_subject
        from writers.easymocap import write_easymocap

        return write_easymocap(folder() / "take", make_subject(model_file("smpl")))

    def videos() -> Path:
        from capture_scenes import write_project

        return write_project(folder() / "videos")

    def predictions() -> Path:
        import cv2

        from gsgan.data.datamodule import GsganData

        root, data = folder() / "predictions", GsganData(str(capture))
        for split in data.eval_names:
            dataset = data.dataset(split)
            for i, (camera, frame) in enumerate(dataset.items):
                path = root / split / camera / f"{frame:06d}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                picture = (dataset[i].image[0] * 255).round().byte().permute(1, 2, 0).numpy()
                cv2.imwrite(str(path), picture[..., ::-1])
        return root

    def report_page() -> Path:
        page = folder() / "page.md"
        blocks = (f"<!-- report:{name} -->\n<!-- /report -->" for name in REPORTS)
        page.write_text("# Page\n\n" + "\n\n".join(blocks) + "\n")
        return page

    def another_run(name: str) -> Path:
        return Path(shutil.copytree(run, folder() / name))

    def moving(name: str) -> Path:
        from mannequin import mannequin, write_bvh

        from gsgan.synthetic.posing import Choreography

        person = mannequin()
        return write_bvh(folder() / name, person, Choreography(person).at(np.ones(2)), 1 / 30)

    def rendered() -> Path:
        from PIL import Image

        from gsgan.utils.provenance import png_bytes

        path = folder() / "000000.png"
        path.write_bytes(png_bytes(Image.new("RGB", (8, 8))))
        return path

    makers: dict[str, Callable[[], Path | str]] = {
        "gsgan.render run=<run folder>": lambda: f"gsgan.render run={bare}",
        "/path/to/dance.bvh": lambda: moving("dance.bvh"),
        "/path/to/walk.bvh": lambda: moving("walk.bvh"),
        "/path/to/000000.png": rendered,
        "/path/to/run_wo_gcn": lambda: another_run("run_wo_gcn"),
        "/path/to/run_wo_seg": lambda: another_run("run_wo_seg"),
        "out=/path/to/capture": lambda: f"out={folder() / 'capture'}",
        "/path/to/capture": lambda: capture,
        "<run folder>": lambda: run,
        "/path/to/CoreView_377": zju,
        "/path/to/SMPL_NEUTRAL.pkl": lambda: model_file("smpl"),
        "/path/to/SMPLX_NEUTRAL.npz": lambda: model_file("smplx"),
        "/path/to/subject00": lambda: rig("subject00"),
        "/path/to/avatarrex_zzr": lambda: rig("avatarrex_zzr"),
        "/path/to/take": take,
        "/path/to/videos": videos,
        "/path/to/predictions": predictions,
        "/path/to/sweep": lambda: run,
        "data.test_frames=300-399": lambda: "data.test_frames=4-5",
        "runs=runs/ablation_skeleton": lambda: f"runs={run.parent}",
        "runs=runs/ablation_gan": lambda: f"runs={run.parent}",
        "runs=runs/ablation": lambda: f"runs={run.parent}",
        "/path/to/page.md": report_page,
        "fill=docs/ablations.md": lambda: f"fill={report_page()}",
    }

    def fill(line: str) -> str:
        for text, make in makers.items():
            if text in line:
                line = line.replace(text, str(make()))
        assert "/path/to" not in line, f"no stand-in for a placeholder of: {line}"
        return line

    return fill


def tiny_training(arguments: list[str], capture: Path) -> list[str]:
    given = [a for a in arguments if a != "experiment=demo" and a not in ELSEWHERE]
    given = [a for a in given if not a.startswith("data.source.")]  # the tiny capture has a pose
    if not any(a.startswith("data=") for a in given):
        given.append("data=capture")
    given += [t for t in TINY if not t.startswith("data=") and not fixed(given, t)]
    if not any(a.startswith("data.root=") for a in given):
        given.append(f"data.root={capture}")
    if {"experiment=paper", "data=thuman4"} <= set(given):  # three cameras stand in for 24
        given += ["protocol.test_cameras=[cam02]", "protocol.test_frames=2-3"]
        given += ["protocol.train_frames=0-1"]
    return given + [f"training.schedule.{name}={value}" for name, value in FEW.items()]


def shorter_sweep(arguments: list[str], folder: Path) -> list[str]:
    """The last of the values that it varies."""
    given = [re.sub(r"=.*,", "=", a) if "=[" not in a else a for a in arguments]
    return [*given, f"hydra.sweep.dir={folder / 'sweep'}", "hydra.sweep.subdir=${hydra.job.num}"]


def fixed(given: list[str], option: str) -> bool:
    """Whether a protocol says already what the option would say."""
    protocol = any(a.startswith("protocol=") for a in given)
    return protocol and option.startswith(("data.size", "data.crop"))


def tiny_bench(arguments: list[str], tmp_path: Path, capture: Path) -> list[str]:
    given = []
    for argument in arguments:
        if argument.startswith("docs="):
            page = tmp_path / "page.md"
            shutil.copy(ROOT / argument.removeprefix("docs="), page)
            given.append(f"docs={page}")
        elif argument.split("=")[0] not in {"repeats", "gaussians", "sizes", "size"}:
            given.append(argument.strip("'"))
    small = (w.replace("/path/to/capture", str(capture)) for w in SMALL_BENCH.get(given[0], []))
    return [*given, *small]


LINES = documented([*README, *(ROOT / "docs").glob("*.md")])
FIRST = set(documented(README))


@pytest.mark.parametrize("line", [n for n in LINES if is_part(n, LINES) or n not in FIRST])
def test_a_documented_command_composes(line, inside):
    _, _, module, *arguments = line.replace("<run folder>", "/path/to/run").split()
    if "-m" in arguments:  # the last of the values that it varies
        arguments = [re.sub(r"=.*,", "=", a) if "=[" not in a else a for a in arguments]
    arguments = [a.strip("'") for a in arguments if a != "-m"]
    result = inside(module.removeprefix("gsgan."), *arguments, "--cfg", "job")
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize(
    "line",
    [
        line if line in FIRST else pytest.param(line, marks=pytest.mark.slow)
        for line in LINES
        if not is_part(line, LINES)
    ],
)
def test_every_documented_command_runs(line, place, capture, inside, tmp_path, monkeypatch):
    if any(word in line for word in SIGNING):
        from make import write_face, write_hands

        capture = shutil.copytree(capture, tmp_path / "signing")
        write_hands(capture, 6)
        write_face(capture, 6)
        line = line.replace("/path/to/capture", str(capture))
    _, _, module, *arguments = place(line).split()
    name = module.removeprefix("gsgan.")
    if name == "train":
        if "-m" in arguments:
            arguments = shorter_sweep(arguments, tmp_path)
        arguments = tiny_training(arguments, capture)
    if name == "bench":
        arguments = tiny_bench(arguments, tmp_path, capture)
    if name == "fit":
        arguments += ["size.picture=32", "fit.points=200", "fit.surface_steps=2"]
        arguments += ["fit.sweeps=1", "shown=1", f"out={tmp_path / 'fit'}"]
    if name == "prepare":  # MediaPipe is not at hand: its output is given
        source = next(a for a in arguments if a.startswith("source=")).removeprefix("source=")
        arguments = [a for a in arguments if a != "setup=true"]
        arguments += [f"landmarks={source}/pose", f"masks={source}/masks"]
    if name == "view":
        monkeypatch.setattr("gsgan.view.server.Viewer.serve", lambda viewer: None)
    result = inside(name, *arguments)
    assert result.returncode == 0, result.stdout + result.stderr
