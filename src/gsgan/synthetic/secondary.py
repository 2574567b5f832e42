"""Secondary motion: sway of loose cloth and hair, and wrinkles near bent joints.

Linear blend skinning cannot do these: the sway depends on the motion before a moment, the wrinkles
on the pose. Both are smooth over the mesh, and the same whichever moments are requested.

Convention: metres, seconds, world frame, Z up.
"""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.signal import bilinear, lfilter
from scipy.sparse import coo_array, csr_array

from gsgan.motion.character import Animation, Character
from gsgan.motion.rotations import unit
from gsgan.synthetic.trace import Wrinkles

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Where cloth is loose: its label, the bones that carry it, the joint it hangs from (None: the top
# of the hair), metres from there at which it starts to sway and sways fully, and its share then.
LOOSE: tuple[tuple[str, tuple[str, ...], str | None, float, float, float], ...] = (
    (
        "upper_clothes",
        ("LeftArm", "LeftForeArm", "LeftHand"),
        "LeftArm",
        0.05,
        0.28,
        1.0,
    ),
    (
        "upper_clothes",
        ("RightArm", "RightForeArm", "RightHand"),
        "RightArm",
        0.05,
        0.28,
        1.0,
    ),
    ("upper_clothes", ("Spine2", "Spine1", "Spine", "Hips"), "Neck", 0.20, 0.60, 0.5),
    ("upper_clothes", ("LeftUpLeg", "RightUpLeg"), "Neck", 0.20, 0.60, 0.5),
    (
        "lower_clothes",
        ("LeftUpLeg", "LeftLeg", "LeftFoot"),
        "LeftUpLeg",
        0.15,
        0.85,
        0.8,
    ),
    (
        "lower_clothes",
        ("RightUpLeg", "RightLeg", "RightFoot"),
        "RightUpLeg",
        0.15,
        0.85,
        0.8,
    ),
    ("lower_clothes", ("Hips",), "Hips", 0.15, 0.60, 1.0),
    ("hair", ("Head", "Neck", "Spine2", "Spine1"), None, 0.15, 0.45, 1.0),
)
# Hz of the springs, and their share of critical damping
FREQUENCY = 2.4
DAMPING = 0.35
# samples per second of the springs, and seconds before the motion starts
RATE = 60.0
LEAD = 2.5
LIMIT = 0.04  # metres: a sway approaches it and never exceeds it
HANG = 0.025  # metres by which cloth hangs off a horizontal bone
INWARDS = 0.25  # share of a sway into the body that is kept
SMOOTHING = 4  # rounds that spread looseness from vertex to vertex

# Joints that crease cloth: the bone that bends, the one that it bends against, the end of the
# creased limb, and the metres along the limb over which folds fade.
CREASES = (
    *(
        (
            f"{side}{bone}",
            f"{side}{base}" if base != "Hips" else base,
            f"{side}{end}",
            reach,
        )
        for side in ("Left", "Right")
        for bone, base, end, reach in (
            ("ForeArm", "Arm", "Hand", 0.12),
            ("Arm", "Shoulder", "ForeArm", 0.10),
            ("Leg", "UpLeg", "Foot", 0.15),
            ("UpLeg", "Hips", "Leg", 0.13),
        )
    ),
    ("Spine2", "Hips", "Neck", 0.15),
)
WAVELENGTH = 0.055  # metres from one fold to the next
# of the deepest folds, and how soon they appear
SLOPE = 0.8
STIFFNESS = 1.5
FLANK = 0.05  # metres from a limb's axis at which folds are fully one-sided


class Moving(Protocol):
    """A motion with poses at any times ``[F]``, in seconds from 0 to ``duration``."""

    duration: float

    def at(self, times: Array) -> Animation: ...


class Secondary:
    """Offsets of the skinned vertices and normals of a character in motion."""

    def __init__(self, character: Character, motion: Moving) -> None:
        self.character = character
        # vertices that a seam of the texture duplicates move as one
        _, first, self._weld = np.unique(
            np.round(character.vertices, 5),
            axis=0,
            return_index=True,
            return_inverse=True,
        )
        self._weld = self._weld.ravel()
        self._count = np.bincount(self._weld)
        self._faces = self._weld[character.faces]
        self._rest = character.vertices[first]
        V = len(first)
        J = len(character.bones)
        rows = np.repeat(np.arange(V), 4)
        columns = character.bone_index[first].ravel()
        weights = character.bone_weight[first].ravel()
        self._skin = coo_array((weights, (rows, columns)), shape=(V, J)).tocsr()
        self._loose = self._looseness()
        self._times, self._sway = self._springs(motion)
        self._crease()

    def __call__(
        self, time: float, rotations: Array, vertices: Array, normals: Array
    ) -> tuple[Array, Array, Wrinkles]:
        """Vertices and normals ``[V, 3]`` with sway, and the wrinkles of the pose.

        Args:
            time: seconds.
            rotations: ``[J, 3, 3]`` world rotations of the bones since the rest pose.
            vertices: ``[V, 3]`` skinned, metres.
            normals: ``[V, 3]`` skinned, unit.
        """
        at = np.clip(time, 0, self._times[-1]) * RATE
        low = min(int(at), len(self._times) - 2)
        share = at - low
        sway = (1 - share) * self._sway[low] + share * self._sway[low + 1]
        offset = self._loose[:, None] * (self._skin @ sway)
        outwards = self._welded(normals)
        into = np.minimum((offset * outwards).sum(axis=1, keepdims=True), 0)
        offset -= (1 - INWARDS) * into * outwards
        before = self._welded(vertices)
        after = before + offset
        # not below the floor
        after[:, 2] = np.maximum(after[:, 2], np.minimum(before[:, 2], 0))
        turned = self._face_normals(after) - self._face_normals(before)
        moved = vertices + (after - before)[self._weld]
        return moved, unit(normals + turned[self._weld]), self._wrinkles(rotations)

    def _welded(self, x: Array) -> Array:
        """Mean ``[W, 3]`` of the duplicates of each vertex."""
        sums = [np.bincount(self._weld, weights=x[:, i]) for i in range(3)]
        return np.stack(sums, axis=1) / self._count[:, None]

    def _face_normals(self, vertices: Array) -> Array:
        """``[W, 3]`` unit normals of a mesh, faces weighted by their area."""
        a, b, c = (vertices[self._faces[:, i]] for i in range(3))
        area = np.cross(b - a, c - a)
        corner = self._faces.ravel()
        sums = [
            np.bincount(corner, np.repeat(area[:, i], 3), len(vertices))
            for i in range(3)
        ]
        return unit(np.stack(sums, axis=1))

    def _share_of(self, label: str) -> Array:
        """``[W]`` 1 on a label, falling smoothly to 0 beyond its hem."""
        c = self.character
        V = len(self._rest)
        if label not in c.label_names:
            return np.zeros(V)
        corner = self._faces.ravel()
        own = np.repeat(c.labels == c.label_names.index(label), 3)
        share = np.bincount(corner, own, V) / np.maximum(
            np.bincount(corner, minlength=V), 1
        )
        start = self._faces.ravel()
        end = np.roll(self._faces, 1, axis=1).ravel()
        ends = (np.r_[start, end, np.arange(V)], np.r_[end, start, np.arange(V)])
        near: csr_array = coo_array((np.ones(len(ends[0])), ends), shape=(V, V)).tocsr()
        total = near.sum(axis=1)
        for _ in range(SMOOTHING):
            share = (near @ share) / total
        # 1 up to the hem, where half of the faces are cloth's
        return np.minimum(2 * share, 1)

    def _looseness(self) -> Array:
        """``[W]`` share of a sway that each vertex follows: 0 where tight, growing to the hems."""
        c = self.character
        loose = np.zeros(len(self._rest))
        index = {name: i for i, name in enumerate(c.bones)}
        for label, bones, origin, start, full, share in LOOSE:
            of_label = self._share_of(label)
            carried = self._skin[:, [index[b] for b in bones if b in index]].sum(axis=1)
            if not of_label.any() or (origin is not None and origin not in index):
                continue
            if origin is None:
                hair = self._rest[of_label > 0.5]
                top = hair[hair[:, 2].argmax()] if len(hair) else self._rest[0]
            else:
                top = c.joints[index[origin]]
            far = np.clip(
                (np.linalg.norm(self._rest - top, axis=1) - start) / (full - start),
                0,
                1,
            )
            loose += share * of_label * carried * far * far * (3 - 2 * far)
        return loose

    def _springs(self, motion: Moving) -> tuple[Array, Array]:
        """Times ``[T]`` and the sway ``[T, J, 3]`` of what hangs on each bone.

        A damped spring holds a mass at the middle of the bone's loose vertices.
        """
        c = self.character
        times = np.arange(max(2, int(np.ceil(motion.duration * RATE)) + 1)) / RATE
        poses = motion.at(np.minimum(times, motion.duration))
        hold = self._skin.multiply(self._loose[:, None]).tocsr()
        total = hold.sum(axis=0)
        middle = (hold.T @ self._rest) / np.maximum(total, 1e-9)[:, None]
        middle = np.where((total > 1e-9)[:, None], middle, c.joints)
        place = poses.joints + np.einsum(
            "tjab,jb->tja", poses.rotations, middle - c.joints
        )
        along = np.einsum("tjab,jb->tja", poses.rotations, unit(middle - c.joints))
        hang = -HANG * (np.array([0, 0, 1.0]) - along * along[..., 2:])
        w = 2 * np.pi * FREQUENCY
        spring = [1, 2 * DAMPING * w, w * w]
        sway = _filtered([-1, 0, 0], spring, place) + _filtered([w * w], spring, hang)
        size = np.linalg.norm(sway, axis=-1, keepdims=True)
        return times, sway * (LIMIT * np.tanh(size / LIMIT) / np.maximum(size, 1e-9))

    def _crease(self) -> None:
        """What is constant of the wrinkles: each vertex belongs to the joint nearest to it."""
        c = self.character
        x = self._rest
        cloth = np.maximum(
            self._share_of("upper_clothes"), self._share_of("lower_clothes")
        )
        index = {name: i for i, name in enumerate(c.bones)}
        known = [k for k in CREASES if all(name in index for name in k[:3])]
        self._bends = np.array([[index[n] for n in k[:2]] for k in known]).reshape(
            -1, 2
        )
        near = np.zeros((len(known), len(x)))
        phase = np.zeros((len(known), len(x)))
        self._axis = np.zeros((len(known), 3))
        for k, (bone, _, end, reach) in enumerate(known):
            joint = c.joints[index[bone]]
            axis = self._axis[k] = unit(c.joints[index[end]] - joint)
            off = x - joint
            across = unit(np.cross(axis, [0.36, 0.48, 0.8]))
            # folds run askew round the limb, and are neither straight nor evenly spaced
            warp = 1.1 * np.sin(off @ across / 0.03) + 0.9 * np.sin(
                off @ axis / 0.05 + 1
            )
            phase[k] = 2 * np.pi * (off @ (axis + 0.5 * across)) / WAVELENGTH + warp
            # of the limb's own skin alone: a hand that rests on the hip has no part in it
            limb = self._skin[:, self._bends[k]].sum(axis=1)
            near[k] = np.exp(-((off @ axis / reach) ** 2)) * np.minimum(2 * limb, 1)
        self._own = near.argmax(axis=0) if known else np.zeros(len(x), np.int64)
        ordered = np.sort(np.vstack([np.zeros((2, len(x))), near]), axis=0)
        # 0 where two joints are equally near
        self._near = cloth * (ordered[-1] - ordered[-2])
        self._phase = phase[self._own, np.arange(len(x))] if known else np.zeros(len(x))

    def _wrinkles(self, rotations: Array) -> Wrinkles:
        c = self.character
        slope = np.zeros(len(self._rest))
        across = np.zeros_like(self._rest)
        if len(self._bends):
            bone, base = self._bends.T
            bent = np.swapaxes(rotations[base], 1, 2) @ rotations[bone]
            # where the limb's end moves as the joint bends: folds are deepest on that side
            inner = np.einsum("kij,kj->ki", bent, self._axis) - self._axis
            own = self._own
            off = self._rest - c.joints[bone[self._own]]
            flexion = np.linalg.norm(inner, axis=1)
            side = np.clip(
                (off * inner[own]).sum(axis=1) / FLANK, -flexion[own], flexion[own]
            )
            deep = np.tanh(STIFFNESS * (0.6 * flexion[own] + 0.4 * side))
            slope = SLOPE * self._near * deep
            R = np.reshape(
                self._skin @ rotations.reshape(len(rotations), 9), (-1, 3, 3)
            )
            across = unit(np.einsum("vij,vj->vi", R, self._axis[own]))
        fields = (self._phase[self._weld], slope[self._weld], across[self._weld])
        return Wrinkles(*(x.astype(np.float32) for x in fields))


def _filtered(numerator: list[float], denominator: list[float], signal: Array) -> Array:
    """A filter of Laplace's s over samples ``[T, …]``, at rest long before they start."""
    b, a = bilinear(numerator, denominator, RATE)
    lead = min(int(LEAD * RATE), len(signal) - 1)
    # mirrored about the first sample: the signal starts with its speed, without a jerk
    before = 2 * signal[:1] - signal[lead:0:-1]
    padded = (
        np.concatenate([before, signal]) - before[:1] if lead else signal - signal[:1]
    )
    start = before[0] if lead else signal[0]
    gain = numerator[-1] / denominator[-1]
    out: Array = lfilter(b, a, padded, axis=0)[lead:] + gain * start
    return out
