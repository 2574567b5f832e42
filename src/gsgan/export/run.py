"""Writes the export that a config describes."""

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from omegaconf import DictConfig, open_dict
from rich.console import Console

from gsgan import __version__
from gsgan.export.motions import (
    BodyMotion,
    bvh_text,
    captured_motion,
    motion_glb,
)
from gsgan.export.page import block, page, refuse_unsuitable
from gsgan.export.splats import glb_bytes, ply_bytes, splats_of
from gsgan.metrics.names import FLOOR_VARIANT, VARIANTS
from gsgan.run.drive import (
    REST,
    Drive,
    distilled_of,
    drive_of,
    inputs_of,
    with_motion,
)
from gsgan.run.runs import Run
from gsgan.scene import BodyPose, cat
from gsgan.utils.checks import above, one_of, whole
from gsgan.utils.console import make_console, track
from gsgan.utils.errors import ConfigError
from gsgan.utils.files import write_atomically, writing
from gsgan.utils.pages import markdown
from gsgan.utils.provenance import verify

LINEAR = (
    "without its networks: Step I's colour, with residuals linear in the harmonics of each "
    "Gaussian's normal."
)
# What a model card says about the content of each format.
HOLDS = {
    "ply": "The avatar's Gaussians in one pose per file, in the convention of 3D Gaussian "
    "splatting. They show Step I's colour; the generator's image needs gsgan.",
    "gltf": "The avatar's Gaussians in one pose, as KHR_gaussian_splatting. They show Step I's "
    "colour; the generator's image needs gsgan.",
    "onnx": "Pose encoder and generator: images of the splats and the skeleton in, image and alpha "
    "out. Rasterisation is not part of it.",
    "torch": "The whole avatar as a program of `torch.export`: skeleton and camera in, image and "
    "alpha out. Import `gsgan.splat` before loading it.",
    "html": f"A page that renders the avatar in a browser, {LINEAR}",
    "bin": f"The avatar of a web page, for gsgan.js in a page of your own, {LINEAR}",
    "safetensors": "The weights, with the config as metadata: "
    "`gsgan.export.weights.load_weights(file)` gives the avatar.",
}
# Metrics of a model card, and their headings.
SCORES = {
    "psnr": "PSNR ↑",
    "ssim": "SSIM ↑",
    "lpips_vgg": "LPIPS-VGG ↓",
    "lpips_alex": "LPIPS-Alex ↓",
    "edge_f1": "edge F1 ↑",
}
USE = """\
Images of this one person in new poses and from new cameras, with the person's consent: sign
language, research, telepresence, film. Its images are synthetic: say so where they are shown
(`gsgan.render` writes it into the files' metadata).

Not intended for deceiving anyone about what the person did or said, or for identifying people.
Poses and cameras far from the training data give worse images than the scores suggest."""


def card(run: Run, kind: str, name: str, licence: str | None) -> str:
    """The text of a model card.

    Args:
        run: the avatar's.
        kind: a key of `HOLDS`.
        name: of the exported file or folder.
        licence: of the weights, or None if the user gave none.
    """
    facts = _read(run.folder / "facts.json")
    data = facts.get("data", {})

    # The card's header is read by hubs such as Hugging Face.
    head = {
        "license": licence or "other",
        "library_name": "gsgan",
        "tags": ["gaussian-splatting", "human-avatar", "synthetic-media"],
    }

    # How the avatar was trained; unknown facts are left out.
    identity = [data.get(key) for key in ("name", "root", "fingerprint")]
    about = {
        "data": " ".join(str(value) for value in identity if value),
        "training cameras": run.scene.n_train_cameras,
        "image size": run.stored.data.size,
        "protocol": facts.get("protocol") or "none",
        "model": facts.get("model"),
        "iterations": run.checkpoint["step"],
        "seed": run.stored.get("seed"),
        "gsgan": facts.get("version", __version__),
        "commit": facts.get("commit"),
    }
    known = []
    for key, value in about.items():
        if value not in (None, ""):
            known.append((key, str(value)))

    # Scores, and what makes them incomparable with others.
    scores = [_scores(run.folder)]
    scores += [f"- marked: {mark}" for mark in run.checkpoint.get("marks", [])]
    parts = [
        f"---\n{yaml.safe_dump(head, sort_keys=False)}---",
        f"# {name}\n\nOne person's avatar, trained with gsgan (GaussianGAN). {HOLDS[kind]}",
        f"## Data and training\n\n{markdown(('', ''), known)}",
        f"## Effects\n\n{markdown(('effect', '', 'why'), run.avatar.effects.rows())}",
        "## Scores on held-out images\n\n" + "\n\n".join(scores),
        f"## Intended use\n\n{USE}",
        "## Licence\n\n" + (licence or _licence(data.get("name"))),
    ]
    return "\n\n".join(parts) + "\n"


