"""`gsgan.prepare`: videos in, a capture for `data=capture` out."""

import shutil
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from rich.console import Console

from gsgan.check.run import check_capture
from gsgan.data.pixels import read_mask_values
from gsgan.data.splits import parse_frames
from gsgan.data.validation import Thresholds, check_distance
from gsgan.motion.rotations import between
from gsgan.prepare import landmarks
from gsgan.prepare.camera_array import (
    FILM,
    CameraArray,
    undistort_points,
)
from gsgan.prepare.clocks import DRIFT, by_time, renumber, unsteady_clocks
from gsgan.prepare.dataset import (
    Outcome,
    exists,
    publish,
    standing_direction,
    write_files,
)
from gsgan.prepare.from_person import calibrate_from_person
from gsgan.prepare.frontier import find_outlines
from gsgan.prepare.images import write_images
from gsgan.prepare.landmarks import Detections
from gsgan.prepare.matting import Room, Studied, study_room, tidy
from gsgan.prepare.mediapipe import find_people, tool_key
from gsgan.prepare.one_camera import MAX_OTHER_FACES, solve_video
from gsgan.prepare.one_view import USUAL_HEIGHT
from gsgan.prepare.options import (
    MEDIAPIPE,
    PERSON,
    Inputs,
    Options,
    read_inputs,
)
from gsgan.prepare.people import (
    OTHER_LENGTHS,
    compare_people,
    find_crowds,
    find_jumps,
    one_person,
)
from gsgan.prepare.solve import Solution, solve
from gsgan.prepare.sources import Recording, stamp
from gsgan.prepare.stages import Advance, StageFolder, digest, each_camera
from gsgan.prepare.summary import late_clocks, print_summary, summarise
from gsgan.prepare.triangulate import plain, robust
from gsgan.skeleton import MEDIAPIPE33, limb_length_sum
from gsgan.skeleton.joints import BODY, FACE, FROM_PARTS, HANDS, is_known
from gsgan.utils.arrays import Bytes, Float, Ints, evenly_spaced
from gsgan.utils.console import make_console
from gsgan.utils.errors import DataError, explain
from gsgan.utils.files import read_json, write_json
from gsgan.utils.frame_files import find_shifts
from gsgan.utils.pickles import read_arrays

STUDIED = 48  # frames that show rooms and silhouettes
MAX_FOCAL_RATIO = 1.6  # between a camera found from the person and the median
# Share of the frames of the camera with most that each camera must have.
MIN_IMAGES = 0.2
MIN_ANGLE = 30.0  # degrees between the rays of cameras found from the person


# incremented when the same settings begin to give another result
STAGE_VERSION = 7


def prepare(options: Options, console: Console | None = None) -> Path:
    """Makes the dataset ``options.out`` and checks it; the same dataset that exists is left alone.

    Returns:
        Its folder.

    Raises:
        GsganError: on anything the user can correct, also errors that the check of the dataset
            finds.
    """
    console = console or make_console()

    # The same dataset, if it exists.
    out = options.folder("out")
    inputs = None if options.one_camera else read_inputs(options)
    key = digest(
        [STAGE_VERSION, options.record(), _fingerprint(options, inputs)]
    )
    if exists(out, key, options.overwrite):
        console.print(
            f"{out} exists already, made from the same images and settings"
        )
        # A run may have been killed before its last file.
        if not (out / "check.json").is_file():
            check_capture(out, out / "check.html", console)
        _refuse_errors(out)
        return out

    # Joints, cameras and masks, from one camera or from several.
    if inputs is not None and options.offsets:
        options = replace(options, offsets=options.offsets_of(inputs.sources))
    stages = StageFolder(out.parent / f".{out.name}.prepare")
    if inputs is None:
        solved = _from_one_video(options, stages, console)
        options = replace(options, face=False)
    else:
        solved = _from_several(options, inputs, stages, console)

    # The dataset, in a folder of its own until it is complete; a run that was killed leaves one.
    root = stages.path("dataset", key)
    shutil.rmtree(root, ignore_errors=True)

    # The dataset appears at once, when it is complete.
    written = _write_images(options, solved, root)
    outcome = Outcome(
        options, solved.inputs, solved.frames, solved.solution, written
    )
    write_files(root, outcome, key)
    numbers = summarise(outcome) | solved.numbers
    numbers["errors"] = [
        *solved.errors,
        *_clock_errors(outcome, solved.drift),
        *_short_cameras(outcome),
    ]
    write_json(root / "prepare.json", numbers)
    publish(root, out)

    # Results of this run are kept for the next one, if so asked.
    stages.remove_others()
    if not options.keep_work:
        shutil.rmtree(stages.folder, ignore_errors=True)

    # The check, and what to do next.
    check_capture(out, out / "check.html", console)
    print_summary(numbers, console)
    _refuse_errors(out)
    lines = (
        f"{out} is ready; look at {out / 'check.html'}, then",
        f"python -m gsgan.train data=capture data.root={out}",
    )
    console.print(
        "\n".join(lines), markup=False, highlight=False, soft_wrap=True
    )
    return out


