"""Readers of motion files, one per format."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gsgan.body import free_body, open_body
from gsgan.body.smpl import SkinnedModel, from_zju, read_smpl
from gsgan.data.calibration import METRES
from gsgan.data.formats import smpl_motion
from gsgan.data.formats.capture import SHAPE, read_shape
from gsgan.data.skeletons import hips_below, usual_step, whole_frame_ids
from gsgan.motion.asf import asf_of, read_amc
from gsgan.motion.bvh import read_bvh
from gsgan.motion.clip import Clip, rate_of, usual_rate
from gsgan.motion.points import json_files, read_points3d
from gsgan.motion.pose_files import read_pose
from gsgan.motion.retarget import rig_landmarks
from gsgan.motion.standard import RigMotion, standard_motion
from gsgan.scene import BodyPose
from gsgan.skeleton.joints import BODY, FACE, zeros_as_missing
from gsgan.skeleton.proportions import HIPS, SHOULDERS, Proportions
from gsgan.utils.arrays import as_floats, expect_array, nanmedian
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.files import read_json, read_json_value
from gsgan.utils.pickles import read_arrays, read_npy, read_pickle

Float = NDArray[np.float64]
Ints = NDArray[np.int64]

# Keys of MediaPipe's world landmarks in its several APIs.
WORLD_KEYS = (
    "pose_world_landmarks",
    "poseWorldLandmarks",
    "world_landmarks",
    "worldLandmarks",
    "POSE_WORLD_LANDMARKS",
    "keypoints3D",  # TensorFlow.js, metres from the hips
)
# Keys of SMPL's parameters: WHAM, AMASS, HuMMan, smplx, AIST++, ZJU-MoCap. WHAM's have poses in
# the camera's axes too, so those of the world come first.
POSE_KEYS = (
    "pose_world",
    "poses",
    "pose",
    "smpl_poses",
    "body_pose",
    "pose_body",
)
PART_KEYS = (
    "pose_jaw",
    "pose_eye",
    "pose_hand",
)  # parts of SMPL-X, after the body
ROOT_KEYS = ("Rh", "root_orient", "global_orient")
MOVE_KEYS = ("trans_world", "trans", "transl", "smpl_trans", "Th")
GVHMR_KEY = "smpl_params_global"  # GVHMR's parameters in the world's axes
# TRAM's names of SMPL's arrays, and of its moving camera, to the world, in camera.npy.
TRAM_KEYS = {
    "pred_rotmat": "poses",
    "pred_trans": "trans",
    "pred_shape": "betas",
    "frame": "frame_id",
}
CAMERA_KEYS = ("world_cam_R", "world_cam_T")
# Of the shape coefficients.
SHAPE_KEYS = ("betas", "shapes")
# Numbers of poses of SMPL-X's body, SMPL, SMPL-H, SMPL-X.
WITHOUT_ROOT = (63, 69, 153, 162)
# Numbers of poses that are quaternions, six numbers or matrices for each joint.
OTHER_ROTATIONS = {k * n for k in (4, 6, 9) for n in (21, 22, 23, 24, 52, 55)}
MAX_ANGLE = 30.0  # radians: a larger one is in degrees
# MediaPipe's world landmarks are metres from the middle of the hips, its image landmarks are not,
# but for their depth.
MAX_FROM_HIPS = 0.2
HIPS_DEPTH = 0.05
SHARES = 0.95  # of coordinates from 0 to 1: they are shares of an image
# Meshcapade's names of SMPL's arrays, and EasyMocap's of a fit.
MESHCAPADE_KEYS = {
    "bodyPose": "poses",
    "bodyTranslation": "trans",
    "shapeParameters": "betas",
    "frameRate": "fps",
}
FIT_KEYS = ("Rh", "Th", "poses", "shapes")
# Frames of EasyMocap without a person.
NOBODY: tuple[Any, ...] = ([], {"annots": []})
EASYMOCAP_SMPLX = 87  # SMPL-X's body, 6 numbers for each hand, jaw and eyes
SMPLH_COUNTS = (52, 6890)  # joints and vertices of SMPL-H
RATE_KEYS = ("fps", "mocap_framerate", "mocap_frame_rate")
SCALE_KEY = "smpl_scaling"  # in AIST++: units of its translations in a metre
# All arrays that are read, if a file has them.
ARRAYS = (
    "p",
    "conf",
    "frame_id",
    "theta",
    "visibility",
    SCALE_KEY,
    *WORLD_KEYS,
    *POSE_KEYS,
    *PART_KEYS,
    *ROOT_KEYS,
    *MOVE_KEYS,
    *SHAPE_KEYS,
    *RATE_KEYS,
)
RIGS = (".bvh", ".amc", ".glb", ".gltf", ".vrma")  # suffixes of files of rigs
SMPL_BODY = 22  # joints that SMPL, SMPL-H and SMPL-X share
# Metres in the units that rigs are made in.
LEG_UNITS = {
    "metres": 1.0,
    "decimetres": 0.1,
    "centimetres": 0.01,
    "inches": 0.0254,
    "millimetres": 0.001,
    "CMU units (inches / 0.45)": 0.0254 / 0.45,
}


@dataclass(frozen=True)
class Source:
    """Settings that readers may need besides the file."""

    subject: Proportions  # the subject's proportions, for formats without face, hands and scale
    smpl: Path | None = None  # an SMPL or SMPL-X model file, or None
    # the ASF file of an AMC motion, or None for the one in the same folder
    skeleton: Path | None = None
    # the axis of a rig's file that points up, or None to find it from the frames
    up: str | None = None
    # the name or number of one of a glTF file's animations, or None for the longest
    animation: str | None = None


def read_motion(path: Path, source: Source) -> Clip:
    """The motion in a file; its suffix decides the format.

    Raises:
        DataError: when it cannot be read, has an unknown format, or holds no motion.
    """
    if not path.exists():
        raise DataError(
            f"motion={path} does not exist; give a file, or novel_pose or novel_view for the run's "
            "held-out frames"
        )
    if path.is_file() and path.stat().st_size == 0:
        raise DataError(f"{path} is empty; expected a motion")
    reader = READERS.get(path.suffix.lower())
    if path.is_dir():
        reader = read_fits
    if path.suffix.lower() == ".fbx":
        raise DataError(
            f"{path}: .fbx is not read; convert it to .glb with FBX2glTF or Blender"
        )
    if reader is None:
        raise DataError(
            f"{path} has an unknown format; expected one of {', '.join(READERS)}"
        )
    try:
        return _with_missing(reader(path, source))
    # Arrays may have any type and shape: whatever is wrong with them is one error.
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        reason = str(error).partition("\n")[0]
        raise DataError(
            f"{path} is damaged, or its values are not as expected ({reason}); export it again"
        ) from error


def _with_missing(clip: Clip) -> Clip:
    """The motion with one rule for missing joints, whatever the format.

    Exact zeros are missing, and a visibility of 0 for every joint of every frame means that none
    was given.
    """
    p = zeros_as_missing(clip.p)
    visibility = clip.visibility
    if not visibility.any():
        visibility = np.ones_like(visibility)
    has_place = np.isfinite(p).all(-1)
    if not has_place.any():
        raise ValueError("no joint of any frame has a position")
    return replace(clip, p=p, visibility=np.where(has_place, visibility, 0.0))


# -- numpy's npz: landmarks, body poses, SMPL, MediaPipe


def read_npz(path: Path, source: Source) -> Clip:
    """A motion in an npz file; the names of its arrays decide the kind."""
    return _by_names(path, read_arrays(path, ARRAYS), source)


def read_dictionary(path: Path, source: Source) -> Clip:
    """A pickled dictionary of arrays, as of AIST++ (.pkl) or a frame of ZJU-MoCap (.npy)."""
    read = read_npy if path.suffix.lower() == ".npy" else read_pickle
    content = read(path)
    if isinstance(content, np.ndarray) and content.shape[1:] == (BODY, 3):
        raise DataError(
            f"{path} holds landmarks without their unit: save them in metres by numpy.savez, as "
            "the array 'p' of an .npz file"
        )
    if not isinstance(content, dict):
        raise DataError(
            f"{path} holds no dictionary; expected one of arrays, such as 'poses'"
        )
    return _by_keys(path, content, source)


def _by_keys(path: Path, content: dict[str, Any], source: Source) -> Clip:
    """The motion in a dictionary, of which GVHMR nests its own, and TRAM names others."""
    content = content.get(GVHMR_KEY, content)
    if not isinstance(content, dict):
        raise DataError(f"{path}: {GVHMR_KEY!r} must be a dictionary of arrays")
    tram = "pred_rotmat" in content
    if tram:
        content = {
            name: content[key]
            for key, name in TRAM_KEYS.items()
            if key in content
        }
    arrays = {key: as_floats(content[key]) for key in ARRAYS if key in content}
    for key, values in arrays.items():
        if not values.size:
            raise DataError(f"{path}: {key!r} must be an array of numbers")

    # TRAM's person is in the axes of its camera, whose way lies one folder above.
    for folder in (path.parent, path.parent.parent):
        camera = folder / "camera.npy"
        if tram and "frame_id" in arrays and camera.is_file():
            way = read_npy(camera)
            frames = arrays["frame_id"].astype(np.int64)
            for key in CAMERA_KEYS:
                arrays[key] = as_floats(way[key])[frames]
            break
    return _by_names(path, arrays, source)


def read_meshcapade(path: Path, source: Source) -> Clip:
    """Meshcapade's .smpl: an npz file of SMPL parameters with names of its own."""
    given = read_arrays(path, MESHCAPADE_KEYS)
    arrays = {MESHCAPADE_KEYS[key]: values for key, values in given.items()}
    return _by_names(path, arrays, source)


