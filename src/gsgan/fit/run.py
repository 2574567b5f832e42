"""`gsgan.fit`: a capture in, the person's body and its pose in every frame out."""

from collections.abc import Sequence
from contextlib import ExitStack
from copy import copy
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock
from numpy.typing import NDArray
from rich.console import Console
from torch import Tensor

from gsgan.body.fingers import Fingers
from gsgan.body.shape import BodyShape, shape_body
from gsgan.body.solve import ON_HANDS, Solver
from gsgan.data.calibration import METRES
from gsgan.data.crop import PersonCrop
from gsgan.data.datamodule import GsganData
from gsgan.data.formats.capture import (
    LANDMARKS_FILE,
    POSES_FILE,
    SHAPE,
    CaptureReader,
)
from gsgan.data.scene_info import refuse_swapped_sides
from gsgan.data.validation import spans
from gsgan.fit.fitter import Fit, Fitter
from gsgan.fit.frames import MaskedFrames
from gsgan.fit.report import REPORT, fit_report, summary
from gsgan.fit.shape import fit_hands, fit_offsets, fit_shape
from gsgan.scene import BodyPose, cat
from gsgan.skeleton import MEDIAPIPE33, TEMPLATES
from gsgan.utils.config import CommandOptions
from gsgan.utils.console import make_console, progress, working
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.files import (
    read_json,
    write_atomically,
    write_json,
    write_npz,
    writing,
)
from gsgan.utils.tensors import pick_device

SIZE = 128  # pixels of the images that the fit before training uses
PERSON_MARGIN = 0.2  # metres around the person in the images of a fit
LOCK = ".body_fit.lock"
# frames whose poses are solved at once, which bounds memory
FRAMES_AT_ONCE = 500


@dataclass(frozen=True)
class FitOptions(CommandOptions):
    """The options of gsgan.fit: conf/fit.yaml."""

    data: GsganData
    fit: Fit
    out: str | None
    overwrite: bool
    seed: int
    device: str


def run_fit(options: FitOptions) -> Path:
    """Fits the body to a dataset and writes it into ``out``, or into the capture.

    Returns:
        The folder of the written files.

    Raises:
        ConfigError, DataError: on anything the user can correct.
    """
    return fit_body(
        options.data,
        options.fit,
        None if options.out is None else str(options.out),
        options.seed,
        pick_device(options.device),
        options.overwrite,
    )


def fit_before_training(
    data: GsganData, settings: Fit, device: torch.device
) -> None:
    """Fits the body of a capture that has no body poses, and writes it into the capture.

    One process of a run fits, and the others wait for its files. The data must be read again.

    Args:
        data: the capture, read as the run reads it.
        settings: of the fit.
        device: of the run.

    Raises:
        DataError: when the masks hold no person, or the folder is read-only.
    """
    root = data.layout.root
    # small images around the person
    seen = copy(data)
    seen.size = SIZE
    seen.crop = PersonCrop(margin=PERSON_MARGIN)
    with ExitStack() as stack:
        with writing(root):
            stack.enter_context(FileLock(root / LOCK))
        # Another process may have made the poses while this one waited.
        if not (root / POSES_FILE).exists():
            fit_body(seen, settings, device=device)


def refuse_other_fit(
    data: GsganData, settings: Fit, given: Sequence[str]
) -> None:
    """Refuses settings of a fit that the capture has already, made with other ones.

    Args:
        data: the capture.
        settings: as requested.
        given: the overrides of these settings on the command line.

    Raises:
        ConfigError: naming the command that fits again.
    """
    poses = data.layout.poses
    if not given or poses is None or not poses.fitted:
        return
    root = data.layout.root
    report = root / REPORT
    made = read_json(report).get("settings") if report.is_file() else None
    if made != asdict(settings):
        raise ConfigError(
            f"{' '.join(given)} changes nothing: {root} has a fit with other settings; python -m "
            f"gsgan.fit data=capture data.root={root} overwrite=true {' '.join(given)} makes it "
            "anew"
        )