class Solved(NamedTuple):
    """All that is known of a recording before its images are written."""

    inputs: Inputs
    masks: Mapping[str, Mapping[int, Path]]
    rooms: Mapping[str, Room | None]
    frames: Ints  # [F]
    solution: Solution
    drift: Float  # [C] of each camera's clock, see `unsteady_clocks`
    numbers: dict[str, object]  # for prepare.json
    errors: list[str]  # a sentence for each thing that must be corrected


def _from_one_video(
    options: Options, stages: StageFolder, console: Console
) -> Solved:
    """One camera: the body is solved in its view, and joints come from it."""
    filmed = solve_video(options, stages, console)
    sources = filmed.inputs.sources
    return Solved(
        inputs=filmed.inputs,
        masks=filmed.masks,
        rooms=_silhouettes(options, sources, filmed.masks).rooms,
        frames=filmed.frames,
        solution=filmed.solution,
        drift=np.zeros(1),
        numbers={"one_camera": filmed.numbers},
        errors=[],
    )


def _from_several(
    options: Options, inputs: Inputs, stages: StageFolder, console: Console
) -> Solved:
    """Several cameras: detections of one person, cameras in metres, joints in 3D."""
    landmark_files, masks = find_people(
        options, inputs.sources, stages, console.print
    )
    inputs = _with_shifts(inputs, "masks", masks)
    inputs, masks = _with_times(options, inputs, masks, stages)
    inputs, detections = with_detections(inputs, landmark_files)
    inputs, detections = with_one_person(options, inputs, detections)
    frames, uv, conf = _undistort(options, inputs, detections)

    # Cameras that are not calibrated, or not in metres.
    if options.calibration == PERSON:
        people = [note for note in inputs.notes if "several people" in note]
        with explain(people[-1] if people else None):
            inputs = _from_person(options, inputs, frames, uv, conf, console)
    if not inputs.calibration.metric:
        inputs = _in_metres(options, inputs, uv, conf)

    # The joints, and the clocks of the cameras.
    look = _first_look(inputs, frames, uv, conf)
    inputs = replace(inputs, notes=[*inputs.notes, *look.notes])
    silhouettes = _silhouettes(options, inputs.sources, masks)
    alphas = silhouettes.alphas
    solution = _solve_frames(options, inputs, frames, uv, conf, alphas, console)
    return Solved(
        inputs=inputs,
        masks=masks,
        rooms=silhouettes.rooms,
        frames=frames,
        solution=solution,
        drift=unsteady_clocks(
            solution.cameras,
            uv[:, :, :BODY],
            conf[:, :, :BODY],
        ),
        numbers={},
        errors=look.errors,
    )


def _with_shifts(
    inputs: Inputs, what: str, numbers: Mapping[str, Iterable[int]]
) -> Inputs:
    """The inputs with notes on cameras whose files are numbered from another start than images.

    Args:
        inputs: the cameras.
        what: the files.
        numbers: of the files, by camera, counted as each camera's own images.
    """
    notes = [*inputs.notes]
    for name, source in inputs.sources.items():
        others = {f"its {what}": numbers[name]}
        for note in find_shifts(source.numbers(), others):
            notes.append(note.replace("doubtful: ", f"doubtful: {name}: "))
    return replace(inputs, notes=notes)