def read_fits(folder: Path, source: Source) -> Clip:
    """EasyMocap's fits, one JSON file for each frame: SMPL parameters of the person with the
    smallest id."""
    frames: dict[str, list[Any]] = {key: [] for key in FIT_KEYS}
    numbers = []
    for number, path in json_files(folder).items():
        content = read_json_value(path)
        fits = _fits(content)
        if content in NOBODY:
            continue
        if not fits:
            raise DataError(
                f"{path}: expected a fit of EasyMocap with {', '.join(FIT_KEYS)}"
            )
        fit = min(fits, key=lambda one: int(one.get("id", 0)))
        numbers.append(number)
        for key in FIT_KEYS:
            frames[key].append(as_floats(fit[key]).ravel())
    if not numbers:
        raise DataError(f"{folder} has no frame with a person")
    arrays: dict[str, NDArray[Any]] = {"frame_id": np.array(numbers)}
    for key, rows in frames.items():
        if len({row.size for row in rows}) != 1:
            raise DataError(f"{folder}: {key!r} differs in length by frame")
        arrays[key] = np.stack(rows)
    return _by_names(folder, arrays, source)


def _fits(content: Any) -> list[dict[str, Any]]:
    """EasyMocap's fits of the people of one frame, in a file's content; empty for other content."""
    if isinstance(content, dict):
        content = content.get("annots")
    people = content if isinstance(content, list) else []
    people = [one for one in people if isinstance(one, dict)]
    return [one for one in people if set(FIT_KEYS) <= one.keys()]


