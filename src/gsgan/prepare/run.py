"""`gsgan.prepare`: calibrated, synchronised videos in, a capture for `data=capture` out."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console

from gsgan.data.cameras import CameraEntry
from gsgan.data.formats.capture import read_capture
from gsgan.data.joints import BODY
from gsgan.prepare.dataset import is_there, standing_axis, write_small_files
from gsgan.prepare.doubts import (
    doubts_about_detections,
    doubts_about_pictures,
    doubts_about_solution,
    doubts_about_sources,
)
from gsgan.prepare.inputs import (
    Inputs,
    frame_rate,
    in_parallel,
    read_inputs,
    read_landmarks,
    read_masks,
    run_tool,
)
from gsgan.prepare.landmarks import Detections
from gsgan.prepare.options import MEDIAPIPE, Options
from gsgan.prepare.pictures import Written, write_pictures
from gsgan.prepare.progress import Bars
from gsgan.prepare.refine import camera_moves
from gsgan.prepare.report import Outcome, write_report
from gsgan.prepare.rig import Rig, known
from gsgan.prepare.solving import STAGE_VERSION, Solved, solve_detections, take_points
from gsgan.prepare.work import Work, digest
from gsgan.prepare.writing import writing
from gsgan.utils.errors import DataError


def prepare(options: Options, console: Console) -> Path:
    """Makes the dataset ``options.out``, or leaves the same one that is already there alone.

    Returns:
        Its folder.

    Raises:
        DataError: on whatever is wrong with the pictures, calibration, landmarks or masks.
        ConfigError: on options that do not fit.
    """
    out = options.folder("out")
    inputs = read_inputs(options)
    key = digest([STAGE_VERSION, options.record(), _fingerprint(options, inputs)])
    if is_there(out, key, options.overwrite):
        console.print(f"{out} is there already, made from the same pictures and settings")
        return out
    work = Work.beside(out)
    names = list(inputs.sources)
    found, masked = run_tool(options, inputs.sources, work, console.print)
    masks = read_masks(options, names, masked)
    if options.landmarks3d is None:
        detections = read_landmarks(options, names, found)
        solved = solve_detections(options, inputs, detections, work, console)
    else:
        detections, solved = {}, take_points(options, inputs)
    cameras = solved.solution.rig.entries(inputs.cameras)
    root = work.place("dataset", [key, STAGE_VERSION])
    written = _write_pictures(options, inputs, cameras, masks, solved, root)
    outcome = _write_rest(options, inputs, cameras, detections, solved, written, root, key)
    write_report(root, outcome, options, console)
    _forget_parts(root)
    _read_back(root)
    _publish(root, out)
    work.forget_others()
    if not options.keep_work:
        work.remove()
    told = (
        f"{out} is ready; look at {out / 'report.html'}, then",
        f"python -m gsgan.check data=capture data.root={out}",
        f"python -m gsgan.fit data=capture data.root={out} out={out / 'landmarks3d_fit.npz'}",
        f"python -m gsgan.train data=capture data.root={out} "
        "data.reader.landmarks=landmarks3d_fit.npz",
    )
    console.print("\n".join(told), markup=False, highlight=False, soft_wrap=True)
    return out


def _fingerprint(options: Options, inputs: Inputs) -> list[object]:
    """All that is read: pictures, calibration, landmark and mask files, the tool."""
    parts: list[object] = [source.fingerprint() for source in inputs.sources.values()]
    parts += [inputs.calibration.path.name, *(str(c) for c in inputs.cameras)]
    for name in ("landmarks", "landmarks3d", "masks"):
        if getattr(options, name) in (None, MEDIAPIPE):
            continue
        place = options.folder(name)
        files = sorted(p for p in (place, *place.rglob("*")) if p.is_file())
        parts += [(str(p), p.stat().st_size, p.stat().st_mtime_ns) for p in files]
    return [*parts, options.mediapipe.key if options.needs_tool else None]


def _write_pictures(
    options: Options,
    inputs: Inputs,
    cameras: Sequence[CameraEntry],
    masks: Mapping[str, Mapping[int, Path]],
    solved: Solved,
    root: Path,
) -> dict[str, Written]:
    """Pictures of every frame that has a skeleton; the frames written, by camera."""
    posed = known(solved.solution.p[:, :BODY]).any(1)
    frames = set(solved.frames[posed].tolist())
    if not frames:
        raise DataError(
            f"{options.landmarks3d or options.landmarks}: no body joint of any frame came out in "
            "3D; expected landmarks that two cameras see at the same frame number, not NaN and "
            "with confidence above 0"
        )
    names = [camera.name for camera in cameras]
    lock = threading.Lock()
    with Bars("writing pictures", names, len(frames)) as bars:

        def one(index: int) -> Written:
            name = names[index]

            def advance() -> None:
                with lock:
                    bars.advance(name)

            return write_pictures(
                root,
                cameras[index],
                inputs.sources[name],
                masks[name],
                frames,
                options.offset(name),
                options.pictures,
                options.mask_tidying,
                advance,
            )

        lists = in_parallel(one, range(len(names)), options.workers, bars.stop)
    return dict(zip(names, lists, strict=True))


def _write_rest(
    options: Options,
    inputs: Inputs,
    cameras: Sequence[CameraEntry],
    detections: Mapping[str, Detections],
    solved: Solved,
    written: Mapping[str, Written],
    root: Path,
    key: str,
) -> Outcome:
    solution, names = solved.solution, [camera.name for camera in cameras]
    fps = frame_rate(options, inputs.sources)
    small = write_small_files(
        root,
        cameras=cameras,
        files=options.pictures,
        frames=solved.frames.tolist(),
        solution=solution,
        conf=solved.conf,
        fps=fps,
        up_axis=options.up_axis or standing_axis(solution.p),
        made_by={"key": key},
    )
    turned, moved = camera_moves(Rig.of(inputs.cameras), solution.rig)
    doubts = [
        *doubts_about_sources(inputs.sources, options.doubts),
        *doubts_about_pictures(inputs.sources, written, options.doubts),
        *doubts_about_detections(detections, options.doubts),
        *doubts_about_solution(
            solution, names, turned, moved, solved.delay, solved.gain, options.doubts
        ),
    ]
    return Outcome(
        inputs=inputs,
        cameras=tuple(small),
        frames=tuple(solved.frames.tolist()),
        written={name: one.frames for name, one in written.items()},
        solution=solution,
        turned=turned,
        moved_mm=moved,
        delay=solved.delay,
        doubts=tuple(doubts),
        fps=fps,
    )


def _read_back(root: Path) -> None:
    """Reads the dataset as training will, before it appears.

    Raises:
        DataError: when it could not be trained on.
    """
    try:
        read_capture(root)
    except DataError as error:
        raise DataError(f"nothing was made, because training could not read it: {error}") from None


def _forget_parts(root: Path) -> None:
    """Takes away what a run that was killed in the middle of a file left of it."""
    with writing(root):
        for part in root.rglob(".*.part"):
            part.unlink()


def _publish(root: Path, out: Path) -> None:
    """Lets the whole dataset appear in one step; when that fails, an earlier one stays."""
    old = out.with_name(f".{out.name}.old")
    with writing(out):
        if out.exists():
            shutil.rmtree(old, ignore_errors=True)
            os.replace(out, old)
        try:
            os.replace(root, out)
        except OSError:
            if old.exists():
                os.replace(old, out)
            raise
    shutil.rmtree(old, ignore_errors=True)
