"""`gsgan.fit`: a capture in, landmarks that fit its masks out."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from hydra.utils import instantiate
from numpy.typing import NDArray
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from torch import Tensor

from gsgan import __version__
from gsgan.check.overlays import caption
from gsgan.data.datamodule import GsganData
from gsgan.data.files import read_arrays
from gsgan.data.formats.capture import LANDMARKS, CaptureReader, landmarks_path
from gsgan.fit.fitter import Fit, Fitter
from gsgan.fit.moments import Moments
from gsgan.prepare.pictures import sampled
from gsgan.prepare.work import progress, write_npz, writing
from gsgan.scene import Frame
from gsgan.skeleton import MEDIAPIPE33
from gsgan.utils.checks import whole
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError
from gsgan.utils.files import write_atomically
from gsgan.utils.tensors import pick_device

SMALL_FILES = ("cameras.json", "meta.json")
TILE = 300  # pixels
GREEN, ORANGE, BLUE = (60, 200, 60), (255, 140, 0), (60, 140, 255)
BAR = (70, 70, 70)
LEGEND = "green: mask   orange: the shape before   blue: after"
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}


def run_fit(config: DictConfig) -> Path:
    """Fits the landmarks of ``config.data`` to its masks and writes ``config.out``.

    A fit that was stopped resumes from a hidden file beside ``out``.

    Returns:
        The written file.

    Raises:
        ConfigError, DataError: on anything the user can correct.
    """
    console = make_console()
    out = _out(config)
    settings: Fit = instantiate(config.fit)
    data: GsganData = instantiate(config.data, _convert_="all")
    if not isinstance(data.reader, CaptureReader):
        raise ConfigError("gsgan.fit supports captures in the bring-your-own layout: data=capture")
    layout = data.layout
    source = landmarks_path(layout.root, data.reader.landmarks)
    if out.resolve() in {source.resolve(), (layout.root / LANDMARKS).resolve()}:
        raise ConfigError(f"out={config.out} holds the landmarks themselves; give another name")
    original = read_arrays(source, ("p", "conf", "frame_id", "fitted_to"))
    device = pick_device(config.device)
    with console.status("reading masks"):
        moments = Moments(data, device, settings.least_mask)
    if moments.left_out:
        console.print(f"{moments.left_out} images with empty masks, or nearly so, are left out")
    if layout.poses is not None:
        console.print("the capture's body pose stays: effects.body_points=off trains without it")
    partial, key = _partial(out), _key(config, source, moments)
    fitter = _fitted(settings, moments, config.seed, partial, key, console)
    joints = fitter.joints()
    write_npz(out, **_arrays(original, METRES[layout.meta.unit], moments, joints))
    picture = fit_picture(fitter, layout.camera_names, joints, config.shown)
    with writing(out):
        write_atomically(out.with_suffix(".png"), picture)
    partial.unlink(missing_ok=True)
    lines = _summary(config, out, fitter, joints)
    console.print("\n".join(lines), markup=False, highlight=False, soft_wrap=True)
    return out


def _out(config: DictConfig) -> Path:
    if not config.out:
        raise ConfigError("out is not set: give out=/path/to/capture/landmarks3d_fit.npz")
    if not str(config.out).endswith(".npz"):
        raise ConfigError(f"out={config.out} must end in .npz")
    whole("shown", config.shown, 1)
    out = Path(str(config.out)).expanduser()
    attempt = out.with_name(f".{out.name}.try")
    with writing(out):  # before an hour's work, not after
        write_atomically(attempt, b"")
        attempt.unlink()
        existing = [file for file in (out, out.with_suffix(".png")) if file.exists()]
    stopped = _partial(out).exists()  # perhaps between the two files
    if existing and not config.overwrite and not stopped:
        raise ConfigError(f"{existing[0]} exists already; overwrite=true replaces it")
    return out


def _partial(out: Path) -> Path:
    """The state of a stopped fit."""
    return out.with_name(f".{out.name}.fitting")


def _key(config: DictConfig, source: Path, moments: Moments) -> str:
    """Digest of everything that a stopped fit must share with this one to be resumed."""
    layout = moments.dataset.layout
    parts = [OmegaConf.to_container(part, resolve=True) for part in (config.data, config.fit)]
    content: list[Any] = [__version__, config.seed, parts]
    for item in moments.dataset.items:
        files = [path.stat() for _, path in layout.mask_files(*item)]
        content.append([*item, *((file.st_size, file.st_mtime_ns) for file in files)])
    small = [file.read_bytes() for file in (source, *(layout.root / f for f in SMALL_FILES))]
    text = json.dumps(content, sort_keys=True, default=str).encode()
    return hashlib.sha256(b"".join([text, *small])).hexdigest()


def _fitted(
    settings: Fit, moments: Moments, seed: int, partial: Path, key: str, console: Console
) -> Fitter:
    """The fit after all steps that a stopped process left; the state is saved after each sweep."""
    fitter = Fitter(settings, moments, seed)
    if partial.is_file():
        try:
            state = torch.load(partial, map_location=moments.device, weights_only=True)
            if state["key"] != key:
                raise ValueError
            fitter.load_state_dict(state["fitter"])
            console.print(f"resuming after {fitter.swept} of {settings.sweeps} sweeps")
        except Exception:  # of another fit, or damaged: torch raises many kinds
            console.print("an earlier fit had other settings or data: starting again")
            fitter = Fitter(settings, moments, seed)
    with progress(console) as bars:
        task = bars.add_task("shape", total=settings.shape_steps, completed=fitter.shaped)
        while fitter.shaped < settings.shape_steps:
            fitter.shape_step()
            bars.advance(task)
        task = bars.add_task("joints", total=settings.sweeps, completed=fitter.swept)
        while fitter.swept < settings.sweeps:
            fitter.sweep()
            bars.advance(task)
            stream = io.BytesIO()
            torch.save({"key": key, "fitter": fitter.state_dict()}, stream)
            with writing(partial):
                write_atomically(partial, stream.getvalue())
    return fitter


def _arrays(
    original: Mapping[str, NDArray[Any]], unit: float, moments: Moments, joints: Tensor
) -> dict[str, Any]:
    """The landmarks' file with moved joints; those not seen or without image keep their place."""
    p = original["p"].astype(np.float64)
    distance = np.full(p.shape[:2], np.nan)
    row_of = {int(frame): row for row, frame in enumerate(original["frame_id"])}
    seen = (moments.visibility > 0).cpu().numpy()
    i, joint = np.nonzero(seen)
    row = np.array([row_of[frame] for frame in moments.frames])[i]
    p[row, joint] = joints.cpu().numpy().astype(np.float64)[i, joint] / unit
    moved = (joints - moments.skeletons).norm(dim=-1)
    distance[row, joint] = moved.cpu().numpy()[i, joint]
    earlier = original.get("fitted_to", np.array([], str)).tolist()
    return {
        **original,
        "p": p,
        "names": np.array(MEDIAPIPE33.names),
        "moved_m": distance,
        "fitted_to": np.array(sorted({*earlier, *moments.cameras})),
    }