def read_tensors(path: Path, source: Source) -> Clip:
    """A dictionary of tensors, such as the SMPL-X parameters that GVHMR writes (.pt, .pth)."""
    # Tensors and plain values only: a file from somebody else cannot run code.
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception:  # torch's own words advise to let the file run code
        raise DataError(
            f"{path} is damaged, or holds more than tensors, which could run code; save its "
            f"{GVHMR_KEY!r} as arrays with numpy.savez"
        ) from None
    expected = {GVHMR_KEY, *TRAM_KEYS, *POSE_KEYS}
    if not isinstance(content, dict) or not expected & content.keys():
        raise DataError(
            f"{path} has no {GVHMR_KEY!r}; expected the hmr4d_results.pt of GVHMR, or a dictionary "
            "of SMPL's 'poses' and 'trans'"
        )
    return _by_keys(path, content, source)


def _by_names(
    path: Path, arrays: dict[str, NDArray[Any]], source: Source
) -> Clip:
    rate = _first(arrays, RATE_KEYS)
    fps = None if rate is None else rate_of(path, rate)

    # Each kind of motion has an array that no other kind has.
    if "p" in arrays:
        return _landmarks(path, arrays, fps)
    if "theta" in arrays:
        return _body_pose(path, arrays, fps, source)

    # MediaPipe's world landmarks, whose fourth number is the visibility.
    world = _first(arrays, WORLD_KEYS)
    if world is not None:
        p = _with_visibility(path, world, arrays.get("visibility"))
        _refuse_image_landmarks(path, p, named=True)
        return Clip(
            path=path,
            p=p[..., :3],
            visibility=p[..., 3],
            fps=fps,
            up=None,
            unit="metres",
        )
    if _first(arrays, POSE_KEYS) is not None:
        return _smpl(path, arrays, fps, source)
    raise DataError(
        f"{path} holds no known kind of motion; expected the arrays 'p' (landmarks), 'theta' and "
        "'transl' (body pose), 'poses' and 'trans' (SMPL, AMASS), or 'pose_world_landmarks' "
        "(MediaPipe)"
    )


def _first(
    arrays: dict[str, NDArray[Any]], keys: tuple[str, ...], default: Any = None
) -> Any:
    """The first array that there is."""
    for key in keys:
        if key in arrays:
            return arrays[key]
    return default


