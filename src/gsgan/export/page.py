"""An avatar as one web page: quantised Gaussians, the body's solver, motions and the renderer.

The page (src/gsgan/export/web) evaluates `gsgan.model.harmonic` and projects as
`gsgan.splat.project` does. Its block is a JSON header and little-endian arrays, deflated.
"""

import base64
import hashlib
import html
import json
import math
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from gsgan.body import compiled
from gsgan.body.free import Body
from gsgan.body.solve import Solver
from gsgan.model.avatar import Avatar
from gsgan.model.body_points import BodyPoints
from gsgan.model.harmonic import Harmonic
from gsgan.motion.rotations import rotation
from gsgan.run.drive import Drive, rest_pose
from gsgan.run.runs import Run
from gsgan.skeleton import complete_skeleton
from gsgan.skeleton.proportions import upright
from gsgan.utils.errors import ConfigError
from gsgan.utils.provenance import SOFTWARE, SOURCE_TYPE, XMP

WEB = Path(__file__).with_name("web")
PAGE_VERSION = 2  # of the block
ALPHA_MIN = (
    1 / 255
)  # smallest alpha that the page draws, if the avatar's own is less
KINDS = {
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "float32": "f4",
}
# Numbers of a Gaussian before its colour: mean 3, quaternion 4, scale 3, opacity 1.
BEFORE_COLOUR = 11

Arrays = dict[str, NDArray]
Plain = dict[str, object]


def refuse_unsuitable(avatar: Avatar) -> None:
    """Refuses avatars that a page cannot hold.

    Raises:
        ConfigError: naming the reason.
    """
    if (
        avatar.body_points is None
        or avatar.deformation is None
        or avatar.solver is None
    ):
        raise ConfigError(
            "a page needs Gaussians on a skinned body and residuals of Ψ: an avatar with "
            "effects.body_points, not model=lbs_splat or image_to_image"
        )

    # Only the free body has a solver for fingers.
    if avatar.solver.fingers is None:
        raise ConfigError(
            "a page publishes the body that the avatar moves with, which the licence of "
            "SMPL's model files does not allow; train on the free body (data.smpl=null)"
        )


def page(content: bytes, name: str) -> str:
    """The text of a page that shows the `block`'s avatar; the name is its title."""
    style = (WEB / "page.css").read_text()

    # The parts of the page lie beside this module.
    script = (WEB / "gsgan.js").read_text()
    text = (WEB / "page.html").read_text()

    # The Content-Security-Policy names style and script by their hashes.
    for key, value in {
        "script_hash": _hash(script),
        "style_hash": _hash(style),
        "software": SOFTWARE,
        "source_type": SOURCE_TYPE,
        "name": html.escape(name),
        "style": style,
        "avatar": base64.b64encode(content).decode(),
        "script": script,
    }.items():
        text = text.replace(f"{{{key}}}", value)
    return text


def _hash(text: str) -> str:
    """A source of a Content-Security-Policy: this text and nothing else."""
    digest = hashlib.sha256(text.encode()).digest()
    return "sha256-" + base64.b64encode(digest).decode()


def block(
    run: Run,
    avatar: Avatar,
    motions: Mapping[str, tuple[Drive, float]],
    name: str,
) -> bytes:
    """The avatar's header and arrays, deflated; see web/content.ts.

    Args:
        run: the avatar's.
        avatar: its copy by `distil`.
        motions: drives and their frames per second by name.
        name: the avatar's.
    """
    # The avatar, and the body that it moves with.
    header, arrays = gaussians_of(avatar)
    body_header, body_arrays = body_of(run)
    header |= body_header | {"version": PAGE_VERSION, "name": name, "xmp": XMP}
    arrays |= body_arrays

    # The rest pose is always the first motion: a page without motions shows it.
    listed = []
    still = {"rest pose": (rest_pose(run.proportions), 1.0)}
    for i, (title, (drive, fps)) in enumerate((still | dict(motions)).items()):
        theta, transl = poses_of(avatar, drive)
        arrays[f"theta{i}"], step = quantise(theta, 32767)
        arrays[f"transl{i}"] = transl
        listed.append(
            {
                "name": title,
                "fps": fps,
                "frames": len(theta),
                "step": float(step),
            }
        )
    header["motions"] = listed

    # Each array begins at a multiple of eight bytes, as typed arrays of a browser need.
    places = {}
    data = b""
    for key, array in arrays.items():
        kind = KINDS[array.dtype.name]
        places[key] = (kind, len(data), array.size)
        raw = array.astype(f"<{kind}").tobytes()
        data += raw + bytes(-len(raw) % 8)

    # The length of the header comes first; blanks keep the arrays aligned.
    text = json.dumps(header | {"arrays": places}).encode()
    text += b" " * (-len(text) % 8)
    return zlib.compress(len(text).to_bytes(8, "little") + text + data, 9)