def with_detections(
    inputs: Inputs, landmark_files: Mapping[str, Path]
) -> tuple[Inputs, dict[str, Detections]]:
    """The inputs with a note on all that is doubtful in the detections, and these by camera.

    Args:
        inputs: the cameras.
        landmark_files: by camera, its file or folder of landmarks.
    """
    notes = [*inputs.notes]
    detections = {}
    numbers = {}
    for name in inputs.sources:
        read = landmarks.read_detections(landmark_files[name])
        numbers[name] = read.frame_id.tolist()
        detections[name] = in_common(read, inputs.sources[name])
        for note in read.notes:
            notes.append(f"{name}: {note}")

        # MediaPipe follows one person, and counts the faces.
        if landmark_files[name].is_file():
            faces = read_arrays(landmark_files[name], ("faces",)).get("faces")
            several = 0 if faces is None else int((faces > 1).sum())
            if faces is not None and several > MAX_OTHER_FACES * len(faces):
                notes.append(
                    f"doubtful: {name}: several people were detected in {several} of {len(faces)} "
                    "frames; give landmarks and masks of one person if they are mixed up"
                )
    noted = replace(inputs, notes=notes)
    return _with_shifts(noted, "landmarks", numbers), detections


def in_common(detections: Detections, source: Recording) -> Detections:
    """Detections by the frame numbers that all cameras share, in place of the source's own."""
    rows = dict(enumerate(detections.frame_id.tolist()))
    by_number = renumber({number: row for row, number in rows.items()}, source)
    numbers = np.array(sorted(by_number), np.int64)
    at = [by_number[number] for number in numbers.tolist()]
    people = detections.people
    return replace(
        detections,
        frame_id=numbers,
        px=detections.px[at],
        conf=detections.conf[at],
        people=None if people is None else [people[row] for row in at],
    )


def with_one_person(
    options: Options, inputs: Inputs, detections: dict[str, Detections]
) -> tuple[Inputs, dict[str, Detections]]:
    """The inputs with a note on other people, and detections of one person."""
    offsets = options.offsets or {}
    if options.calibration == PERSON:
        several = find_crowds(detections, offsets)
        if not several:
            return inputs, detections
        note = (
            f"doubtful: several people were detected in {len(several)} frames; cameras that are "
            "yet to be found cannot tell them apart, so in each the one with most confidence was "
            "taken: leave one person in each file of landmarks"
        )
        return replace(inputs, notes=[*inputs.notes, note]), detections
    chosen, notes = one_person(detections, inputs.cameras, offsets)
    return replace(inputs, notes=[*inputs.notes, *notes]), chosen


def _with_times(
    options: Options,
    inputs: Inputs,
    masks: Mapping[str, Mapping[int, Path]],
    stages: StageFolder,
) -> tuple[Inputs, dict[str, dict[int, Path]]]:
    """The inputs and masks with frame numbers that stand for the same moments, by the time stamps
    of the videos."""
    timed = by_time(inputs.sources, stages, options.workers)
    fps = inputs.fps
    if timed.rate is not None and options.fps is None:
        fps = timed.rate
    in_time = replace(
        inputs,
        sources=timed.sources,
        fps=fps,
        notes=[*inputs.notes, *timed.notes],
    )
    renamed = {
        name: renumber(masks[name], source)
        for name, source in timed.sources.items()
    }
    return in_time, renamed


def _clock_errors(outcome: Outcome, drift: Float) -> list[str]:
    """A sentence for each camera whose clock is not steady, and one on clocks that are late.

    Args:
        outcome: of the command.
        drift: ``[C]``, see `unsteady_clocks`.
    """
    errors = []
    for name, frames in zip(outcome.inputs.sources, drift, strict=True):
        if abs(frames) > DRIFT:
            errors.append(
                f"the clock of {name} is {frames:+.1f} frames later at the end than at the "
                "beginning, against the other cameras: it lost frames without a gap in its time "
                "stamps, or runs at another rate; give folders of images, numbered alike in all "
                "cameras, or use the part before with frames="
            )
    late = late_clocks(outcome)
    return errors or (late.notes if late.wrong else [])


def _short_cameras(outcome: Outcome) -> list[str]:
    """A sentence for each camera with an image in few of the frames that others have."""
    counts = {name: len(frames) for name, frames in outcome.written.items()}
    most = max(counts.values())
    errors = []
    for name, count in counts.items():
        if count < MIN_IMAGES * most:
            errors.append(
                f"{name} has images with a mask in {count} of {most} frames: copy its images and "
                "masks again, or leave it out of the source"
            )
    return errors