def _summary(config: DictConfig, out: Path, fitter: Fitter, joints: Tensor) -> list[str]:
    moments = fitter.moments
    before, after = (fitter.agreement(s) for s in (moments.skeletons, joints))
    moved = (joints - moments.skeletons).norm(dim=-1)[fitter.seen]
    median, far = (float(moved.quantile(q)) for q in (0.5, 0.95)) if moved.numel() else (0.0, 0.0)
    lines = [
        f"{len(moments.frames)} frames, masks of {', '.join(moments.cameras)}: overlap (IoU) with "
        f"the fitted shape {before.iou:.3f} at the old joints, {after.iou:.3f} at the new; wrong "
        f"alpha {before.share:.3f} and {after.share:.3f} of the mask",
        f"joints moved {1000 * median:.0f} mm in the median, 95 % by less than {1000 * far:.0f} mm",
    ]
    if median > config.fit.noise:
        lines.append("that is more than fit.noise: calibration or masks may be wrong")
    root, name = moments.dataset.layout.root, out.resolve()
    if name.is_relative_to(root.resolve()):  # then the folder can be moved as a whole
        name = name.relative_to(root.resolve())
    return [
        *lines,
        f"{out} is ready; look at {out.with_suffix('.png')}, then, with this command's data keys,",
        f"python -m gsgan.train data=capture data.root={root} data.reader.landmarks={name}",
    ]


@torch.no_grad()
def fit_picture(fitter: Fitter, names: Sequence[str], joints: Tensor, shown: int) -> bytes:
    """A PNG: evenly spaced frames as rows, cameras as columns.

    Args:
        fitter: after the fit.
        names: of all cameras, in the order of `camera_index`.
        joints: ``[F, J, 3]`` the fitted skeletons.
        shown: rows, at most.
    """
    moments = fitter.moments
    rows = {
        i: {int(frame.camera_index): frame for frame in moments.pictures(i)}
        for i in sampled(len(moments.frames), shown)
    }
    columns = sorted(set().union(*rows.values()))
    lines = []
    for i, row in rows.items():
        tiles = [
            caption(
                _tile(fitter, i, row.get(camera), joints[i]),
                f"{names[camera]}  frame {moments.frames[i]}",
                BAR,
            )
            for camera in columns
        ]
        lines.append(np.concatenate(tiles, axis=1))
    sheet = caption(np.concatenate(lines), LEGEND, BAR)
    return cv2.imencode(".png", sheet[..., ::-1])[1].tobytes()


def _tile(fitter: Fitter, i: int, frame: Frame | None, after: Tensor) -> NDArray[np.uint8]:
    tile = np.zeros((TILE, TILE, 3), np.uint8)
    if frame is None:
        return tile
    image = (_large(frame.image[0].permute(1, 2, 0)).clip(0, 1) * 255).astype(np.uint8)
    tile[: image.shape[0], : image.shape[1]] = image
    before, fitted = (fitter.alpha(i, p, frame) for p in (fitter.start[i], after))
    for alpha, colour in ((frame.mask, GREEN), (before, ORANGE), (fitted, BLUE)):
        inside = (_large(alpha[0, 0]) > 0.5).astype(np.uint8)
        lines = cv2.findContours(inside, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
        cv2.drawContours(tile, lines, -1, colour, 1, cv2.LINE_AA)
    return tile


def _large(values: Tensor) -> NDArray[np.float32]:
    """Values ``[H, W, ...]`` resized so that the longer side has `TILE` pixels."""
    array = values.detach().to("cpu", torch.float32).numpy()
    scale = TILE / max(array.shape[:2])
    size = [max(1, round(scale * side)) for side in array.shape[1::-1]]
    return cv2.resize(array, size, interpolation=cv2.INTER_LINEAR).astype(np.float32, copy=False)