def _meta(path: Path) -> dict[str, Any]:
    """The content of meta.json in the file's folder, if there is one."""
    meta = path.with_name("meta.json")
    return read_json(meta) if meta.is_file() else {}


def _landmarks(path: Path, arrays: dict[str, Any], fps: float | None) -> Clip:
    """Landmarks as `gsgan.prepare` writes them."""
    hands = FACE.start
    face = FACE.stop
    if arrays["p"].shape[1:] not in ((BODY, 3), (hands, 3), (face, 3)):
        raise DataError(
            f"{path}: 'p' must have shape [F, {BODY}, 3], with hands [F, {hands}, 3], or "
            f"with hands and face [F, {face}, 3]; got {list(arrays['p'].shape)}"
        )

    # Landmarks that are not finite have no confidence.
    p = arrays["p"].astype(np.float64)
    conf = np.ones(p.shape[:2])
    if "conf" in arrays:
        conf = expect_array(arrays, "conf", p.shape[:2], path).astype(
            np.float64
        )
    conf = np.where(np.isfinite(p).all(-1), np.nan_to_num(conf), 0.0)

    # Rows may be in another order than frames, of which some may be missing.
    if "frame_id" in arrays:
        rows, at = _in_time(path, arrays, len(p))
        p = _at_times(p[rows], at, np.nan)
        conf = _at_times(conf[rows], at, 0.0)

    # People filmed from the waist up get hips below their shoulders.
    seen = conf[:, :BODY] > 0
    no_hips = seen[:, SHOULDERS].all(1) & ~seen[:, HIPS].any(1)
    body = np.nan_to_num(p[:, :BODY])
    placed = hips_below(body, seen)
    if no_hips.any() and (placed != body).any():
        p[no_hips, :BODY] = np.where(
            seen[no_hips, :, None], p[no_hips, :BODY], np.nan
        )

        # Their confidence is that of the shoulders from which they hang.
        for hip, shoulder in zip(HIPS, SHOULDERS, strict=True):
            p[no_hips, hip] = placed[no_hips, hip]
            conf[no_hips, hip] = conf[no_hips, shoulder]

    # Unit, frame rate and axis are in the meta.json of the same folder.
    meta = _meta(path)
    return Clip(
        path=path,
        p=p * METRES.get(meta.get("unit", "m"), 1.0),
        visibility=conf,
        fps=fps or meta.get("fps"),
        up=meta.get("up_axis"),
        unit="metres",
    )


def _in_time(path: Path, arrays: dict[str, Any], F: int) -> tuple[Ints, Ints]:
    """The rows ``[F]`` of a file by their frame numbers, and the time ``[F]`` of each, in frames.

    Of a motion of which every other frame was kept, this is one frame.
    """
    ids = whole_frame_ids(
        expect_array(arrays, "frame_id", (F,), path), str(path)
    )
    rows = np.argsort(ids)
    ids = ids[rows]
    steps = np.rint(np.diff(ids) / usual_step(ids)).astype(np.int64)
    return rows, np.cumsum(np.append(0, steps.clip(min=1)))


def _at_times(values: Float, at: Ints, missing: float) -> Float:
    """Rows of frames ``[F, …]`` at their times ``at [F]``; others are ``missing``."""
    placed = np.full((at[-1] + 1, *values.shape[1:]), missing)
    placed[at] = values
    return placed


def _body_pose(
    path: Path, arrays: dict[str, Any], fps: float | None, source: Source
) -> Clip:
    """Poses of the free body as `gsgan.fit` writes them, or of SMPL."""
    # SMPL's files call the translation "trans"; lengths become metres.
    theta = expect_array(arrays, "theta", (None, None, 3), path)
    F, bones, _ = theta.shape
    if "trans" in arrays:
        arrays = {**arrays, "transl": arrays["trans"]}
    transl = expect_array(arrays, "transl", (F, 3), path)
    if "frame_id" in arrays:
        rows, at = _in_time(path, arrays, F)
        theta = _at_times(theta[rows], at, np.nan)
        transl = _at_times(transl[rows], at, np.nan)
        F = len(theta)

    # Lengths have the unit of the capture.
    meta = _meta(path)
    scale = METRES.get(meta.get("unit", "m"), 1.0)
    transl = scale * transl
    fps = fps or meta.get("fps")

    # Another number of bones: SMPL.
    if bones != len(free_body().parents):
        smpl = {"poses": theta.reshape(F, -1), "trans": transl}
        if "betas" in arrays:
            smpl["betas"] = arrays["betas"]
        return _smpl(path, smpl, fps, source)

    # The free body in the shape that gsgan.fit has stored, if any.
    shape = path.with_name(SHAPE)
    subject = open_body(
        "free", betas=read_shape(shape) if shape.is_file() else ()
    )
    assert subject is not None
    poses = BodyPose(
        theta=torch.from_numpy(np.nan_to_num(theta)).float(),
        transl=torch.from_numpy(np.nan_to_num(transl)).float(),
    )

    # Frames with NaN were posed as zeros.
    p = subject.posed_landmarks(poses).double().numpy()
    is_finite = np.isfinite(theta).all((1, 2)) & np.isfinite(transl).all(1)
    p[~is_finite] = np.nan
    return Clip(
        path=path,
        p=p,
        visibility=np.ones(p.shape[:2]),
        fps=fps,
        up=meta.get("up_axis") or "z",
        unit="metres",
        body=poses,
    )


