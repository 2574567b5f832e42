"""Writes the export that a config describes."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from rich.console import Console

from gsgan.export.card import card
from gsgan.export.hub import (
    CARD_FILE,
    PREVIEW,
    avatar_files,
    preview,
    refuse_missing_hub,
    upload,
)
from gsgan.export.motions import (
    BodyMotion,
    bvh_text,
    motion_glb,
    read_captured,
)
from gsgan.export.page import block, page, refuse_unsuitable
from gsgan.export.splats import (
    Splats,
    glb_bytes,
    ply_bytes,
    splat_bytes,
    splats_of,
    spz_bytes,
)
from gsgan.export.usd import refuse_missing_usd, usd_bytes
from gsgan.export.weights import safetensors_file
from gsgan.run.drive import (
    REST,
    Drive,
    MotionOptions,
    distil_run,
    drive_of,
    inputs_of,
)
from gsgan.run.runs import Run, RunReference
from gsgan.scene import BodyPose, cat
from gsgan.utils.checks import integer, one_of, positive
from gsgan.utils.config import CommandOptions
from gsgan.utils.console import make_console, track
from gsgan.utils.errors import ConfigError
from gsgan.utils.files import write_atomically, writing
from gsgan.utils.provenance import verify

# The ending of each format's files, or nothing for a folder; a model card lies beside each file.
ENDINGS = {
    "ply": ".ply",
    "splat": ".splat",
    "spz": ".spz",
    "gltf": ".glb",
    "usd": ".usdc",
    "onnx": ".onnx",
    "torch": ".pt2",
    "safetensors": ".safetensors",
    "html": ".html",
    "bin": ".bin",
    "bvh": ".bvh",
    "motion_glb": ".glb",
    "hub": "",
}
# formats that hold a motion and no avatar
MOTION_FORMATS = ("bvh", "motion_glb")
CARD = "MODEL_CARD.md"
PREVIEW_SIZE = 512  # pixels, of runs whose images have sizes of their own


@dataclass(frozen=True)
class ExportOptions(CommandOptions):
    """The options of gsgan.export: conf/export.yaml."""

    source: RunReference
    driven: MotionOptions
    capture: str | None
    format: str
    out: str | None
    overwrite: bool
    start: int
    frames: int | None
    fps: float
    pixels: int | None
    upload: str | None
    private: bool
    licence: str | None
    verify: str | None

    def run(self) -> Run:
        """The run, on the CPU: programs that are made there name no device."""
        return replace(self.source, device="cpu").load()


def export(options: ExportOptions) -> None:
    """Writes an export, and a model card beside it.

    Raises:
        ConfigError: when an option has an invalid value, or the output exists.
        DataError: when the run, the motion or the file to verify cannot be read.
    """
    console = make_console()

    def tell(line: str) -> None:
        console.print(line, markup=False, highlight=False, soft_wrap=True)

    # With `verify` nothing is exported: a file is read for its marks.
    if options.verify is not None:
        path = Path(options.verify).expanduser()
        problem = verify(path)
        state = (
            "marked as synthetic"
            if problem.synthetic
            else "not marked as synthetic"
        )
        tell(f"{path.name}: {state}")
        tell(problem.summary())
        return

    # Options are checked before the run is loaded.
    kind = one_of("format", options.format, tuple(ENDINGS))
    out = _place(options, kind)
    sequence = kind == "ply" and not out.suffix
    beside = _card_of(out, sequence)
    if beside.exists() and not options.overwrite:
        raise ConfigError(
            f"{beside} exists; give overwrite=true or another name"
        )
    _check_upload(options, kind)
    if kind == "usd":
        refuse_missing_usd()
    if kind in MOTION_FORMATS:
        motion = _motion(options, console)
        _write(out, bvh_text(motion) if kind == "bvh" else motion_glb(motion))
        tell(
            f"written: {out}, {len(motion.poses.theta)} frames at {motion.fps:g}"
        )
        return
    run = options.run()
    if kind == "hub":
        _hub(options, run, out, tell)
        return

    if kind in ("ply", "splat", "spz", "gltf", "usd"):
        _write_poses(options, run, out, console)

    # A page, or its content for a page of the user's own.
    elif kind in ("html", "bin"):
        title = out.name.split(".")[0]
        content = _block(options, run, title, tell)
        _write(out, content if kind == "bin" else page(content, title))
    else:
        _write(out, _program(options, run, kind))

    # The model card lies beside the file, or in the folder of a sequence.
    _write(beside, card(run, kind, out.name, options.licence))
    tell(f"written: {out}, {beside.name}")


def _write(path: Path, content: str | bytes) -> None:
    with writing(path):
        write_atomically(path, content)


def _write_poses(
    options: ExportOptions, run: Run, out: Path, console: Console
) -> None:
    """Writes Gaussians in one pose per file: one file, or a sequence of .ply files in a folder. A
    .usdc file has all poses of a motion."""
    # Without a motion a scene's file shows the rest pose.
    kind = options.format
    motion = options.driven
    if motion.motion is None and kind in ("gltf", "usd"):
        motion = replace(motion, motion=REST)
    drive = _poses(motion, options, run)
    console.print(drive.text, markup=False, highlight=False, soft_wrap=True)
    frames = track(range(len(drive.p)), "writing", console)
    if kind == "usd":
        poses = (_pose_frame(run, drive, i) for i in frames)
        fps = float(options.fps)
        _write(out, usd_bytes(poses, fps, run.proportions.up))
        return
    if out.suffix:
        _write(out, _splats(run, drive, 0, kind))
        return

    # Files are named by the numbers of their frames, after a prefix: SuperSplat plays such files as
    # a sequence.
    names = [f"frame{number:06d}.ply" for number in drive.numbers]
    for i in frames:
        _write(out / names[i], _splats(run, drive, i, kind))

    # A shorter sequence replaces a longer one: files of later frames are removed.
    if (out / CARD).is_file():
        with writing(out):
            for path in out.glob("frame" + "[0-9]" * 6 + ".ply"):
                if path.name not in names:
                    path.unlink()


def _card_of(out: Path, sequence: bool) -> Path:
    return out / CARD if sequence else out.with_name(f"{out.name}.{CARD}")


def _place(options: ExportOptions, kind: str) -> Path:
    """``out``, checked: a file of the format's ending, or a folder for a sequence of .ply files."""
    # A capture has motion, but no avatar.
    if options.capture is not None and kind not in MOTION_FORMATS:
        raise ConfigError(
            f"capture: format={kind} needs run=<folder>; a capture gives "
            f"{', '.join(MOTION_FORMATS)}"
        )

    # The name must say the format: a file with its ending, or a folder for .ply files.
    ending = ENDINGS[kind]
    places = {"ply": "a .ply file or a folder", "hub": "a folder"}
    place = places.get(kind, f"a {ending} file")
    if options.out is None:
        raise ConfigError(f"out is not set: format={kind} needs {place}")
    out = Path(options.out).expanduser()
    folder = kind == "hub" or (kind == "ply" and not out.suffix)
    if not folder and out.suffix.lower() != ending:
        raise ConfigError(f"out={out}: format={kind} needs {place}")

    # Nothing is overwritten unless the user says so.
    if out.exists() and out.is_dir() != folder:
        kinds = (
            "a file; expected a folder"
            if folder
            else "a folder; expected a file"
        )
        raise ConfigError(f"out={out} is {kinds}")
    if (
        out.exists()
        and not options.overwrite
        and (not folder or any(out.iterdir()))
    ):
        raise ConfigError(
            f"out={out} exists; give overwrite=true or another name"
        )
    return out