def quantise(values: NDArray, maximum: int) -> tuple[NDArray, NDArray]:
    """Whole numbers within ± ``maximum`` and their step; a matrix has one step per row."""
    size = np.abs(values)
    largest = (
        size.max(axis=-1, keepdims=True) if values.ndim == 2 else size.max()
    )
    step = np.maximum(largest, 1e-12) / maximum  # rows of zeros have a step too
    kind = np.int8 if maximum < 128 else np.int16
    return np.rint(values / step).astype(kind), np.asarray(step, np.float32)


def gaussians_of(avatar: Avatar) -> tuple[Plain, Arrays]:
    """The Gaussians at rest, their skinning, and the coefficients of their numbers.

    Constants that `gsgan.model.deformation` adds to residuals before it bounds them are folded
    into the first coefficient.
    """
    on_body = avatar.body_points
    linear = avatar.deformation
    assert on_body is not None
    assert isinstance(linear, Harmonic)
    points = on_body.points
    degree = linear.active_degree

    # Coefficients of each Gaussian, with the constants: the real part of the unit
    # quaternion, and size and opacity at rest.
    numbers = BEFORE_COLOUR + 3 * (degree + 1) ** 2
    table = linear.coefficients.detach().double()[..., :numbers].clone()
    table[..., :3] *= linear.mean_step
    table[:, 0, 3] += 1
    table[:, 0, 7:10] += (
        (on_body.sigma * points.spacing).log()[:, None].double()
    )
    table[:, 0, 10] += math.log(linear.opacity / (1 - linear.opacity))

    # The first harmonic is constant and needs 16 bits; for the others 8 bits suffice. Numbers
    # whose other coefficients are all zero do not follow the normal and are left out.
    rows = table.permute(2, 1, 0).numpy()  # [numbers, 9, N]
    follow = np.flatnonzero(rows[:, 1:].any((1, 2)))
    first, first_step = quantise(rows[:, 0], 32767)
    others, steps = quantise(rows[follow, 1:].reshape(-1, len(table)), 127)

    # Positions at rest fill the range of 16 bits.
    means = points.means.numpy()
    low = float(means.min())
    step = float(means.max() - low) / 65535

    # LBS weights sum to one; their gradients let covariances stretch with the skin.
    bones = points.weights[0].numpy()
    weight = points.weights[1].detach().double().numpy()
    weight = weight / weight.sum(1, keepdims=True)
    slope_bone, slopes = slopes_of(on_body)
    slope, slope_step = quantise(slopes.flatten(), 32767)

    # The header: bounds of the residuals in metres, and the settings of the rasteriser.
    settings = avatar.accuracy
    stretch = on_body.stretch_limit
    scales = [math.log(limit * linear.stature) for limit in linear.scale_range]
    header: Plain = {
        "count": len(table),
        "degree": degree,
        "follow": follow.tolist(),
        "weights": weight.shape[1],
        "slopes": slopes.shape[1],
        "slopeStep": float(slope_step),
        "stretch": stretch if math.isfinite(stretch) else None,
        "range": (low, step),
        "bound": (linear.mean_bound or 0) * linear.stature,
        "height": linear.stature,
        "scales": scales,
        "logit": linear.logit_bound,
        "lowPass": settings.low_pass,
        "alphaMin": max(settings.alpha_min, ALPHA_MIN),
        "alphaMax": settings.alpha_max,
        "fovClamp": settings.fov_clamp,
        "near": settings.near,
        "antialias": settings.antialias,
        "supersample": settings.supersample,
    }

    # The arrays, in the smallest types that hold their values.
    return header, {
        "mean": np.rint((means - low) / step).astype(np.uint16),
        "normal": np.rint(32767 * on_body.rest_normals.numpy()).astype(
            np.int16
        ),
        "bone": bones.astype(np.uint8),
        "weight": np.rint(65535 * weight).astype(np.uint16),
        "first": first,
        "others": others,
        "steps": np.concatenate([first_step, steps])[:, 0],
        "slopeBone": slope_bone,
        "slope": slope,
    }


