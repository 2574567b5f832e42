"""`gsgan.fit`: a capture in, the person's body and its pose in every frame out."""

from __future__ import annotations

import copy
import hashlib
import io
import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from hydra.utils import instantiate
from numpy.typing import NDArray
from omegaconf import DictConfig
from rich.console import Console
from torch import Tensor

from gsgan import __version__
from gsgan.body import Body
from gsgan.body.fingers import Fingers
from gsgan.body.measure import fit_hands, fit_offsets, fit_shape
from gsgan.body.shape import BodyShape, shaped_body
from gsgan.body.solve import ON_HANDS, Solver
from gsgan.data.calibration.find import METRES
from gsgan.data.checks import spans
from gsgan.data.crop import PersonCrop
from gsgan.data.datamodule import GsganData
from gsgan.data.formats.capture import LANDMARKS, POSES, SHAPE, CaptureReader
from gsgan.fit.fitter import Fit, Fitter
from gsgan.fit.moments import Moments
from gsgan.prepare.pictures import sampled
from gsgan.scene import BodyPose, Frame
from gsgan.skeleton import MEDIAPIPE33, TEMPLATES
from gsgan.utils.checks import whole
from gsgan.utils.console import make_console, progress
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.files import write_atomically, write_json, write_npz, writing
from gsgan.utils.images import caption
from gsgan.utils.tensors import pick_device

REPORT, SHEET, STOPPED = "body_fit.json", "body_fit.png", ".body_fit.stopped"
PICTURE, MARGIN = 128, 0.2  # pixels; metres round the person
TILE = 300  # pixels
GREEN, ORANGE, BLUE = (60, 200, 60), (255, 140, 0), (60, 140, 255)
BAR = (70, 70, 70)
LEGEND = "green: mask   orange: the body solved from the skeleton   blue: registered to the masks"
WORST = 5  # joints and frames named in the summary


def run_fit(config: DictConfig) -> Path:
    """Fits the body to ``config.data`` and writes it into ``config.out``, or into the capture.

    Returns:
        The folder of the written files.

    Raises:
        ConfigError, DataError: on anything the user can correct.
    """
    whole("shown", config.shown, 1)
    settings: Fit = instantiate(config.fit)
    data: GsganData = instantiate(config.data, _convert_="all")
    device, out = pick_device(config.device), None if config.out is None else str(config.out)
    return fit_body(data, settings, out, config.seed, device, config.shown, config.overwrite)


def fit_before_training(data: GsganData, settings: DictConfig) -> GsganData:
    """Fits the body of a capture that has no body poses.

    Args:
        data: the capture.
        settings: the config group ``fit``.

    Returns:
        The data, which reads the capture again, with the new poses.

    Raises:
        DataError: when the masks hold no person, or the folder is read-only.
    """
    seen = GsganData(
        root=str(data.layout.root),
        reader=data.reader,
        protocol=data.protocol,
        size=PICTURE,
        crop=PersonCrop(margin=MARGIN),
        skeleton=data.skeleton,
        **data.split_keys,
    )
    fit_body(seen, instantiate(settings), device=pick_device("auto"))
    for name, attribute in vars(GsganData).items():
        if isinstance(attribute, cached_property):
            vars(data).pop(name, None)
    return data