def fit_body(
    data: GsganData,
    settings: Fit,
    out: str | None = None,
    seed: int = 0,
    device: torch.device | None = None,
    overwrite: bool = False,
) -> Path:
    """Fits the shape to the skeletons, solves the poses from them and registers them to the masks.

    Registered poses determine where on the body this person's landmarks are; hand landmarks, the
    size and place of the hands. With these all poses are solved again, and written unless the
    settings keep registered ones.

    Args:
        data: a capture.
        settings: of the registration.
        out: folder to write into; None for the capture's own.
        seed: of the order of frames and cameras.
        device: of the images; None for the CPU.
        overwrite: whether to replace the files of an earlier fit.

    Returns:
        The folder.
    """
    console = make_console()
    device = device or torch.device("cpu")

    # What would fail after minutes of work is refused first.
    if not isinstance(data.reader, CaptureReader):
        raise ConfigError(
            "gsgan.fit supports captures in the bring-your-own layout: data=capture"
        )
    layout = data.layout
    folder = layout.root if out is None else Path(out).expanduser()
    _make_folder(folder, overwrite)
    refuse_swapped_sides(layout, data.trained)

    # the frames with a person in their masks
    frames = _read_masks(data, settings, device, console)
    rows = torch.tensor([layout.frames.index(frame) for frame in frames.frames])

    # the shape and the poses by the skeletons
    with working(console, "solving shape and poses"):
        joints, visibility = _joints(data, data.trained)
        shape = fit_shape(joints, visibility)
        start = _solve_with_fingers(data, shape, frames.frames)

    # the poses by the masks, and with them the places of the landmarks
    fitter = Fitter(settings, frames, shape_body(shape), start, seed)
    fitted = _register(fitter, settings, console)
    with torch.no_grad():
        registered = fitted.to(torch.device("cpu"))
        shape = _refine_shape(data, shape, frames.frames, registered)

    # all poses by the skeletons again
    poses = {False: _solve_all(data, shape, console)}
    if layout.hands is not None:
        poses[True] = _solve_all(data, shape, console, hands=True)
    driven = poses[_by_hands(data)][rows].to(device)
    report = fit_report(fitter, shape_body(shape).to(device), driven, fitted)
    report["settings"] = asdict(settings)

    # the files, and what they say
    write_json(folder / REPORT, report)
    _write_body(
        folder=folder,
        data=data,
        frames=frames,
        shape=shape,
        poses=poses,
        rows=rows,
        kept=registered if _keeps(settings) else None,
    )
    lines = summary(report, folder, frames)
    console.print(
        "\n".join(lines), markup=False, highlight=False, soft_wrap=True
    )
    return folder


def _keeps(settings: Fit) -> bool:
    """Whether registered poses are kept, of all frames."""
    return settings.held_out or settings.keep


def _read_masks(
    data: GsganData, settings: Fit, device: torch.device, console: Console
) -> MaskedFrames:
    """The frames that are registered, with the progress of reading their masks."""
    with progress(console) as bars:
        frames = MaskedFrames(
            data,
            device,
            settings.min_mask,
            settings.held_out,
            max_frames=None if _keeps(settings) else settings.frames,
            max_cameras=settings.cameras,
            track=partial(bars.track, description="masks"),
        )
    if frames.left_out:
        console.print(
            f"{frames.left_out} images with empty masks, or nearly so, are left out"
        )
    return frames


def _register(fitter: Fitter, settings: Fit, console: Console) -> BodyPose:
    """The poses after all steps of the fit."""
    # The surface comes first, in the solved poses; surface and poses follow together.
    with progress(console) as bars:
        for _ in bars.track(
            range(settings.surface_steps), description="surface"
        ):
            fitter.surface_step()
        for _ in bars.track(range(settings.sweeps), description="poses"):
            fitter.sweep()
    with torch.no_grad():
        return fitter.pose()


def _make_folder(out: Path, overwrite: bool) -> None:
    """Makes the folder; fails before minutes of work if it cannot be written."""
    # An empty file shows whether the folder can be written.
    attempt = out / ".body_fit.try"
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        write_atomically(attempt, b"")
        attempt.unlink(missing_ok=True)  # another fit may have removed it
    # Poses are replaced only if a fit made them and overwrite is set.
    if (out / POSES_FILE).exists():
        if not (out / SHAPE).exists():
            raise ConfigError(
                f"{out / POSES_FILE} holds poses that gsgan.fit did not make; "
                "give another folder, out="
            )
        if not overwrite:
            raise ConfigError(
                f"{out / POSES_FILE} exists already; overwrite=true replaces it"
            )


def _write_body(
    folder: Path,
    data: GsganData,
    frames: MaskedFrames,
    shape: BodyShape,
    poses: dict[bool, BodyPose],
    rows: Tensor,
    kept: BodyPose | None,
) -> None:
    """Writes the shape, and the poses by 33 landmarks and, if there are hands, by these too.

    Registered poses ``kept`` replace those of ``rows``, except for the fingers: the hands are then
    where they are in the masks.
    """
    arrays: dict[str, NDArray[Any]] = {}

    # Translations are stored in the unit of the capture.
    fingers = _fingers(shape)
    unit = METRES[data.layout.meta.unit]
    for hands, solved in poses.items():
        theta = solved.theta.clone()
        transl = solved.transl.clone()
        # Registered poses replace solved ones, except for the fingers.
        if kept is not None:
            theta[rows] = kept.theta
            transl[rows] = kept.transl
            theta[:, fingers] = solved.theta[:, fingers]
        name = "_hands" if hands else ""
        arrays[f"theta{name}"] = theta.numpy()
        arrays[f"transl{name}"] = transl.numpy() / unit

    # The old poses are removed first: a fit that is killed here leaves no poses of another shape.
    with writing(folder / POSES_FILE):
        (folder / POSES_FILE).unlink(missing_ok=True)
    write_npz(folder / SHAPE, **shape.arrays())
    write_npz(
        folder / POSES_FILE,
        **arrays,
        frame_id=np.array(data.layout.frames),
        registered=np.array(() if kept is None else frames.frames, np.int64),
        fitted_to=np.array(frames.cameras),
    )