def _refuse_errors(out: Path) -> None:
    """Raises a DataError if a camera of the dataset is of no use, or its check has found errors."""
    wrong = read_json(out / "prepare.json").get("errors")
    if wrong:
        raise DataError(f"{out} was written, but {'; '.join(wrong)}")
    findings = read_json(out / "check.json")["findings"]
    errors = []
    for finding in findings:
        if finding["level"] == "error":
            errors.append(finding["sentence"])
    if errors:
        raise DataError(
            f"{out} was written, but its check has found errors: {'; '.join(errors)}; correct the "
            f"input (see {out / 'check.html'}) and start again with overwrite=true"
        )


def _fingerprint(options: Options, inputs: Inputs | None) -> list[object]:
    """The identity of all inputs: images, calibration, landmark and mask files, the tool."""
    # Images and calibration.
    parts: list[object] = []
    if inputs is None:
        parts.append(stamp(options.folder("source")))
    else:
        for source in inputs.sources.values():
            parts.append(source.fingerprint())
        parts.append(inputs.calibration.path.name)
        parts += map(str, inputs.cameras)

    # Given files; the tool's results depend on the images and the tool.
    for name in ("landmarks", "masks"):
        if getattr(options, name) != MEDIAPIPE:
            place = options.folder(name)
            for path in sorted((place, *place.rglob("*"))):
                if path.is_file():
                    parts.append(stamp(path))
    parts.append(tool_key() if options.needs_tool else None)
    return parts


def _undistort(
    options: Options, inputs: Inputs, detections: dict[str, Detections]
) -> tuple[Ints, Float, Float]:
    """The chosen frames ``[F]``; undistorted pixels ``[C, F, J, 2]``, confidence ``[C, F, J]``."""
    # The chosen frames.
    frames, px, conf = landmarks.gather(detections, options.offsets or {})
    chosen = np.ones(len(frames), bool)
    if options.frames is not None:
        chosen = np.isin(frames, parse_frames(options.frames, "frames"))
    if not chosen.any():
        raise DataError(
            f"{options.folder('source')}: frames={options.frames} leaves no frame"
        )

    # Their detections of the chosen joints, inside the images.
    joints = slice(None if options.hands or options.face else BODY)
    frames = frames[chosen]
    px = px[:, chosen, joints]
    conf = conf[:, chosen, joints]

    # Parts that the user leaves out count as not seen.
    conf[:, :, HANDS] *= options.hands
    conf[:, :, FACE] *= options.face
    sizes = np.array([camera.size[::-1] for camera in inputs.cameras])
    px, conf = landmarks.inside(px, conf, sizes)

    # The same pixels without lens distortion.
    uv = np.empty(px.shape)
    for c, camera in enumerate(inputs.cameras):
        uv[c] = undistort_points(camera, px[c])
    return frames, uv, conf


def _from_person(
    options: Options,
    inputs: Inputs,
    frames: Ints,
    uv: Float,
    conf: Float,
    console: Console,
) -> Inputs:
    """The inputs with cameras that are found from the person, and notes on how well they agree."""
    with console.status("finding the cameras from the person"):
        calibrated = calibrate_from_person(
            inputs.cameras, uv, conf, frames / inputs.fps, options.focal
        )
    films = np.array(
        [
            camera.K[0, 0] / np.hypot(*camera.size) * FILM
            for camera in calibrated.cameras
        ]
    )
    notes = [*inputs.notes]
    for camera, error, film in zip(
        calibrated.cameras, calibrated.error, films, strict=True
    ):
        notes.append(
            f"{camera.name}: found from the person, {error:.1f} pixels off its landmarks, focal "
            f"length {camera.K[0, 0]:.0f} pixels ({film:.0f} mm on film)"
        )

    # A focal length unlike the others is more often an error than a zoom.
    apart = films / np.median(films)
    for camera, ratio in zip(calibrated.cameras, apart, strict=True):
        if not 1 / MAX_FOCAL_RATIO < ratio < MAX_FOCAL_RATIO:
            notes.append(
                f"doubtful: {camera.name} has {ratio:.1f} times the median focal length; give "
                "focal=<mm on film> if all cameras are alike"
            )

    # Cameras that look the same way show no depth.
    if calibrated.angle < MIN_ANGLE:
        notes.append(
            f"doubtful: the cameras look at the person from within {calibrated.angle:.0f} degrees; "
            "positions and focal lengths are uncertain, calibrate with a board"
        )
    return replace(inputs, cameras=calibrated.cameras, notes=notes)