def _check_upload(options: ExportOptions, kind: str) -> None:
    """Refuses options of an upload that cannot be met, before anything is computed."""
    if options.upload is None:
        if options.private:
            raise ConfigError("private=true requires upload=<owner/name>")
        return
    if kind != "hub":
        raise ConfigError("upload requires format=hub")
    refuse_missing_hub(options.upload)


def _hub(
    options: ExportOptions, run: Run, out: Path, tell: Callable[[str], None]
) -> None:
    """Writes the folder of a shared avatar, and uploads it if the user asks for it."""
    # The preview shows the first pose of the motion; the rest pose needs no dataset.
    motion = options.driven
    if motion.motion is None:
        motion = replace(motion, motion=REST)
    drive = _poses(motion, options, run)
    tell(drive.text)
    name = options.upload or out.name
    files = avatar_files(run)
    files[CARD_FILE] = card(run, "hub", name, options.licence).encode()
    files[PREVIEW] = preview(
        run, drive, run.trained_as.image_size or PREVIEW_SIZE
    )
    for file, content in files.items():
        _write(out / file, content)
    tell(f"written: {out}, {', '.join(files)}")
    if options.upload is not None:
        address = upload(files, options.upload, bool(options.private))
        tell(f"uploaded: {address}")


def _block(
    options: ExportOptions,
    run: Run,
    name: str,
    tell: Callable[[str], None],
) -> bytes:
    """The content of a .bin file, and of a page; each motion is one of its own."""
    refuse_unsuitable(run.avatar)
    chosen = options.driven.motion or []
    if isinstance(chosen, str):
        chosen = [chosen]

    # Motions are named by their files.
    motions = {}
    for motion in chosen:
        drive = _poses(replace(options.driven, motion=motion), options, run)
        tell(drive.text)
        motions[Path(motion).stem] = drive, float(options.fps)
    return block(run, distil_run(options.driven, run), motions, name)