def _smpl(
    path: Path, arrays: dict[str, Any], fps: float | None, source: Source
) -> Clip:
    """Parameters of the SMPL family."""
    if source.smpl is None:
        raise DataError(
            f"{path} holds SMPL parameters, which give joints only together with the body model: "
            "give smpl=/path/to/SMPL_NEUTRAL.pkl or SMPLX_NEUTRAL.npz (free for research from the "
            "model's own site, not part of gsgan)"
        )
    if source.smpl.is_dir():
        raise ConfigError(
            f"smpl={source.smpl} is a folder; give the file in it, such as SMPL_NEUTRAL.pkl"
        )
    if not source.smpl.is_file():
        raise ConfigError(
            f"smpl={source.smpl} does not exist; expected a .pkl or .npz file"
        )

    # Poses, moves in metres and the median shape. SMPL-H has the vertices of SMPL.
    model = read_smpl(source.smpl)
    if (len(model.parents), len(model.v_template)) == SMPLH_COUNTS:
        model = _without_fingers(model)
    if model.kind == "generic":
        raise DataError(
            f"{source.smpl} is a model of {len(model.parents)} joints; expected SMPL (24), SMPL-H "
            "(52) or SMPL-X (55)"
        )
    arrays = _first_track(arrays)
    poses = _smpl_poses(path, arrays)
    F = len(poses)

    # Without a translation the person stays in place.
    moves = np.asarray(_first(arrays, MOVE_KEYS, np.zeros((F, 3))), np.float64)
    moves = moves.reshape(F, 3) / arrays.get(SCALE_KEY, 1.0)

    # One shape for the motion: the median over frames.
    betas = np.asarray(_first(arrays, SHAPE_KEYS, np.zeros(10)), np.float64)
    betas = np.median(betas.reshape(-1, betas.shape[-1]), axis=0)
    betas = betas[: model.shapedirs.shape[-1]]

    # Frames with NaN are posed as zeros, and set to NaN again below.
    is_finite = np.isfinite(poses).all(1) & np.isfinite(moves).all(1)
    theta = _for_model(np.nan_to_num(poses).reshape(F, -1, 3), model)
    moves = np.nan_to_num(moves)

    # TRAM's camera moves; SMPL turns about the root joint, the camera about its own centre.
    root = model.rest_joints(torch.from_numpy(betas[None]))[0, 0].numpy()
    if CAMERA_KEYS[0] in arrays:
        R, centre = (arrays[key] for key in CAMERA_KEYS)
        turn = Rotation.from_matrix(R)
        theta[:, 0] = (turn * Rotation.from_rotvec(theta[:, 0])).as_rotvec()
        moves = turn.apply(moves + root) + centre - root

    # ZJU-MoCap turns the body about the origin, SMPL about the root joint.
    if "Rh" in arrays:
        theta[:, 0], moves = from_zju(theta[:, 0], moves, root)

    shapes = np.repeat(betas[None], F, axis=0)
    motion = smpl_motion.SmplMotion(np.arange(F), theta, moves, shapes)
    p, conf = smpl_motion.landmarks_of(model, motion)
    p[~is_finite] = np.nan
    if "frame_id" in arrays:
        rows, at = _in_time(path, arrays, F)
        p = _at_times(p[rows], at, np.nan)
        conf = _at_times(conf[rows], at, 0.0)
    return Clip(
        path=path, p=p, visibility=conf, fps=fps, up=None, unit="metres"
    )


