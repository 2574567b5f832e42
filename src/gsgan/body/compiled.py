"""The poses of `gsgan.body.solve.Solver` in compiled code, on CPUs and without gradients.

`Solver` and `gsgan.body.fingers.Fingers` define the same by tensor operations: some 6,000 for a
frame with hands, which take 15 times as long.
"""

import ctypes
from collections.abc import Mapping

import torch
from torch import Tensor

from gsgan.splat import build, native

# Fields of struct SolveJob, in its order: counts, numbers, and arrays of body, fingers and frames.
COUNTS = (
    "J",
    "T",
    "D",
    "E",
    "landmarks",
    "bends",
    "limbs",
    "steps",
    "rounds",
    "placing",
)
NUMBERS = (
    "converged",
    "damping",
    "easier",
    "harder",
    "floor",
    "robust",
    "beyond",
    "held",
    "noise",
    "straight",
    "sharp",
    "finger_noise",
    "trace",
)
RIG = (
    "joint",
    "parent",
    "entry_turn",
    "entry_number",
    "carrier",
    "joints",
    "entry_axis",
    "landmarks",
    "precision",
    "prior",
    "minimum",
    "rest_hubs",
    "rest_hips",
    "head_from_eyes",
    "torso",
    "head",
    "replaced",
    "bend_numbers",
    "bend_hub",
    "bend_axes",
    "limb_hub",
    "limb_points",
    "limb_numbers",
    "limb_axes",
    "limb_bend",
)
FINGERS = (
    "chains",
    "joints",
    "rest",
    "palms",
    "bones",
    "axes",
    "prior",
    "minimum",
    "maximum",
    "rounds",
)
FRAMES = ("p", "visibility", "valid", "hands", "seen", "theta", "transl")
CONSTANTS = (*RIG, *(f"finger_{name}" for name in FINGERS))
# struct SolveJob of kernels/solve.h
_Job = build.job_type(
    ("B", "threads", *COUNTS),
    NUMBERS,
    (*(f"of_{name}" for name in CONSTANTS), *FRAMES),
)


def available(skeleton: Tensor) -> bool:
    """Whether `solve` can be used for skeletons of this device and dtype."""
    is_supported = (
        skeleton.dtype in build.DTYPES and skeleton.device.type != "meta"
    )
    return is_supported and native.available()


def to_constants(constants: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Constants of a body as `solve` takes them: on the CPU, float64 or int64."""
    held = {}
    for name, x in constants.items():
        kind = torch.float64 if x.is_floating_point() else torch.int64
        held[name] = x.detach().to("cpu", kind).contiguous()
    return held


def solve(
    constants: Mapping[str, Tensor],
    counts: Mapping[str, int],
    numbers: Mapping[str, float],
    body: tuple[Tensor, Tensor, Tensor],
    hands: tuple[Tensor, Tensor] | None,
) -> tuple[Tensor, Tensor]:
    """``theta [B, J, 3]`` and ``transl [B, 3]`` of frames on the CPU.

    They have the frames' dtype; the arithmetic is float64. A frame's result is the same to
    the bit in any batch and with any number of threads.

    Args:
        constants, counts, numbers: by `CONSTANTS`, `COUNTS`, `NUMBERS`; as `to_constants` gives
            them, fingers with hands.
        body: ``[B, 33, 3]`` finite, their visibility ``[B, 33]``, and ``[B, 33]`` bool, whether
            they were seen.
        hands: ``[B, 42, 3]``, and ``[B, 42]`` bool, whether they were seen and are finite.
    """
    p = body[0]
    theta = p.new_empty(len(p), counts["J"], 3)
    transl = p.new_empty(len(p), 3)

    # Counts and numbers are copied, arrays are passed by address.
    job = _Job(len(p), build.threads())
    for name, value in (*counts.items(), *numbers.items()):
        setattr(job, name, value)
    build.point(
        job, [f"of_{name}" for name in constants], list(constants.values())
    )

    # Without hands, their addresses are null.
    frames: list[Tensor | None] = [x.contiguous() for x in body]
    if hands is None:
        frames += [None, None]
    else:
        frames += [x.contiguous() for x in hands]
    build.point(job, FRAMES, [*frames, theta, transl])
    build.function("solve", p.dtype)(ctypes.byref(job))
    return theta, transl