def fit_body(
    data: GsganData,
    settings: Fit,
    out: str | None = None,
    seed: int = 0,
    device: torch.device | None = None,
    shown: int = 4,
    overwrite: bool = False,
) -> Path:
    """Shape from skeletons, poses solved from skeletons, then registered to the masks.

    The registered poses determine where on the body this person's landmarks are; hand landmarks,
    the size and place of the hands. With these all poses are solved again, and written unless the
    settings keep registered ones. A fit that was stopped resumes from a hidden file in ``out``.

    Args:
        data: a capture.
        settings: of the registration.
        out: folder to write into; None for the capture's own.
        seed: of the order of frames and cameras.
        device: of the images; None for the CPU.
        shown: frames in the overlay.
        overwrite: whether files of an earlier fit are replaced.

    Returns:
        The folder.
    """
    console, device = make_console(), device or torch.device("cpu")
    if not isinstance(data.reader, CaptureReader):
        raise ConfigError("gsgan.fit supports captures in the bring-your-own layout: data=capture")
    layout = data.layout
    folder = _folder(layout.root if out is None else Path(out).expanduser(), overwrite)
    with console.status("reading masks"):
        moments = Moments(data, device, settings.least_mask, settings.held_out)
    if moments.left_out:
        console.print(f"{moments.left_out} images with empty masks, or nearly so, are left out")
    with console.status("solving poses"):
        shape = fit_shape(*_joints(data, data.trained))
        solved = _solve(data, shape, layout.frames)
        if _by_hands(data):
            fingers = _fingers(shape)
            by_hands = _solve(data, shape, layout.frames, hands=True)
            solved.theta[:, fingers] = by_hands.theta[:, fingers]
    rows = torch.tensor([layout.frames.index(frame) for frame in moments.frames])
    start = BodyPose(solved.theta[rows], solved.transl[rows])
    fitter = Fitter(settings, moments, shaped_body(shape), start, seed)
    _fitted(fitter, folder / STOPPED, _key(fitter, shape, seed), console)
    with torch.no_grad():
        found = fitter.pose()
        registered = found.to(torch.device("cpu"))
        shape = _refined(data, shape, moments.frames, registered)
    poses = {False: _solve(data, shape, layout.frames)}
    if layout.hands is not None:
        poses[True] = _solve(data, shape, layout.frames, hands=True)
    driven = poses[_by_hands(data)]
    again = BodyPose(driven.theta[rows], driven.transl[rows]).to(device)
    report = _report(fitter, shaped_body(shape).to(device), again, found)
    kept = registered if settings.held_out or settings.keep else None
    unit = METRES[layout.meta.unit]
    with writing(folder / SHEET):
        write_atomically(folder / SHEET, fit_picture(fitter, layout.camera_names, found, shown))
    write_json(folder / REPORT, report)
    with writing(folder / POSES):  # a fit that is killed here leaves no poses of another shape
        (folder / POSES).unlink(missing_ok=True)
    write_npz(folder / SHAPE, **shape.arrays())
    write_npz(
        folder / POSES,
        **_with_and_without_hands(poses, _fingers(shape), rows, kept, unit),
        frame_id=np.array(layout.frames),
        registered=np.array(() if kept is None else moments.frames, np.int64),
        fitted_to=np.array(moments.cameras),
    )
    (folder / STOPPED).unlink(missing_ok=True)
    lines = _summary(report, folder, moments)
    console.print("\n".join(lines), markup=False, highlight=False, soft_wrap=True)
    return folder


def _folder(out: Path, overwrite: bool) -> Path:
    attempt = out / f"{STOPPED}.try"
    with writing(out):  # before minutes of work, not after
        out.mkdir(parents=True, exist_ok=True)
        write_atomically(attempt, b"")
        attempt.unlink(missing_ok=True)  # runs in parallel try alike
    if (out / POSES).exists():
        if not (out / SHAPE).exists():
            raise ConfigError(
                f"{out / POSES} holds poses that gsgan.fit did not make; give another folder, out="
            )
        if not overwrite:
            raise ConfigError(f"{out / POSES} exists already; overwrite=true replaces it")
    return out


def _with_and_without_hands(
    poses: dict[bool, BodyPose],
    fingers: list[int],
    rows: Tensor,
    kept: BodyPose | None,
    unit: float,
) -> dict[str, NDArray[Any]]:
    """The arrays of ``poses`` by 33 landmarks and, where there are hands, by these too. Registered
    poses ``kept`` replace those of ``rows``, but for the fingers: their hands are where the masks
    have them."""
    found: dict[str, NDArray[Any]] = {}
    for hands, solved in poses.items():
        theta, transl = solved.theta.clone(), solved.transl.clone()
        if kept is not None:
            theta[rows], transl[rows] = kept.theta, kept.transl
            theta[:, fingers] = solved.theta[:, fingers]
        name = "_hands" if hands else ""
        found |= {f"theta{name}": theta.numpy(), f"transl{name}": transl.numpy() / unit}
    return found


def _joints(data: GsganData, frames: Sequence[int], hands: bool = False) -> tuple[Tensor, Tensor]:
    """Joints ``[F, 33, 3]`` metres and their visibility; 75 with hands, where the data has some."""
    landmarks = data.layout.landmarks
    if hands and data.layout.hands is not None:
        landmarks = landmarks.with_hands(data.layout.hands)
    p, visibility = (
        torch.from_numpy(np.stack([part[f] for f in frames])).float()
        for part in (landmarks.p, landmarks.visibility)
    )
    return p, visibility