def _in_metres(
    options: Options, inputs: Inputs, uv: Float, conf: Float
) -> Inputs:
    """The inputs with cameras in metres, of a calibration without a scale.

    The person, triangulated in the given world, gets the height of ``options`` or the usual one.
    Without ``options.up_axis`` the world is turned so that the person stands along z.

    Args:
        options: of the command.
        inputs: with C cameras in any unit.
        uv: ``[C, F, J, 2]`` undistorted pixels.
        conf: ``[C, F, J]`` their confidence.

    Raises:
        DataError: when no limb is seen by two cameras.
    """
    # The body's joints in the world of the calibration.
    uv = uv[:, :, :BODY]
    C, F, J = uv.shape[:3]
    rig, pixels = CameraArray.of(inputs.cameras).normalise(uv.reshape(C, -1, 2))
    p = robust(rig, pixels, conf[:, :, :BODY].reshape(C, -1)).p.reshape(F, J, 3)

    # The median over frames: single joints may be wrong.
    seen = torch.from_numpy(is_known(p))
    limbs = limb_length_sum(
        torch.from_numpy(np.nan_to_num(p)), seen
    ).nanmedian()
    if not limbs > 0:
        raise DataError(
            f"{inputs.calibration.path}: no limb was seen by two cameras; do frame numbers agree?"
        )

    # The person's height there, by the limbs of a usual body.
    rest = torch.tensor(MEDIAPIPE33.rest_positions)[None]
    usual = limb_length_sum(rest) / MEDIAPIPE33.stature
    height = options.height or USUAL_HEIGHT
    scale = height / float(limbs / usual)
    assumed = (
        "" if options.height else ", as a usual person; height=<m> sets it"
    )
    note = f"the calibration has no scale: the person is {height:.2f} m tall{assumed}"

    # The turn that takes the person's upward direction to z.
    turn = np.eye(3)
    upward = standing_direction(p)
    if options.up_axis is None and upward is not None:
        turn = between(upward, np.array([0.0, 0, 1]))
        note += "; the world was turned so that the person stands along z"

    # Every camera follows the turn, and its distances follow the scale.
    cameras = []
    for camera in inputs.cameras:
        cameras.append(replace(camera, R=camera.R @ turn.T, t=scale * camera.t))
    return replace(inputs, cameras=cameras, notes=[*inputs.notes, note])


class Silhouettes(NamedTuple):
    """The empty room of each camera, None for masks that are given, and the person's alpha."""

    rooms: dict[str, Room | None]
    alphas: dict[str, dict[int, Bytes]]  # by the camera's own frame number


def _silhouettes(
    options: Options,
    sources: Mapping[str, Recording],
    masks: Mapping[str, Mapping[int, Path]],
) -> Silhouettes:
    """The rooms, and alpha in some frames that all cameras have, evenly spaced.

    Raises:
        DataError: when no frame has a mask in every camera.
    """
    # Frames by their common numbers, and by each camera's own.
    offsets = options.offsets or {}
    shared = set.intersection(
        *({n + offsets.get(name, 0) for n in masks[name]} for name in sources)
    )
    if options.frames is not None:
        shared &= set(parse_frames(options.frames, "frames"))
    if not shared:
        raise DataError(
            f"{options.folder('source')}: no frame has a mask in every camera; do frame numbers "
            "agree?"
        )
    frames = sorted(shared)
    chosen = [frames[k] for k in evenly_spaced(len(frames), STUDIED)]

    # A matte of a room that stands still, or the given masks.
    def study(name: str, advance: Advance) -> Studied:
        camera_frames = [frame - offsets.get(name, 0) for frame in chosen]
        advance(0, 1)
        if options.mattes:
            return study_room(
                sources[name], masks[name], camera_frames, options.mask_levels
            )
        alphas = {}
        for number in camera_frames:
            mask = read_mask_values(masks[name][number])
            alphas[number] = tidy(mask, options.mask_levels)
        return Studied(None, alphas)

    studied = each_camera(
        study, "estimating the room", list(sources), options.workers
    )
    return Silhouettes(
        rooms={name: one.room for name, one in studied.items()},
        alphas={name: one.alphas for name, one in studied.items()},
    )


