"""`gsgan.fit`: a capture in, landmarks that fit its masks out."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.utils import instantiate
from numpy.typing import NDArray
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from gsgan import __version__
from gsgan.data.datamodule import GsganData
from gsgan.data.files import read_arrays
from gsgan.data.formats.capture import LANDMARKS, CaptureReader, landmarks_path
from gsgan.fit.fitter import Agreement, Fit, Fitter
from gsgan.fit.moments import Moments
from gsgan.fit.picture import fit_picture
from gsgan.prepare.work import progress, write_npz, writing
from gsgan.skeleton import MEDIAPIPE33
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError
from gsgan.utils.files import write_atomically
from gsgan.utils.tensors import pick_device

SMALL_FILES = ("cameras.json", "meta.json")
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
        raise ConfigError(
            "gsgan.fit moves the landmarks of a capture in the bring-your-own layout "
            "(data=capture); other formats are not supported"
        )
    layout = data.layout
    source = landmarks_path(layout.root, data.reader.landmarks)
    if out.resolve() in {source.resolve(), (layout.root / LANDMARKS).resolve()}:
        raise ConfigError(f"out={config.out} holds the landmarks themselves; give another name")
    original = read_arrays(source, ("p", "conf", "frame_id", "fitted_to"))
    device = pick_device(config.device)
    with progress(console) as bars:
        task = bars.add_task("masks", total=None)
        moments = Moments(data, device, settings.least_mask, lambda: bars.advance(task))
    notes = []
    if moments.left_out:
        notes.append(f"{moments.left_out} images with empty masks, or nearly so, are left out")
    if layout.poses is not None:
        notes.append(
            "the capture's body pose stays as it is; where G sits on the body (body_points), "
            "moved landmarks do not move it: effects.body_points=off trains on them"
        )
    _print(console, notes)
    partial, key = _partial(out), _key(config, source, moments)
    fitter = _resumed(settings, moments, config.seed, partial, key, console)
    _work(fitter, partial, key, console)
    joints = fitter.joints()
    before, after = (fitter.agreement(s) for s in (moments.skeletons, joints))
    moved = (joints - moments.skeletons).norm(dim=-1)
    write_npz(out, **_arrays(original, METRES[layout.meta.unit], moments, joints, moved))
    picture = fit_picture(fitter, layout.camera_names, joints, config.shown)
    with writing(out):
        write_atomically(out.with_suffix(".png"), picture)
    partial.unlink(missing_ok=True)
    _print(console, _summary(config, out, moments, before, after, moved[fitter.seen]))
    return out


def _print(console: Console, lines: list[str]) -> None:
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def _out(config: DictConfig) -> Path:
    if not config.out:
        raise ConfigError(
            "out is not set: give the file to write, e.g. out=/path/to/capture/landmarks3d_fit.npz"
        )
    if not str(config.out).endswith(".npz"):
        raise ConfigError(f"out={config.out} must end in .npz")
    if not isinstance(config.shown, int) or config.shown < 1:
        raise ConfigError(f"shown must be a whole number of at least 1, got {config.shown!r}")
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
    whole = OmegaConf.to_container(config, resolve=True)
    assert isinstance(whole, dict)
    content: list[Any] = [__version__, {name: whole[name] for name in ("data", "fit", "seed")}]
    for item in moments.dataset.items:
        files = [path.stat() for _, path in layout.mask_files(*item)]
        content.append([*item, *((file.st_size, file.st_mtime_ns) for file in files)])
    small = [file.read_bytes() for file in (source, *(layout.root / f for f in SMALL_FILES))]
    text = json.dumps(content, sort_keys=True, default=str).encode()
    return hashlib.sha256(b"".join([text, *small])).hexdigest()


def _resumed(
    settings: Fit, moments: Moments, seed: int, partial: Path, key: str, console: Console
) -> Fitter:
    """The fit as a stopped process left it, or a new one."""
    fitter = Fitter(settings, moments, seed)
    if not partial.is_file():
        return fitter
    try:
        state = torch.load(partial, map_location=moments.device, weights_only=True)
        if state["key"] == key:
            fitter.load_state_dict(state["fitter"])
            console.print(f"resuming after {fitter.swept} of {settings.sweeps} sweeps")
            return fitter
    except Exception:  # damaged: torch.load and load_state_dict raise many kinds
        pass
    console.print("an earlier fit had other settings or data: starting again")
    return Fitter(settings, moments, seed)


def _work(fitter: Fitter, partial: Path, key: str, console: Console) -> None:
    """All remaining steps; the state is saved after each sweep."""
    settings, frames = fitter.settings, len(fitter.start)
    with progress(console) as bars:
        task = bars.add_task("shape", total=settings.shape_steps, completed=fitter.shaped)
        while fitter.shaped < settings.shape_steps:
            fitter.shape_step()
            bars.advance(task)
        task = bars.add_task("joints", total=settings.sweeps * frames)
        bars.update(task, completed=fitter.swept * frames)
        while not fitter.done:
            fitter.sweep(lambda: bars.advance(task))
            stream = io.BytesIO()
            torch.save({"key": key, "fitter": fitter.state_dict()}, stream)
            with writing(partial):
                write_atomically(partial, stream.getvalue())


def _arrays(
    original: Mapping[str, NDArray[Any]],
    unit: float,
    moments: Moments,
    joints: torch.Tensor,
    moved: torch.Tensor,
) -> dict[str, Any]:
    """The landmarks' file with moved joints; those not seen or without image keep their place."""
    p = original["p"].astype(np.float64)
    distance = np.full(p.shape[:2], np.nan)
    row_of = {int(frame): row for row, frame in enumerate(original["frame_id"])}
    seen = (moments.visibility > 0).cpu().numpy()
    i, joint = np.nonzero(seen)
    row = np.array([row_of[frame] for frame in moments.frames])[i]
    p[row, joint] = joints.cpu().numpy().astype(np.float64)[i, joint] / unit
    distance[row, joint] = moved.cpu().numpy()[i, joint]
    earlier = original.get("fitted_to", np.array([], str)).tolist()
    return {
        **original,
        "p": p,
        "names": np.array(MEDIAPIPE33.names),
        "moved_m": distance,
        "fitted_to": np.array(sorted({*earlier, *moments.cameras})),
    }


def _summary(
    config: DictConfig,
    out: Path,
    moments: Moments,
    before: Agreement,
    after: Agreement,
    moved: torch.Tensor,
) -> list[str]:
    median, far = (float(moved.quantile(q)) for q in (0.5, 0.95)) if moved.numel() else (0.0, 0.0)
    lines = [
        f"{len(moments.frames)} frames, masks of {', '.join(moments.cameras)}: overlap (IoU) with "
        f"the fitted shape {before.iou:.3f} at the old joints, {after.iou:.3f} at the new; wrong "
        f"alpha {before.share:.3f} and {after.share:.3f} of the mask",
        f"joints moved {1000 * median:.0f} mm in the median, 95 % by less than {1000 * far:.0f} mm",
    ]
    if median > config.fit.noise:
        lines.append(
            "that is more than landmarks' noise (fit.noise): calibration or masks may be wrong; "
            "run gsgan.check"
        )
    root, name = moments.dataset.layout.root, out.resolve()
    if name.is_relative_to(root.resolve()):  # then the folder can be moved as a whole
        name = name.relative_to(root.resolve())
    return [
        *lines,
        f"{out} is ready; look at {out.with_suffix('.png')}, then, with this command's data keys,",
        f"python -m gsgan.train data=capture data.root={root} data.reader.landmarks={name}",
    ]
