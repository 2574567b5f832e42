"""Every command of the README and the docs runs: as written, but tiny.

A line whose arguments another line of the command has too is composed, not run. Lines that are not
in a newcomer's first pages are composed, and run with the slow tests. `tests/test_examples.py` runs
those of docs/examples/.
"""

import re
import runpy
import shutil
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from commands import ROOT, TINY

# Settings of a GPU or of several processes: one kind of machine, and one process, runs the tests.
ELSEWHERE = ("trainer=gpu", "trainer=ddp", "trainer=ddp_cpu")
SMALL_BENCH = {
    "speed": [
        "size=tiny",
        "frames=2",
        "warmup=1",
        "poses=2",
        "data.root=/path/to/capture",
    ],
    "trade_off": [
        "settings.accuracies=[draft]",
        "settings.scales=[0.5]",
        "settings.backends=[]",
        "settings.precisions=[]",
        "settings.windows=[]",
        "repeats=1",
        "images=1",
    ],
    "raster": [
        "repeats=1",
        "gaussians=[300]",
        "channels=[3]",
        "sizes=[32]",
        "windows=1",
        "window=16",
    ],
}


# These need hands, or a face too.
SIGNING = (
    "skeleton=holistic",
    "33_hands",
    "sign_demo",
    "paper_slp",
    "data=synthetic",
)
FEW = {
    "segmentation": 2,
    "step_one": 2,
    "step_two": 4,
    "discriminator_start": 1,
    "epoch": 4,
}


FIRST = [
    ROOT / "README.md",
    *(ROOT / f"docs/{n}.md" for n in ("quickstart", "data", "train")),
]


def documented(pages: list[Path]) -> list[str]:
    """Every ``python -m gsgan.…`` and ``python scripts/…`` of the pages, once."""
    text = "\n".join(page.read_text() for page in pages)
    blocks = re.findall(r"```bash\n(.*?)```", text, flags=re.DOTALL)
    lines = [
        line.split("#")[0].strip()
        for block in blocks
        for line in block.splitlines()
    ]
    return sorted(
        {
            x
            for x in lines
            if x.startswith(("python -m gsgan.", "python scripts/"))
        }
    )


def is_part(line: str, lines: list[str]) -> bool:
    """Whether another line has all words of this one."""
    return any(set(line.split()) < set(other.split()) for other in lines)


@pytest.fixture(scope="session")
def model_file(shared):
    """A model file like SMPL's or SMPL-X's, of the default person, by kind."""
    from writers.smpl import write_smpl

    def run(kind: str) -> Path:
        suffix = "pkl" if kind == "smpl" else "npz"
        return shared(
            f"{kind}.{suffix}", lambda path: write_smpl(path, kind=kind)
        )

    return run