def _joints(
    data: GsganData, frames: Sequence[int], hands: bool = False
) -> tuple[Tensor, Tensor]:
    """Joints ``[F, 33, 3]`` metres and their visibility; 75 with hands, if the data has some."""
    # Landmarks of the body, with those of the hands where they are wanted.
    landmarks = data.layout.landmarks
    if hands and data.layout.hands is not None:
        landmarks = landmarks.with_hands(data.layout.hands)
    p = np.stack([landmarks.p[frame] for frame in frames])
    visibility = np.stack([landmarks.visibility[frame] for frame in frames])
    return torch.from_numpy(p).float(), torch.from_numpy(visibility).float()


def _solve(
    data: GsganData,
    shape: BodyShape,
    frames: Sequence[int],
    hands: bool = False,
) -> BodyPose:
    """The poses of the frames, solved from skeletons with or without hands."""
    try:
        with torch.no_grad():
            joints, visibility = _joints(data, frames, hands)
            return Solver(shape_body(shape)).solve(joints, visibility)
    except ValueError as error:
        names = f"items are the frames {spans(list(frames))} in order"
        raise DataError(
            f"{data.layout.root / LANDMARKS_FILE}: {error} ({names})"
        ) from None


def _solve_all(
    data: GsganData, shape: BodyShape, console: Console, hands: bool = False
) -> BodyPose:
    """The poses of all frames, block by block."""
    frames = data.layout.frames
    blocks = []
    with progress(console) as bars:
        # Blocks of frames bound the memory.
        starts = range(0, len(frames), FRAMES_AT_ONCE)
        for start in bars.track(starts, description="poses from skeletons"):
            block = frames[start : start + FRAMES_AT_ONCE]
            blocks.append(_solve(data, shape, block, hands=hands))
    return cat(blocks)


def _solve_with_fingers(
    data: GsganData, shape: BodyShape, frames: Sequence[int]
) -> BodyPose:
    """Poses by 33 landmarks, with the fingers that hand landmarks show."""
    # The fingers alone are taken from the poses by hand landmarks.
    solved = _solve(data, shape, frames)
    if _by_hands(data):
        fingers = _fingers(shape)
        by_hands = _solve(data, shape, frames, hands=True)
        solved.theta[:, fingers] = by_hands.theta[:, fingers]
    return solved


def _by_hands(data: GsganData) -> bool:
    """Whether the skeleton has hands and the data their landmarks."""
    return data.layout.hands is not None and bool(
        TEMPLATES[data.skeleton].palms
    )


def _fingers(shape: BodyShape) -> list[int]:
    names = shape_body(shape).joint_names
    return [i for i, name in enumerate(names) if name.startswith("finger")]


def _refine_shape(
    data: GsganData,
    shape: BodyShape,
    frames: Sequence[int],
    registered: BodyPose,
) -> BodyShape:
    """The shape with this person's landmarks in registered poses, and with the person's hands.

    Poses solved with it approximate the registered ones, except for differences that vary between
    frames.
    """
    # The offsets of the 33 landmarks in the registered poses.
    p, seen = _joints(data, frames)
    shape = replace(shape, offsets=fit_offsets(shape, registered, p, seen))
    if data.layout.hands is None:
        return shape

    # the hands, and the poses with them
    p, seen = _joints(data, frames, hands=True)
    shape = fit_hands(shape, _solve(data, shape, frames), p, seen)
    by_hands = _solve(data, shape, frames, hands=True)

    # the offsets of those of the 33 landmarks that are on placed hands
    body = len(MEDIAPIPE33.names)
    placed = Fingers.has_palms(seen[:, body:] > 0)
    used = torch.zeros(len(p), body)
    for side, rows in enumerate(ON_HANDS):
        used[:, rows] = seen[:, rows] * placed[:, [side]]
    offsets = fit_offsets(shape, by_hands, p[:, :body], used)
    return replace(shape, offsets=offsets)