def _licence(data: str | None) -> str:
    if data == "synthetic":
        owner = (
            "The default person is a character under the MIT licence; weights trained on it are "
            "too."
        )
    else:
        owner = (
            "The weights show a person: that person and the owner of the training images decide "
            "what may be done with them. State it with licence=."
        )
    return f"gsgan itself is under Apache-2.0. {owner}"


def _scores(folder: Path) -> str:
    # One row per split and variant that a user of the file can render.
    table = []
    for split, variants in _read(folder / "metrics.json").items():
        for variant, scores in variants.items():
            if variant != FLOOR_VARIANT:
                numbers = [_number(scores.get(key)) for key in SCORES]
                table.append((split, VARIANTS[variant], *numbers))

    if not table:
        return "Not evaluated: run `python -m gsgan.evaluate` first."
    return markdown(("split", "", *SCORES.values()), table)


def _number(value: float | None) -> str:
    return "n/a" if value is None else f"{value:.4g}"


def _read(path: Path) -> dict[str, Any]:
    # A run that has not been evaluated lacks these files.
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


# The ending of each format's files; a model card lies beside each file.
ENDINGS = {
    "ply": ".ply",
    "gltf": ".glb",
    "onnx": ".onnx",
    "torch": ".pt2",
    "safetensors": ".safetensors",
    "html": ".html",
    "bin": ".bin",
    "bvh": ".bvh",
    "motion_glb": ".glb",
}
MOTIONS = ("bvh", "motion_glb")  # formats that hold a motion and no avatar
CARD = "MODEL_CARD.md"


def export_config(config: DictConfig) -> None:
    """Writes the export that a config describes, and a model card beside it.

    Raises:
        ConfigError: when an option has an invalid value, or the output exists.
        DataError: when the run, the motion or the file to verify cannot be read.
    """
    console = make_console()

    def tell(line: str) -> None:
        console.print(line, markup=False, highlight=False, soft_wrap=True)

    # With `verify` nothing is exported: a file is read for its marks.
    if config.verify is not None:
        path = Path(config.verify).expanduser()
        found = verify(path)
        state = (
            "marked as synthetic"
            if found.synthetic
            else "not marked as synthetic"
        )
        tell(f"{path.name}: {state}")
        tell(found.summary())
        return

    # Options are checked before the run is loaded. Programs are made on the CPU, so
    # that they name no device.
    kind = one_of("format", config.format, tuple(ENDINGS))
    out = _place(config, kind)
    sequence = not out.suffix
    with open_dict(config):
        config.device = "cpu"
    if kind in MOTIONS:
        motion = _motion(config, console)
        _write(out, bvh_text(motion) if kind == "bvh" else motion_glb(motion))
        tell(
            f"written: {out}, {len(motion.poses.theta)} frames at {motion.fps:g}"
        )
        return
    run = Run.load(config)

    # Gaussians in one pose per file; a glTF file without a motion shows the rest pose.
    if kind in ("ply", "gltf"):
        rest = config.motion is None and kind == "gltf"
        drive = _poses(with_motion(config, REST) if rest else config, run)
        tell(drive.text)
        numbers = range(len(drive.p)) if sequence else range(1)
        for i in track(numbers, "writing", console):
            name = (
                out / f"{drive.numbers[i]:06d}{ENDINGS[kind]}"
                if sequence
                else out
            )
            _write(name, _splats(run, drive, i, kind))

        # A shorter sequence replaces a longer one: files of later frames are removed.
        if sequence and (out / CARD).is_file():
            kept = {f"{number:06d}.ply" for number in drive.numbers}
            with writing(out):
                for path in out.glob("[0-9]" * 6 + ".ply"):
                    if path.name not in kept:
                        path.unlink()

    # A page, or its content for a page of the user's own.
    elif kind in ("html", "bin"):
        title = out.name.split(".")[0]
        content = _block(config, run, title, tell)
        _write(out, content if kind == "bin" else page(content, title))
    else:
        _write(out, _program(config, run, kind))

    # The model card lies beside the file, or in the folder of a sequence.
    beside = out / CARD if sequence else out.with_name(f"{out.stem}.{CARD}")
    _write(beside, card(run, kind, out.name, config.licence))
    tell(f"written: {out}, {beside.name}")


def _write(path: Path, content: str | bytes) -> None:
    with writing(path):
        write_atomically(path, content)