def _solve(
    data: GsganData, shape: BodyShape, frames: Sequence[int], hands: bool = False
) -> BodyPose:
    """Poses by skeletons with or without hands."""
    try:
        with torch.no_grad():
            return Solver(shaped_body(shape)).solve(*_joints(data, frames, hands))
    except ValueError as error:
        names = f"items are the frames {spans(list(frames))} in order"
        raise DataError(f"{data.layout.root / LANDMARKS}: {error} ({names})") from None


def _by_hands(data: GsganData) -> bool:
    return data.layout.hands is not None and bool(TEMPLATES[data.skeleton].palms)


def _fingers(shape: BodyShape) -> list[int]:
    return [i for i, n in enumerate(shaped_body(shape).joint_names) if n.startswith("finger")]


def _refined(
    data: GsganData, shape: BodyShape, frames: Sequence[int], registered: BodyPose
) -> BodyShape:
    """The shape with the landmarks that this person has in registered poses, so that solving
    approximates registration, up to what varies between frames; and with the person's hands."""
    offsets = fit_offsets(shape, registered, *_joints(data, frames))
    shape = replace(shape, offsets=offsets)
    if data.layout.hands is None:
        return shape
    p, seen = _joints(data, frames, hands=True)
    shape = fit_hands(shape, _solve(data, shape, frames), p, seen)
    by_hands = _solve(data, shape, frames, hands=True)
    used = torch.zeros(len(p), len(offsets))  # the landmarks that 33 have of placed hands
    for side, rows in enumerate(ON_HANDS):
        used[:, rows] = seen[:, rows] * Fingers.placed(seen[:, len(offsets) :] > 0)[:, [side]]
    return replace(shape, offsets=fit_offsets(shape, by_hands, p[:, : len(offsets)], used))


def _key(fitter: Fitter, shape: BodyShape, seed: int) -> str:
    """Digest of everything that a stopped fit must share with this one to be resumed."""
    dataset = fitter.moments.dataset
    content: list[Any] = [__version__, seed, asdict(fitter.settings), dataset.size]
    for item in dataset.items:
        files = [path.stat() for _, path in dataset.layout.mask_files(*item)]
        content.append([*item, *((file.st_size, file.st_mtime_ns) for file in files)])
    text = json.dumps(content, sort_keys=True, default=str).encode()
    tensors = [shape.flat(), fitter.start.theta, fitter.start.transl]
    numbers = [x.cpu().numpy().tobytes() for x in (*tensors, fitter.moments.skeletons)]
    cameras = (dataset.layout.root / "cameras.json").read_bytes()
    return hashlib.sha256(b"".join([text, *numbers, cameras])).hexdigest()


def _fitted(fitter: Fitter, stopped: Path, key: str, console: Console) -> None:
    """Runs the remaining steps of a fit; the state is saved after each sweep."""
    settings = fitter.settings
    if stopped.is_file():
        fresh = copy.deepcopy(fitter.state_dict())  # loading copies into the same tensors
        try:
            state = torch.load(stopped, map_location=fitter.moments.device, weights_only=True)
            if state["key"] != key:
                raise ValueError
            fitter.load_state_dict(state["fitter"])
            console.print(f"resuming after {fitter.swept} of {settings.sweeps} sweeps")
        except Exception:  # of another fit, or damaged: torch raises many kinds
            console.print("an earlier fit had other settings or data: starting again")
            fitter.load_state_dict(fresh)
    with progress(console) as bars:
        task = bars.add_task("surface", total=settings.surface_steps, completed=fitter.shaped)
        while fitter.shaped < settings.surface_steps:
            fitter.surface_step()
            bars.advance(task)
        task = bars.add_task("poses", total=settings.sweeps, completed=fitter.swept)
        while fitter.swept < settings.sweeps:
            fitter.sweep()
            bars.advance(task)
            stream = io.BytesIO()
            torch.save({"key": key, "fitter": fitter.state_dict()}, stream)
            with writing(stopped):
                write_atomically(stopped, stream.getvalue())


