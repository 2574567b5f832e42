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
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gsgan import __version__
from gsgan.data.datamodule import GsganData
from gsgan.data.files import read_arrays
from gsgan.data.formats.capture import LANDMARKS, CaptureReader, landmarks_path
from gsgan.fit.fitter import Agreement, Fitter
from gsgan.fit.moments import Moments, make_fitter
from gsgan.fit.picture import fit_picture
from gsgan.fit.settings import Fit
from gsgan.prepare.dataset import write_npz
from gsgan.prepare.work import writing
from gsgan.skeleton import MEDIAPIPE33
from gsgan.utils.console import make_console
from gsgan.utils.devices import pick_device
from gsgan.utils.errors import ConfigError
from gsgan.utils.files import write_atomically

SMALL_FILES = ("cameras.json", "meta.json")
COLUMNS = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
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
            "gsgan.fit moves the landmarks of a capture in the bring-your-own layout "
            "(data=capture), not of other formats"
        )
    layout = data.layout
    source = landmarks_path(layout.root, data.reader.landmarks)
    if out.resolve() in {source.resolve(), (layout.root / LANDMARKS).resolve()}:
        raise ConfigError(f"out={config.out} holds the landmarks themselves; give another name")
    kept = read_arrays(source, ("p", "conf", "frame_id", "fitted_to"))
    moments = _moments(data, settings, pick_device(config.device), console)
    partial = partial_file(out)
    key = _key(config, source, moments)
    fitter = _begun(settings, moments, config.seed, partial, key, console)
    _work(fitter, partial, key, console)
    joints = fitter.joints()
    before, after = (fitter.agreement(s) for s in (moments.skeletons, joints))
    moved = (joints - moments.skeletons).norm(dim=-1)
    write_npz(out, **_fields(kept, METRES[layout.meta.unit], moments, joints, moved))
    picture = fit_picture(fitter, moments.frames, layout.camera_names, joints, config.shown)
    with writing(out):
        write_atomically(out.with_suffix(".png"), picture)
    partial.unlink(missing_ok=True)
    _tell(console, config, out, moments, before, after, moved[fitter.seen])
    return out


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
    with writing(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        there = [file for file in (out, out.with_suffix(".png")) if file.exists()]
        write_atomically(out.with_name(f".{out.name}.try"), b"")  # before an hour's work, not after
        out.with_name(f".{out.name}.try").unlink()
    begun = partial_file(out).exists()  # a fit of this name was stopped, perhaps between its files
    if there and not config.overwrite and not begun:
        raise ConfigError(f"{there[0]} is there already; overwrite=true replaces it")
    return out


def partial_file(out: Path) -> Path:
    """Where a stopped fit waits."""
    return out.with_name(f".{out.name}.fitting")


def _moments(data: GsganData, settings: Fit, device: torch.device, console: Console) -> Moments:
    with Progress(*COLUMNS, TimeRemainingColumn(), console=console, transient=True) as bar:
        task = bar.add_task("masks", total=None)
        moments = Moments(data, device, settings.least_mask, lambda: bar.advance(task))
    notes = []
    if moments.left_out:
        notes.append(f"{moments.left_out} pictures with empty masks, or nearly so, are left out")
    if data.layout.poses is not None:
        notes.append(
            "the capture's body pose stays as it is; where G sits on the body (body_points), "
            "moved landmarks do not move it: effects.body_points=off trains on them"
        )
    for note in notes:
        console.print(note, markup=False, highlight=False, soft_wrap=True)
    return moments


def _key(config: DictConfig, source: Path, moments: Moments) -> str:
    """What a stopped fit must have in common with this one to go on."""
    layout = moments.dataset.layout
    whole = OmegaConf.to_container(config, resolve=True)
    assert isinstance(whole, dict)
    said: list[Any] = [__version__, {name: whole[name] for name in ("data", "fit", "seed")}]
    for item in moments.dataset.items:
        files = [path.stat() for _, path in layout.mask_files(*item)]
        said.append([*item, *((file.st_size, file.st_mtime_ns) for file in files)])
    held = [file.read_bytes() for file in (source, *(layout.root / f for f in SMALL_FILES))]
    text = json.dumps(said, sort_keys=True, default=str).encode()
    return hashlib.sha256(b"".join([text, *held])).hexdigest()


def _begun(
    settings: Fit, moments: Moments, seed: int, partial: Path, key: str, console: Console
) -> Fitter:
    """The fit as an earlier process left it, or a new one."""
    if partial.is_file():
        fitter = make_fitter(settings, moments, seed)
        try:
            state = torch.load(partial, map_location=moments.device, weights_only=True)
            if state["key"] == key:
                fitter.load_state_dict(state["fitter"])
                console.print(f"going on after {fitter.swept} of {settings.sweeps} sweeps")
                return fitter
        except Exception:  # a damaged file: torch.load and load_state_dict raise what they like
            pass
        console.print("an earlier fit was of other settings or data: starting anew")
    return make_fitter(settings, moments, seed)


def _work(fitter: Fitter, partial: Path, key: str, console: Console) -> None:
    settings, frames = fitter.settings, len(fitter.start)
    with Progress(*COLUMNS, TimeRemainingColumn(), console=console, transient=True) as bar:
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
    kept: Mapping[str, NDArray[Any]],
    unit: float,
    moments: Moments,
    joints: torch.Tensor,
    moved: torch.Tensor,
) -> dict[str, Any]:
    """The landmarks' file with moved joints; what was not seen or has no picture stays as it is."""
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
    names = np.array(MEDIAPIPE33.names)
    before = kept.get(
        "fitted_to", np.array([], str)
    ).tolist()  # of a fit that this one goes on from
    told = {"moved_m": moves, "fitted_to": np.array(sorted({*before, *moments.cameras}))}
    return {**kept, "p": p, "names": names, **told}


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
        f"{len(moments.frames)} frames, masks of {', '.join(moments.cameras)}: they overlap with "
        f"the fitted shape by {before.iou:.3f} where its joints are the old ones, {after.iou:.3f} "
        f"with the new; alpha that is wrong: {before.share:.3f}, {after.share:.3f} of the mask",
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
    lines += [
        f"{out} is ready; look at {out.with_suffix('.png')}, then, with this command's data keys,",
        f"python -m gsgan.train data=capture data.root={root} data.reader.landmarks={name}",
    ]
    console.print("\n".join(lines), markup=False, highlight=False, soft_wrap=True)