def _place(config: DictConfig, kind: str) -> Path:
    """``out``, checked: a file of the format's ending, or a folder for a sequence of .ply files."""
    # A capture has motion, but no avatar.
    if config.capture is not None and kind not in MOTIONS:
        raise ConfigError(
            f"capture: format={kind} needs run=<folder>; a capture gives {', '.join(MOTIONS)}"
        )

    # The name must say the format: a file with its ending, or a folder for .ply files.
    ending = ENDINGS[kind]
    folders = " or a folder" if kind == "ply" else ""
    if config.out is None:
        raise ConfigError(f"out is not set: give out=<file>{ending}{folders}")
    out = Path(config.out).expanduser()
    if out.suffix.lower() != ending and (out.suffix or kind != "ply"):
        raise ConfigError(
            f"out={out}: format={kind} needs a {ending} file{folders}"
        )

    # Nothing is overwritten unless the user says so.
    folder = not out.suffix
    if out.exists() and out.is_dir() != folder:
        found = (
            "a file; expected a folder"
            if folder
            else "a folder; expected a file"
        )
        raise ConfigError(f"out={out} is {found}")
    if (
        out.exists()
        and not config.overwrite
        and (not folder or any(out.iterdir()))
    ):
        raise ConfigError(
            f"out={out} exists; give overwrite=true or another name"
        )
    return out


def _block(
    config: DictConfig,
    run: Run,
    name: str,
    tell: Callable[[str], None],
) -> bytes:
    """The content of a .bin file, and of a page; each motion is one of its own."""
    refuse_unsuitable(run.avatar)
    chosen = config.motion or ()
    if isinstance(chosen, str):
        chosen = [chosen]

    # Motions are named by their files.
    motions = {}
    for motion in chosen:
        drive = _poses(with_motion(config, str(motion)), run)
        tell(drive.text)
        motions[Path(motion).stem] = drive, float(config.fps)
    return block(run, distilled_of(config, run), motions, name)


def _poses(config: DictConfig, run: Run) -> Drive:
    """The frames to export; by default a held-out one."""
    # The whole motion; its length is known only now.
    drive = drive_of(config, run, float(above("fps", config.fps)))

    # Some of its frames, if the user asks for them.
    start = whole("start", config.start, 0)
    if start >= len(drive.p):
        raise ConfigError(
            f"start={start}: the motion has {len(drive.p)} frames"
        )
    end = (
        None
        if config.frames is None
        else start + whole("frames", config.frames, 1)
    )
    return drive.rows(np.arange(len(drive.p))[start:end])


@torch.no_grad()
def _motion(config: DictConfig, console: Console) -> BodyMotion:
    """The body poses of a capture, or of the motion that drives a run."""
    fps = float(above("fps", config.fps))
    if config.capture is not None:
        capture = Path(config.capture).expanduser()
        return captured_motion(capture, config.data_smpl, fps)

    # The body that the avatar moves with, whose poses are those of the motion or solved.
    run = Run.load(config)
    body = run.body
    if body is None:
        raise ConfigError(
            f"run={run.folder}: its avatar moves without a body; give capture=<folder>"
        )
    drive = _poses(config, run)
    console.print(drive.text, markup=False, highlight=False, soft_wrap=True)
    poses = []
    for i in track(range(len(drive.p)), "posing", console):
        _, _, pose = inputs_of(run.avatar, drive, i)
        assert pose is not None
        poses.append(BodyPose(pose.theta.float(), pose.transl.float()))
    return BodyMotion(body, cat(poses), fps, run.proportions.up)


@torch.no_grad()
def _splats(run: Run, drive: Drive, i: int, kind: str) -> bytes:
    """The content of a .ply or .glb file of frame i."""
    p, visibility, body = inputs_of(run.avatar, drive, i)
    splats = splats_of(run.avatar, p, visibility > 0, body)
    if kind == "gltf":
        return glb_bytes(splats, run.proportions.up)
    return ply_bytes(splats, run.avatar.accuracy.antialias)


def _program(config: DictConfig, run: Run, kind: str) -> bytes:
    """The content of a .onnx, .pt2 or .safetensors file."""
    if kind == "safetensors":
        from gsgan.export.weights import weights_bytes

        # The scene as plain values, with the fields that this version reads.
        facts = run.checkpoint | {"scene": asdict(run.scene)}
        return weights_bytes(run.folder, run.avatar, facts)
    from gsgan.export.programs import onnx_program, torch_program

    # The other formats need the exporters of torch, which take long to import.
    if kind == "onnx":
        return onnx_program(run.avatar)
    side = whole("pixels", config.pixels or run.stored.data.size or 512, 1)
    return torch_program(run.avatar, (side, side))
