"""`gsgan.fit`: a capture in, landmarks that fit its masks out."""

from __future__ import annotations

import hashlib
import io
import json
from pathlib import Path
from typing import Any

import gsgan.compat  # noqa: F401  (must come before lightning)

# isort: split
import numpy as np
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gsgan.capture.dataset import write_npz
from gsgan.capture.writing import writing
from gsgan.console import make_console
from gsgan.data.datamodule import GsganData
from gsgan.data.files import read_arrays
from gsgan.data.formats.capture import CaptureReader, landmarks_path
from gsgan.devices import pick_device
from gsgan.errors import ConfigError
from gsgan.files import write_atomically
from gsgan.fitting.fitter import Agreement, Fitter
from gsgan.fitting.moments import Moments, make_fitter
from gsgan.fitting.picture import fit_picture
from gsgan.fitting.settings import Fit

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}


def run_fit(config: DictConfig, console: Console | None = None) -> Path:
    """Fits the landmarks of ``config.data`` to its masks and writes ``config.out``.

    A fit that was stopped goes on where it stood, from a hidden file beside ``out``.

    Returns:
        The written file.

    Raises:
        ConfigError, DataError: on what the user can put right.
    """
    console = console or make_console()
    out = _out(config)
    settings: Fit = instantiate(config.fit)
    data: GsganData = instantiate(config.data, _convert_="all")
    if not isinstance(data.reader, CaptureReader):
        raise ConfigError(
            "gsgan.fit moves the landmarks of a capture (data=capture); the skeletons of this "
            "format come from its body poses"
        )
    moments = Moments(data, pick_device(config.device))
    fitter = make_fitter(settings, moments, config.seed)
    source = landmarks_path(data.layout.root, data.reader.landmarks)
    key = _key(config, source)
    partial = out.with_name(f".{out.name}.fitting")
    _go_on(fitter, partial, key, console)
    _work(fitter, partial, key, console)
    joints = fitter.joints()
    before, after = (fitter.agreement(s) for s in (moments.skeletons, joints))
    moved = (joints - moments.skeletons).norm(dim=-1)
    fields = _fields(source, METRES[data.layout.meta.unit], moments, joints, moved)
    picture = fit_picture(fitter, moments.frames, data.layout.camera_names, joints, config.shown)
    with writing(out):
        write_atomically(out.with_suffix(".png"), picture)
    write_npz(out, **fields)
    partial.unlink(missing_ok=True)
    _tell(console, config, out, moments, before, after, moved[fitter.seen])
    return out


def _out(config: DictConfig) -> Path:
    if not config.out:
        raise ConfigError(
            "out is not set: give the file to write, e.g. out=/path/to/capture/landmarks3d_fit.npz"
        )
    out = Path(config.out).expanduser()
    if out.suffix != ".npz":
        raise ConfigError(f"out={config.out} must end in .npz")
    if out.exists() and not config.overwrite:
        raise ConfigError(f"out={config.out} is there already; overwrite=true replaces it")
    if not isinstance(config.shown, int) or config.shown < 1:
        raise ConfigError(f"shown must be a whole number of at least 1, got {config.shown!r}")
    return out


def _key(config: DictConfig, source: Path) -> str:
    """What a stopped fit must have in common with this one to go on."""
    whole = OmegaConf.to_container(config, resolve=True)
    assert isinstance(whole, dict)
    said = {name: whole[name] for name in ("data", "fit", "seed")}
    text = json.dumps(said, sort_keys=True, default=str).encode()
    return hashlib.sha256(text + source.read_bytes()).hexdigest()


def _go_on(fitter: Fitter, partial: Path, key: str, console: Console) -> None:
    if not partial.is_file():
        return
    try:
        state = torch.load(partial, map_location=fitter.start.device, weights_only=True)
        fits = state["key"] == key
        if fits:
            fitter.load_state_dict(state["fitter"])
    except Exception:  # a damaged file of an earlier fit: torch.load raises what it likes
        fits = False
    if fits:
        console.print(f"going on after {fitter.swept} of {fitter.settings.sweeps} sweeps")
    else:
        console.print("an earlier fit was of other settings or data: starting anew")


def _work(fitter: Fitter, partial: Path, key: str, console: Console) -> None:
    settings, frames = fitter.settings, len(fitter.start)
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
    with Progress(*columns, TimeRemainingColumn(), console=console, transient=True) as bar:
        task = bar.add_task("shape", total=settings.shape_steps, completed=fitter.shaped)
        while fitter.shaped < settings.shape_steps:
            fitter.shape_step()
            bar.advance(task)
        task = bar.add_task("joints", total=settings.sweeps * frames)
        bar.update(task, completed=fitter.swept * frames)
        while not fitter.done:
            fitter.sweep(lambda: bar.advance(task))
            stream = io.BytesIO()
            torch.save({"key": key, "fitter": fitter.state_dict()}, stream)
            with writing(partial):
                write_atomically(partial, stream.getvalue())


def _fields(
    source: Path, unit: float, moments: Moments, joints: torch.Tensor, moved: torch.Tensor
) -> dict[str, Any]:
    """The landmarks' file with moved joints; what was not seen or has no picture stays as it is."""
    kept = read_arrays(source, ("p", "conf", "frame_id", "names"))
    p = kept["p"].astype(np.float64)
    moves = np.full(p.shape[:2], np.nan)
    rows = {int(frame): row for row, frame in enumerate(kept["frame_id"])}
    new, seen = (
        joints.cpu().numpy().astype(np.float64) / unit,
        (moments.visibility > 0).cpu().numpy(),
    )
    for i, frame in enumerate(moments.frames):
        row = rows[frame]
        p[row, seen[i]] = new[i, seen[i]]
        moves[row, seen[i]] = moved[i].cpu().numpy()[seen[i]]
    return kept | {"p": p, "moved_m": moves, "fitted_to": np.array(", ".join(moments.cameras))}


def _tell(
    console: Console,
    config: DictConfig,
    out: Path,
    moments: Moments,
    before: Agreement,
    after: Agreement,
    moved: torch.Tensor,
) -> None:
    median, far = (float(moved.quantile(q)) for q in (0.5, 0.95)) if moved.numel() else (0.0, 0.0)
    lines = [
        f"{len(moments.frames)} frames, masks of {', '.join(moments.cameras)}: the shape's overlap "
        f"with them {before.iou:.3f} -> {after.iou:.3f}, alpha that is wrong {before.share:.3f} -> "
        f"{after.share:.3f} of the mask",
        f"joints moved {1000 * median:.0f} mm in the median, 95 % by less than {1000 * far:.0f} mm",
    ]
    if median > config.fit.noise:
        lines.append(
            "that is more than landmarks' noise (fit.noise): calibration or masks may be wrong; "
            "run gsgan.check"
        )
    lines += [
        f"{out} is ready; look at {out.with_suffix('.png')}, then",
        f"python -m gsgan.train data=capture data.root={moments.dataset.layout.root} "
        f"data.reader.landmarks={out.resolve()}",
    ]
    console.print("\n".join(lines), markup=False, highlight=False, soft_wrap=True)