def _poses(motion: MotionOptions, options: ExportOptions, run: Run) -> Drive:
    """The frames to export; by default a held-out one."""
    # The whole motion; its length is known only now.
    drive = drive_of(motion, run, float(positive("fps", options.fps)))

    # Some of its frames, if the user asks for them.
    start = integer("start", options.start, 0)
    if start >= len(drive.p):
        raise ConfigError(
            f"start={start}: the motion has {len(drive.p)} frames"
        )
    end = (
        None
        if options.frames is None
        else start + integer("frames", options.frames, 1)
    )
    return drive.rows(np.arange(len(drive.p))[start:end])


@torch.no_grad()
def _motion(options: ExportOptions, console: Console) -> BodyMotion:
    """The body poses of a capture, or of the motion that drives a run."""
    fps = float(positive("fps", options.fps))
    if options.capture is not None:
        capture = Path(options.capture).expanduser()
        return read_captured(capture, options.source.data_smpl, fps)

    # The body that the avatar moves with, whose poses are those of the motion or solved.
    run = options.run()
    body = run.body
    if body is None:
        raise ConfigError(
            f"run={run.folder}: its avatar moves without a body; give capture=<folder>"
        )
    drive = _poses(options.driven, options, run)
    console.print(drive.text, markup=False, highlight=False, soft_wrap=True)
    poses = []
    for i in track(range(len(drive.p)), "posing", console):
        _, _, pose = inputs_of(run.avatar, drive, i)
        assert pose is not None
        poses.append(BodyPose(pose.theta.float(), pose.transl.float()))
    return BodyMotion(body, cat(poses), fps, run.proportions.up)


@torch.no_grad()
def _pose_frame(run: Run, drive: Drive, i: int) -> Splats:
    """The Gaussians of frame i."""
    p, visibility, body = inputs_of(run.avatar, drive, i)
    return splats_of(run.avatar, p, visibility > 0, body)


def _splats(run: Run, drive: Drive, i: int, kind: str) -> bytes:
    """The content of a .ply, .splat, .spz or .glb file of frame i."""
    splats = _pose_frame(run, drive, i)
    if kind == "gltf":
        return glb_bytes(splats, run.proportions.up)
    if kind == "splat":
        return splat_bytes(splats)
    if kind == "spz":
        antialias = run.avatar.accuracy.antialias
        return spz_bytes(splats, run.proportions.up, antialias)
    return ply_bytes(splats, run.avatar.accuracy.antialias)


def _program(options: ExportOptions, run: Run, kind: str) -> bytes:
    """The content of a .onnx, .pt2 or .safetensors file."""
    if kind == "safetensors":
        return safetensors_file(run)
    from gsgan.export.programs import onnx_program, torch_program

    # The other formats need the exporters of torch, which take long to import.
    if kind == "onnx":
        return onnx_program(run.avatar)
    side = integer(
        "pixels", options.pixels or run.trained_as.image_size or 512, 1
    )
    return torch_program(run.avatar, (side, side))