@pytest.fixture
def place(capture, run, bare, on_body, model_file, tmp_path_factory):
    """Puts real, tiny files in the place of a documented line's placeholders."""

    def folder() -> Path:
        return tmp_path_factory.mktemp("documented")

    def zju() -> Path:
        from writers import zju
        from writers.common import make_subject

        return zju.write_original(
            folder() / "CoreView_377", make_subject(model_file("smpl"))
        )

    def rig(name: str) -> Path:
        from writers.avatarrex import write_avatarrex
        from writers.smplx_rig import smplx_subject
        from writers.thuman4 import write_thuman4

        write = write_thuman4 if name == "subject00" else write_avatarrex
        return write(folder() / name, smplx_subject(model_file("smplx")))

    def take() -> Path:
        from writers.common import make_subject
        from writers.easymocap import write_easymocap

        return write_easymocap(
            folder() / "take", make_subject(model_file("smpl"))
        )

    def videos() -> Path:
        from capture_scenes import write_project

        return write_project(folder() / "videos")

    def video() -> Path:
        from one_person import film

        return film(folder() / "one_video")

    def predictions() -> Path:
        import cv2

        from gsgan.data.datamodule import GsganData

        root, data = folder() / "predictions", GsganData(str(capture))
        for split in data.eval_names:
            dataset = data.dataset(split)
            for i, (camera, frame) in enumerate(dataset.items):
                path = root / split / camera / f"{frame:06d}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                picture = (
                    (dataset[i].image[0] * 255)
                    .round()
                    .byte()
                    .permute(1, 2, 0)
                    .numpy()
                )
                cv2.imwrite(str(path), picture[..., ::-1])
        return root

    def another_run(name: str) -> Path:
        return Path(shutil.copytree(run, folder() / name))

    def moving(name: str) -> Path:
        from conventions import write_bvh
        from mannequin import choreography, mannequin

        person = mannequin()
        return write_bvh(
            folder() / name, person, choreography(person).at(np.ones(2)), 1 / 30
        )

    def rendered() -> Path:
        from PIL import Image

        from gsgan.utils.provenance import png_bytes

        path = folder() / "000000.png"
        path.write_bytes(png_bytes(Image.new("RGB", (8, 8))))
        return path

    def sign(name: str) -> Path:
        import pose_format
        from make import skeletons
        from pose_format.numpy import NumPyPoseBody
        from pose_format.pose_header import (
            PoseHeader,
            PoseHeaderComponent,
            PoseHeaderDimensions,
        )

        from gsgan.skeleton import MEDIAPIPE33

        p = skeletons(4)[:, None][..., [0, 2, 1]] * [1, -1, 1]  # y down
        points = (
            "POSE_WORLD_LANDMARKS",
            [n.upper() for n in MEDIAPIPE33.names],
        )
        part = PoseHeaderComponent(*points, [(0, 1)], [(255, 0, 0)], "XYZC")
        header = PoseHeader(0.1, PoseHeaderDimensions(640, 480, 0), [part])
        path = folder() / name
        with path.open("wb") as stream:
            body = NumPyPoseBody(25, p, np.ones(p.shape[:3]))
            pose_format.Pose(header, body).write(stream)
        return path

    makers: dict[str, Callable[[], Path | str]] = {
        "gsgan.render run=<run folder>": lambda: f"gsgan.render run={bare}",
        "run=<run folder> format=html": lambda: f"run={on_body()} format=html",
        "/path/to/dance.bvh": lambda: moving("dance.bvh"),
        "/path/to/walk.bvh": lambda: moving("walk.bvh"),
        **{
            f"/path/to/sign_{i}.pose": partial(sign, f"sign_{i}.pose")
            for i in (1, 2, 3)
        },
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
        "/path/to/me.mp4": video,
        "/path/to/predictions": predictions,
        "/path/to/sweep": lambda: run,
        "data.test_frames=300-399": lambda: "data.test_frames=4-5",
        "runs=[runs/study/*/on/*]": lambda: f"runs=[{run.parent}]",
        "runs=runs/study_512": lambda: f"runs={run.parent}",
        "runs=runs/study": lambda: f"runs={run.parent}",
    }

    def fill(line: str) -> str:
        for text, make in makers.items():
            if text in line:
                line = line.replace(text, str(make()))
        assert "/path/to" not in line, (
            f"no stand-in for a placeholder of: {line}"
        )
        return line

    return fill


def tiny_training(arguments: list[str], capture: Path) -> list[str]:
    given = [
        a for a in arguments if a != "experiment=demo" and a not in ELSEWHERE
    ]
    # the tiny capture has a pose
    given = [a for a in given if not a.startswith("data.source.")]
    if not any(a.startswith("data=") for a in given):
        given.append("data=capture")
    given += [
        t for t in TINY if not t.startswith("data=") and not fixed(given, t)
    ]
    if not any(a.startswith("data.root=") for a in given):
        given.append(f"data.root={capture}")
    # a page is of a body, which the skeletons of the tiny capture fit better
    if "experiment=one_camera" in given:
        given.append("effects.body_points=on")
    # three cameras stand in for 24
    if {"experiment=paper", "data=thuman4"} <= set(given):
        given += ["protocol.test_cameras=[cam02]", "protocol.test_frames=2-3"]
        given += ["protocol.train_frames=0-1"]
    return given + [
        f"training.schedule.{name}={value}" for name, value in FEW.items()
    ]


def shorter_sweep(arguments: list[str], folder: Path) -> list[str]:
    """The last of the values that it varies."""
    given = [re.sub(r"=.*,", "=", a) if "=[" not in a else a for a in arguments]
    return [
        *given,
        f"hydra.sweep.dir={folder / 'sweep'}",
        "hydra.sweep.subdir=${hydra.job.num}",
    ]


def fixed(given: list[str], option: str) -> bool:
    """Whether a protocol says already what the option would say."""
    protocol = any(a.startswith("protocol=") for a in given)
    return protocol and option.startswith(("data.size", "data.crop"))