@torch.no_grad()
def _report(fitter: Fitter, body: Body, driven: BodyPose, found: BodyPose) -> dict[str, Any]:
    """Residuals in mm per joint and frame, and overlaps with the masks: of poses solved before the
    registration, registered, and solved after it on ``body``, as held-out frames are. All overlaps
    are of the registered surface."""
    moments, before = fitter.moments, fitter.surface.body
    seen = moments.visibility > 0
    report: dict[str, Any] = {"frames": {}, "joints": {}}
    off, iou = {}, {}
    for name, pose in (("solved", fitter.start), ("registered", found), ("driven", driven)):
        posed = (body if name == "driven" else before).posed_landmarks(pose)
        apart = (posed - moments.skeletons).norm(dim=-1)
        off[name] = torch.where(seen, 1000 * apart, torch.nan)
        iou[name] = fitter.overlap(pose)
        report[name] = {
            "residual_mm": float(off[name].nanmedian()),
            "iou": float(iou[name].nanmean()),
        }
    for j, joint in enumerate(MEDIAPIPE33.names):
        report["joints"][joint] = {n: float(x[:, j].nanmedian()) for n, x in off.items()}
    for i, frame in enumerate(moments.frames):
        residual = {n: float(x[i].nanmedian()) for n, x in off.items()}
        overlap = {n: float(x[i]) for n, x in iou.items()}
        report["frames"][str(frame)] = {"residual_mm": residual, "iou": overlap}
    turned = (found.theta - fitter.start.theta).norm(dim=-1).rad2deg()
    report["turned_degrees"] = float(turned.quantile(0.95))
    return report


def _summary(report: dict[str, Any], folder: Path, moments: Moments) -> list[str]:
    before, after = report["solved"], report["registered"]
    joints = sorted(report["joints"].items(), key=lambda x: -np.nan_to_num(x[1]["registered"]))
    frames = sorted(
        report["frames"].items(), key=lambda x: np.nan_to_num(x[1]["iou"]["registered"])
    )
    worst = ", ".join(f"{n} {x['registered']:.0f}" for n, x in joints[:WORST])
    least = ", ".join(f"{n} {x['iou']['registered']:.3f}" for n, x in frames[:WORST])
    return [
        f"{len(moments.frames)} frames, masks of {', '.join(moments.cameras)}: overlap (IoU) with "
        f"the body's surface {before['iou']:.3f} solved from the skeletons, {after['iou']:.3f} "
        f"registered, {report['driven']['iou']:.3f} solved again; least in frames {least}",
        f"landmarks {before['residual_mm']:.0f} mm from the skeleton's solved, "
        f"{after['residual_mm']:.0f} mm registered (medians); most: {worst}",
        f"{folder} has {SHAPE} and {POSES}; look at {folder / SHEET}, {REPORT} has all numbers",
    ]


@torch.no_grad()
def fit_picture(fitter: Fitter, names: Sequence[str], found: BodyPose, shown: int) -> bytes:
    """A PNG: evenly spaced frames as rows, cameras as columns.

    Args:
        fitter: after the fit.
        names: of all cameras, in the order of `camera_index`.
        found: F registered poses.
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
        people = [
            fitter.surface.posed(BodyPose(pose.theta[i][None], pose.transl[i][None]))[0]
            for pose in (fitter.start, found)
        ]
        tiles = []
        for camera in columns:
            alphas = [] if (frame := row.get(camera)) is None else [frame.mask]
            alphas += [fitter.surface.alpha(g, frame.camera) for g in people if frame is not None]
            title = f"{names[camera]}  frame {moments.frames[i]}"
            tiles.append(caption(_tile(frame, alphas), title, BAR))
        lines.append(np.concatenate(tiles, axis=1))
    sheet = caption(np.concatenate(lines), LEGEND, BAR)
    return cv2.imencode(".png", sheet[..., ::-1])[1].tobytes()


def _tile(frame: Frame | None, alphas: Sequence[Tensor]) -> NDArray[np.uint8]:
    tile = np.zeros((TILE, TILE, 3), np.uint8)
    if frame is None:
        return tile
    image = (_large(frame.image[0].permute(1, 2, 0)).clip(0, 1) * 255).astype(np.uint8)
    tile[: image.shape[0], : image.shape[1]] = image
    for alpha, colour in zip(alphas, (GREEN, ORANGE, BLUE), strict=True):
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