def _without_fingers(model: SkinnedModel) -> SkinnedModel:
    """SMPL-H as SMPL: all joints of a hand become one, at the base of the index finger."""
    hands = slice(SMPL_BODY, SMPL_BODY + 15), slice(SMPL_BODY + 15, None)
    weights = [model.weights[:, :SMPL_BODY]]
    rows = [model.J_regressor[:SMPL_BODY]]
    for hand in hands:
        weights.append(model.weights[:, hand].sum(1, keepdim=True))
        rows.append(model.J_regressor[hand][:1])
    return replace(
        model,
        kind="smpl",
        parents=(*model.parents[:SMPL_BODY], 20, 21),
        weights=torch.cat(weights, dim=1),
        J_regressor=torch.cat(rows),
        posedirs=model.posedirs[..., : 9 * (SMPL_BODY + 1)],
    )


def _first_track(arrays: dict[str, Any]) -> dict[str, Any]:
    """The arrays of the first person of SLAHMR's files, whose arrays are [people, frames, n]."""
    body = arrays.get("pose_body")
    if body is None or body.ndim != 3 or body.shape[2] not in WITHOUT_ROOT:
        return arrays
    people = len(body)
    return {
        key: values[0] if values.ndim > 1 and len(values) == people else values
        for key, values in arrays.items()
    }


def _smpl_poses(path: Path, arrays: dict[str, Any]) -> Float:
    """``[F, 3 n]`` axis-angle of n joints, the root first, whatever arrays hold them.

    AMASS' SMPL-H files hold ``poses`` (156); its SMPL-X files hold ``poses`` (165) and its parts
    too; HuMMan holds ``global_orient`` and ``body_pose`` (69); ZJU-MoCap an empty root in ``poses``
    (72) and ``Rh``.
    """
    # One row of numbers for each frame.
    poses = _rotation_vectors(path, _first(arrays, POSE_KEYS))
    root = _first(arrays, ROOT_KEYS)
    root = None if root is None else _rotation_vectors(path, root)
    if poses.shape[1] in WITHOUT_ROOT:
        if root is None:
            raise DataError(
                f"{path} has poses without the root's rotation; expected one of "
                f"{', '.join(ROOT_KEYS)} beside them"
            )
        root = root.reshape(len(poses), 3)

        # SMPL-X's jaw, eyes and hands follow the body.
        columns = [root, poses]
        smplx_body = poses.shape[1] == WITHOUT_ROOT[0]
        if smplx_body and all(key in arrays for key in PART_KEYS):
            for key in PART_KEYS:
                columns.append(_rotation_vectors(path, arrays[key]))
        poses = np.concatenate(columns, axis=1)
    elif "Rh" in arrays:
        # ZJU-MoCap: Rh replaces the empty root.
        root = np.asarray(arrays["Rh"], np.float64).reshape(-1, 3)
        poses = np.concatenate([root, poses[:, 3:]], axis=1)
        if poses.shape[1] == EASYMOCAP_SMPLX:
            poses = poses[:, : 3 * SMPL_BODY]
    count = poses.shape[1]
    if count % 3 or count < 3 * SMPL_BODY or count in OTHER_ROTATIONS:
        raise DataError(
            f"{path}: the poses have {count} numbers per frame; expected 3 for each of 22 "
            "or more SMPL joints, rotation vectors in radians"
        )
    return poses


def _rotation_vectors(path: Path, values: Any) -> Float:
    """``[F, 3 n]`` radians, of rotation vectors ``[F, 3 n]`` or ``[F, n, 3]``, or of rotation
    matrices ``[F, n, 3, 3]``, which 4D-Humans writes."""
    given = np.asarray(values, np.float64)
    if given.ndim == 4 and given.shape[2:] == (3, 3):
        turns = np.full(given.shape[:3], np.nan)
        is_finite = np.isfinite(given).all((2, 3))
        turns[is_finite] = Rotation.from_matrix(given[is_finite]).as_rotvec()
        given = turns
    if given.ndim > 3 or (given.ndim == 3 and given.shape[2] != 3):
        raise DataError(
            f"{path}: poses have the shape {list(given.shape)}; expected rotation vectors "
            "[F, 3 n] or [F, n, 3], or rotation matrices [F, n, 3, 3]"
        )

    # A rotation vector is at most a turn or two long.
    if given.size and np.nanmax(np.abs(given)) > MAX_ANGLE:
        raise DataError(
            f"{path}: poses have angles up to {np.nanmax(np.abs(given)):.0f}; expected rotation "
            "vectors in radians"
        )
    return given.reshape(len(given), -1)


def _for_model(theta: Float, model: SkinnedModel) -> Float:
    """Poses ``[F, n, 3]`` of SMPL (24), SMPL-H (52) or SMPL-X (55) for the model's joints.

    The 22 joints of the body are common to all; SMPL-X's fingers are SMPL-H's, after jaw and eyes.
    """
    joints = len(model.parents)
    given = theta.shape[1]
    if given == joints:
        return theta
    result = np.zeros((len(theta), joints, 3))
    result[:, :SMPL_BODY] = theta[:, :SMPL_BODY]
    if joints > 24 and given > 24:
        result[:, -30:] = theta[:, -30:]  # fingers
    return result