def _solve_frames(
    options: Options,
    inputs: Inputs,
    frames: Ints,
    uv: Float,
    conf: Float,
    alphas: Mapping[str, Mapping[int, Bytes]],
    console: Console,
) -> Solution:
    """The joints and cameras that fit undistorted pixels, see `_undistort`."""
    cameras = CameraArray.of(inputs.cameras)
    offsets = options.offsets or {}
    numbers = {name: frames - offsets.get(name, 0) for name in inputs.sources}
    outlines = find_outlines(inputs.cameras, alphas, numbers)
    with console.status("finding 3D joints and refining the cameras"):
        return solve(
            cameras=cameras,
            time=frames / inputs.fps,
            uv=uv,
            conf=conf,
            outlines=outlines,
            settings=options.solve,
        )


class _Look(NamedTuple):
    """What is said of a recording before it is solved, in sentences."""

    notes: list[str]
    errors: list[str]


def _first_look(inputs: Inputs, frames: Ints, uv: Float, conf: Float) -> _Look:
    """A note on a person who jumps, and an error if another one follows, by a quick solution.

    Args:
        inputs: with C cameras.
        frames, uv, conf: see `_undistort`.

    Raises:
        DataError: on cameras in a wrong unit, before the long solution begins.
    """
    cameras = CameraArray.of(inputs.cameras)
    C, F, J = uv.shape[:3]
    p = plain(cameras, uv.reshape(C, -1, 2), conf.reshape(C, -1))
    _check_distance(inputs, p)
    body = p.reshape(F, J, 3)[:, :BODY]
    jumps = find_jumps(body, frames / inputs.fps)
    if not jumps:
        return _Look([], [])

    # Limbs tell another person from films of one person that were cut together.
    errors = []
    for row, share in compare_people(body, jumps).items():
        if share > OTHER_LENGTHS:
            errors.append(
                f"another person follows from frame {frames[row]}, whose limbs are {share:.0%} "
                "longer or shorter in the median; prepare each person alone with frames="
            )
    before, after = frames[jumps[0] - 1], frames[jumps[0]]
    note = (
        f"doubtful: the person is elsewhere from frame {before} to {after}, as in {len(jumps)} "
        "frames: another person may follow; prepare each part alone with frames="
    )
    return _Look([note], errors)


def _check_distance(inputs: Inputs, p: Float) -> None:
    """Refuses a capture whose cameras are implausibly near or far; NaN in ``p [N, 3]``: missing."""
    where = inputs.calibration.path
    seen = p[is_known(p)]
    if not len(seen):
        raise DataError(
            f"{where}: no joint was seen by two cameras; do frame numbers agree?"
        )
    hint = "is the calibration in another unit? Set unit=mm, cm or m"
    check_distance(where, inputs.cameras, seen, Thresholds.distance, hint)


def _write_images(
    options: Options, solved: Solved, root: Path
) -> dict[str, list[int]]:
    """Writes the images of every frame that has a skeleton."""
    inputs = solved.inputs
    solution = solved.solution

    # Frames without a joint of the body are left out; hands and a face alone are no person.
    body = [joint for joint in range(BODY) if joint not in FROM_PARTS]
    has_joint = is_known(solution.p[:, body]).any(1)
    posed = set(solved.frames[has_joint].tolist())
    if not posed:
        raise DataError(
            f"{options.landmarks}: no body joint of any frame came out in "
            "3D; two cameras must see it at the same frame number"
        )
    cameras = {camera.name: camera for camera in inputs.cameras}
    offsets = options.offsets or {}

    # One camera's images; `each_camera` runs cameras side by side.
    def one(name: str, advance: Advance) -> list[int]:
        return write_images(
            root=root,
            camera=cameras[name],
            source=inputs.sources[name],
            masks=solved.masks[name],
            frames=posed,
            offset=offsets.get(name, 0),
            scale=options.scale,
            suffix=options.format,
            levels=options.mask_levels,
            room=solved.rooms[name],
            advance=advance,
        )

    return each_camera(one, "writing images", list(cameras), options.workers)