def tiny_bench(name: str, arguments: list[str], capture: Path) -> list[str]:
    large = {"repeats", "gaussians", "sizes", "size"}
    given = [a.strip("'") for a in arguments if a.split("=")[0] not in large]
    small = (
        w.replace("/path/to/capture", str(capture)) for w in SMALL_BENCH[name]
    )
    return [*given, *small]


LINES = documented([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
QUICK = set(documented(FIRST))
WHOLE = [line for line in LINES if not is_part(line, LINES)]


@pytest.fixture
def execute(inside, tmp_path, monkeypatch, capfd):
    """Runs a documented line, ``python -m gsgan.…`` or ``python scripts/…``, in this process."""

    def run(line: str, arguments: list[str]):
        program = line.split()[1]
        if program == "-m":
            return inside(line.split()[2].removeprefix("gsgan."), *arguments)
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [program, *arguments])
        monkeypatch.syspath_prepend(str((ROOT / program).parent))
        code = 0
        try:
            runpy.run_path(str(ROOT / program), run_name="__main__")
        except SystemExit as end:
            code = end.code or 0
        out, err = capfd.readouterr()
        return SimpleNamespace(returncode=code, stdout=out, stderr=err)

    return run


def arguments_of(line: str) -> list[str]:
    words = line.split()
    return words[3:] if words[1] == "-m" else words[2:]


@pytest.mark.parametrize(
    "line", [x for x in LINES if x not in WHOLE or x not in QUICK]
)
def test_a_documented_command_composes(line, execute):
    arguments = arguments_of(line.replace("<run folder>", "/path/to/run"))
    if "-m" in arguments:  # the last of the values that it varies
        arguments = [
            re.sub(r"=.*,", "=", a) if "=[" not in a else a for a in arguments
        ]
    arguments = [a.strip("'") for a in arguments if a != "-m"]
    result = execute(line, [*arguments, "--cfg", "job"])
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize(
    "line",
    [
        x if x in QUICK else pytest.param(x, marks=pytest.mark.slow)
        for x in WHOLE
    ],
)
def test_every_documented_command_runs(
    line, place, capture, execute, tmp_path, monkeypatch
):
    if any(word in line for word in SIGNING):
        from make import write_face, write_hands

        capture = shutil.copytree(capture, tmp_path / "signing")
        write_hands(capture, 6)
        write_face(capture, 6)
        line = line.replace("/path/to/capture", str(capture))
    # The tiny run is of a capture, which has no source: it is scored on a folder.
    line = line.replace(
        "+other_capture.source.motion=far", "other_capture=/path/to/capture"
    )
    line = place(line)
    name, arguments = (
        line.split()[2 if " -m gsgan." in line else 1],
        arguments_of(line),
    )
    if name == "gsgan.train":
        if "-m" in arguments:
            arguments = shorter_sweep(arguments, tmp_path)
        arguments = tiny_training(arguments, capture)
    if name == "gsgan.bench":
        arguments = [
            arguments[0],
            *tiny_bench(arguments[0], arguments[1:], capture),
        ]
    if name.startswith("scripts/bench/"):
        arguments = tiny_bench(Path(name).stem, arguments, capture)
    if name == "gsgan.demo":
        arguments += ["frames=2", "pixels=64"]
    if name == "gsgan.fit":
        arguments += ["size.image=32", "fit.points=200", "fit.surface_steps=2"]
        arguments += ["fit.sweeps=1", f"out={tmp_path / 'fit'}"]
    if name == "gsgan.prepare":  # MediaPipe is not at hand: its output is given
        source = next(
            a for a in arguments if a.startswith("source=")
        ).removeprefix("source=")
        arguments = [a for a in arguments if a != "setup=true"]
        if source.endswith(".avi"):
            arguments += [
                f"landmarks={Path(source).parent}/landmarks",
                "hands=false",
            ]
            source = str(Path(source).parent)
        else:
            arguments += [f"landmarks={source}/pose"]
        arguments += [f"masks={source}/masks"]
    if name == "gsgan.view":
        monkeypatch.setattr(
            "gsgan.view.server.Viewer.serve", lambda viewer: None
        )
    result = execute(line, arguments)
    assert result.returncode == 0, result.stdout + result.stderr