# -- MediaPipe's world landmarks as JSON


def read_mediapipe_json(path: Path, source: Source) -> Clip:
    """MediaPipe's results per frame, as its Python, JavaScript or Android API returns them.

    A frame is an object with one of `WORLD_KEYS`, or the 33 landmarks themselves; a landmark is
    ``{x, y, z, visibility}`` or a list of these numbers.
    """
    # The list of frames is the whole file, or one entry of it.
    content = read_json_value(path)
    if _fits(content):
        raise DataError(
            f"{path} is one frame of EasyMocap's fits; give their folder, motion={path.parent}"
        )
    frames = content
    fps = None
    if isinstance(content, dict):
        fps = content.get("fps")
        frames = _first(content, ("frames", *WORLD_KEYS))
    if not isinstance(frames, list) or not frames:
        raise DataError(
            f"{path} holds no frames; expected a list, or an object with 'frames', of MediaPipe's "
            "pose_world_landmarks"
        )

    # Each frame is read by itself, so that a message can name it.
    rows = []
    for i, frame in enumerate(frames):
        rows.append(_landmark_row(f"{path}, frame {i}", frame))
    p = np.stack(rows)

    # Landmarks without a name may be those of the image.
    named = isinstance(content, dict) and bool(content.keys() & set(WORLD_KEYS))
    named = named or any(isinstance(frame, dict) for frame in frames)
    _refuse_image_landmarks(path, p, named)
    return Clip(
        path=path,
        p=p[..., :3],
        visibility=p[..., 3],
        fps=None if fps is None else rate_of(path, fps),
        up=None,
        unit="metres",
    )


def _refuse_image_landmarks(path: Path, p: Float, named: bool) -> None:
    """Refuses landmarks ``[F, 33, 3+]`` of the image, of which the depth alone is relative to the
    hips; ``named`` ones must be shares of an image too.

    Raises:
        DataError: when they are not relative to the hips.
    """
    middle = np.nan_to_num(nanmedian(p[:, HIPS, :3].mean(1), axis=0))
    aside = np.linalg.norm(middle[:2]) > MAX_FROM_HIPS
    flat = p[..., :2][np.isfinite(p[..., :2])]
    shares = ((flat >= 0) & (flat <= 1)).sum() > SHARES * flat.size
    level = abs(middle[2]) < HIPS_DEPTH
    if aside and ((shares and level) if named else (shares or level)):
        raise DataError(
            f"{path}: the middle of the hips is at {middle.round(2).tolist()}; expected "
            "MediaPipe's world landmarks, in metres from there, not its image landmarks"
        )


def _landmark_row(where: str, frame: Any) -> Float:
    """``[33, 4]`` x, y, z, visibility of a frame; NaN and 0 if no person was detected."""
    if (
        isinstance(frame, list)
        and len(frame) == 1
        and isinstance(frame[0], dict)
    ):
        frame = frame[0]  # TensorFlow.js returns a list of people
    points = frame
    if isinstance(frame, dict):
        key = next((key for key in WORLD_KEYS if key in frame), None)
        if key is None and not any("andmark" in key for key in frame):
            keys = ", ".join(map(str, list(frame)[:6])) or "nothing"
            raise DataError(
                f"{where}: expected MediaPipe's pose_world_landmarks, found {keys}"
            )
        if key is None:
            raise DataError(
                f"{where}: no pose_world_landmarks; MediaPipe's other landmarks are in image "
                "coordinates, without metric depth"
            )
        points = frame[key]

    # Some versions wrap the landmarks once more.
    if isinstance(points, dict):
        points = points.get("landmark", points.get("landmarks"))
    if isinstance(points, list) and len(points) == 1:
        points = points[0]  # the Tasks API returns a list of people
    if not points:
        return np.repeat([[np.nan, np.nan, np.nan, 0]], BODY, axis=0)

    # 33 landmarks of 4 numbers.
    try:
        rows = list(map(_numbers, points))
    except TypeError:
        rows = []
    row = as_floats(rows)
    if row.shape != (BODY, 4) or not np.isfinite(row).all():
        raise DataError(
            f"{where}: expected {BODY} landmarks with finite x, y, z; found {len(rows)}"
        )
    return row