def slopes_of(on_body: BodyPoints) -> tuple[NDArray, NDArray]:
    """Bones ``[N, n]`` and the gradients ``[N, n, 3]`` of their weights, 1 / metre."""
    count = on_body.n_points
    if not on_body.stretch:
        return np.zeros((count, 1), np.uint8), np.zeros((count, 1, 3))

    bones, slopes = on_body.stretch_terms()
    return bones.numpy().astype(np.uint8), slopes.numpy()


def body_of(run: Run) -> tuple[Plain, Arrays]:
    """The body's landmarks and solver, the subject's proportions and the world's axes."""
    body = run.body
    subject = run.proportions
    # A page has one body, which `refuse_unsuitable` has checked.
    assert isinstance(body, Body)
    assert run.avatar.solver is not None

    # The standard axes in the world, turned to where the person faces.
    axes = upright(subject.up).T @ rotation(np.array([0, 0, subject.facing]))
    header: Plain = {
        "bones": len(body.parents),
        "axes": axes.flatten().tolist(),
        "ground": subject.ground,
        "centre": list(run.scene.centre),
        "rest": subject.rest.tolist(),
    }

    # Landmarks of body and hands are each fixed to one bone.
    landmarks = torch.cat([body.landmarks, body.hand_landmarks]).float().numpy()
    carrier = torch.cat([body.landmark_bone, body.hand_bone]).numpy()
    return header, {
        "landmark": landmarks,
        "carrier": carrier.astype(np.uint8),
        "body": np.frombuffer(
            solver_block(run.avatar.solver, body.parents), np.uint8
        ),
    }


def solver_block(solver: Solver, parents: tuple[int, ...]) -> bytes:
    """``struct Body`` of web/solve.cpp for 32-bit addresses, which count from its start."""
    # The structure is one skeleton's job for the solver: sizes, numbers, and pointers
    # to arrays.
    constants, counts, numbers = solver.job()

    # The head: one skeleton, one thread, then the sizes and the solver's numbers.
    integers = [1, 1]
    for name in compiled.COUNTS:
        integers.append(counts[name])
    floats = [numbers[name] for name in compiled.NUMBERS]
    head = (
        np.array(integers, "<i8").tobytes() + np.array(floats, "<f8").tobytes()
    )

    # Addresses of the constants follow; those of a frame's arrays are set by the page.
    given = [constants[name].numpy() for name in compiled.CONSTANTS]
    slots = len(given) + len(compiled.FRAMES)
    slots += slots % 2  # structures are multiples of eight bytes
    start = len(head) + 4 * (slots + 2)
    addresses = np.zeros(slots + 2, "<u4")

    # The arrays themselves, with the bones' parents behind all fields of the structure.
    data = b""
    for slot, array in (*enumerate(given), (slots, np.array(parents))):
        addresses[slot] = start + len(data)
        data += array.astype(f"<{array.dtype.kind}8").tobytes()
    return head + addresses.tobytes() + data


@torch.no_grad()
def poses_of(avatar: Avatar, drive: Drive) -> tuple[NDArray, NDArray]:
    """``theta [F, J, 3]`` and ``transl [F, 3]`` of a drive: its own, else solved."""
    body = drive.body
    if body is None:
        # The drive has joints alone: unknown ones are completed, and the body is fitted.
        p, visibility = complete_skeleton(
            torch.from_numpy(drive.p),
            torch.from_numpy(drive.visibility),
            avatar.template,
            avatar.limb_length_sum,
        )
        body = avatar.body_pose(p, visibility)
    assert body is not None
    return body.theta.float().numpy(), body.transl.float().numpy()