def _numbers(point: Any) -> list[Any]:
    """x, y, z and visibility of a landmark; a missing visibility is 1."""
    if not isinstance(point, dict):
        return [*point, 1.0][:4]
    # TensorFlow.js calls the visibility score.
    visibility = point.get("visibility", point.get("score", 1.0))
    return [point.get("x"), point.get("y"), point.get("z"), visibility]


def _with_visibility(
    path: Path, points: NDArray[Any], visibility: Any
) -> Float:
    """Landmarks ``[F, 33, 4]`` with visibility.

    Args:
        path: of the file, for messages.
        points: ``[F, 33, 3 or 4 or 5]``; the fourth number is the visibility.
        visibility: ``[F, 33]``, or None.
    """
    if points.ndim != 3 or points.shape[1] != BODY or points.shape[2] < 3:
        raise DataError(
            f"{path}: the world landmarks must have shape (any, {BODY}, 3 or 4), found "
            f"{points.shape}"
        )

    # A separate array of visibilities comes before the fourth number.
    if visibility is None and points.shape[2] > 3:
        visibility = points[..., 3]
    elif visibility is None:
        visibility = np.ones(points.shape[:2])
    if visibility.shape != points.shape[:2]:
        raise DataError(
            f"{path}: 'visibility' must have shape {points.shape[:2]}"
        )
    p = np.concatenate([points[..., :3], visibility[..., None]], axis=-1)
    return p.astype(np.float64)


# -- rigs


class RigFile(NamedTuple):
    """What the file of a rig holds."""

    motion: RigMotion
    metres: float | None  # in its unit of length, or None if that is unknown
    part: str = ""  # which part of the file it is, in words, if it has several


def read_rig(
    path: Path, skeleton: Path | None = None, animation: str | None = None
) -> RigFile:
    """The motion of a rig in a file of one of `RIGS`.

    Args:
        path: of the file.
        skeleton: the ASF file of an AMC motion, or None for the one in the same folder.
        animation: the name or number of one of a glTF file's animations, or None for the longest.

    Raises:
        ConfigError: when there is no such animation.
        DataError: when the file is damaged.
    """
    suffix = path.suffix.lower()
    if suffix == ".bvh":
        return RigFile(read_bvh(path), None)
    if suffix == ".amc":
        motion, metres = read_amc(path, skeleton or asf_of(path))
        return RigFile(motion, metres)

    # pygltflib is imported only for its files.
    from gsgan.motion.gltf_motion import read_gltf_motion

    motion, part = read_gltf_motion(path, animation)
    return RigFile(motion, None, part)


def _read_rig(path: Path, source: Source) -> Clip:
    """The motion of a rig on landmarks."""
    motion, metres, part = read_rig(path, source.skeleton, source.animation)
    try:
        standard = standard_motion(motion, path, source.up)
    # Numbers that are finite but absurd cause such errors.
    except (ValueError, ArithmeticError) as error:
        reason = str(error).splitlines()[0]
        raise DataError(
            f"{path} is no motion of a person ({reason}); export it again"
        ) from error

    # The unit with which the legs are about as long as the subject's.
    if metres is None:

        def mismatch(unit: str) -> float:
            leg = standard.leg * LEG_UNITS[unit]
            return float(abs(np.log(leg / source.subject.leg)))

        unit = min(LEG_UNITS, key=mismatch)
    else:
        unit = f"units of {100 * metres:.3g} cm"

    # Landmarks at the joints of the subject's bones.
    p = rig_landmarks(standard, source.subject)
    return Clip(
        path=path,
        p=p,
        visibility=np.asarray(np.isfinite(p).all(-1), np.float64),
        fps=usual_rate(1 / motion.frame_time),
        up="z",
        unit=unit,
        file_up=standard.up,
        part=part,
    )


# -- triangulated and detected points


def read_markers(path: Path, source: Source) -> Clip:
    """Joints of markerless motion capture (.trc, .c3d); markers on the skin are not supported."""
    markers = read_points3d(path)
    return Clip(
        path=path,
        p=markers.p,
        visibility=markers.conf,
        fps=markers.fps,
        up=None,
        unit="metres",
    )


def _read_pose(path: Path, source: Source) -> Clip:
    return read_pose(path, source.subject)


# By the suffix of the file.
READERS: dict[str, Callable[[Path, Source], Clip]] = {
    ".npz": read_npz,
    ".pkl": read_dictionary,
    ".npy": read_dictionary,
    ".pt": read_tensors,
    ".pth": read_tensors,
    ".smpl": read_meshcapade,
    ".json": read_mediapipe_json,
    **dict.fromkeys(RIGS, _read_rig),
    ".trc": read_markers,
    ".c3d": read_markers,
    ".pose": _read_pose,
}
