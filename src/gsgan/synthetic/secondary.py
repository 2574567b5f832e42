"""Secondary motion: sway of loose cloth and hair, and wrinkles near bent joints.

Linear blend skinning cannot do these: the sway depends on the motion before a moment, the wrinkles
on the pose. Both are smooth over the mesh, and the same whichever moments are requested.

Units are metres and seconds, in the world frame with Z up.
"""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.signal import bilinear, lfilter
from scipy.sparse import coo_array, csr_array

from gsgan.motion.character import Animation, Character
from gsgan.motion.rotations import unit
from gsgan.synthetic.trace import Wrinkles

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


class LooseCloth(NamedTuple):
    """A region of cloth or hair that sways: less near its origin, fully far from it."""

    label: str
    bones: tuple[str, ...]  # that carry it
    origin: str | None  # joint that it hangs from; None: the top of the hair
    start: float  # metres from the origin at which it starts to sway
    full: float  # metres from the origin from which it sways fully
    share: float  # of the full sway


def _sleeve(side: str) -> LooseCloth:
    return LooseCloth(
        label="upper_clothes",
        bones=(f"{side}Arm", f"{side}ForeArm", f"{side}Hand"),
        origin=f"{side}Arm",
        start=0.05,
        full=0.28,
        share=1.0,
    )


def _trouser_leg(side: str) -> LooseCloth:
    return LooseCloth(
        label="lower_clothes",
        bones=(f"{side}UpLeg", f"{side}Leg", f"{side}Foot"),
        origin=f"{side}UpLeg",
        start=0.15,
        full=0.85,
        share=0.8,
    )


LOOSE_CLOTH = (
    _sleeve("Left"),
    _sleeve("Right"),
    # The shirt on the trunk, and its hem on the thighs.
    LooseCloth(
        label="upper_clothes",
        bones=("Spine2", "Spine1", "Spine", "Hips"),
        origin="Neck",
        start=0.20,
        full=0.60,
        share=0.5,
    ),
    LooseCloth(
        label="upper_clothes",
        bones=("LeftUpLeg", "RightUpLeg"),
        origin="Neck",
        start=0.20,
        full=0.60,
        share=0.5,
    ),
    _trouser_leg("Left"),
    _trouser_leg("Right"),
    # A skirt.
    LooseCloth(
        label="lower_clothes",
        bones=("Hips",),
        origin="Hips",
        start=0.15,
        full=0.60,
        share=1.0,
    ),
    # Long hair.
    LooseCloth(
        label="hair",
        bones=("Head", "Neck", "Spine2", "Spine1"),
        origin=None,
        start=0.15,
        full=0.45,
        share=1.0,
    ),
)
SPRING_FREQUENCY = 2.4  # Hz of the springs
SPRING_DAMPING = 0.35  # of the springs, as a share of critical damping
SAMPLE_RATE = 60.0  # samples per second of the springs
LEAD = 2.5  # seconds of rest before the motion starts
LIMIT = 0.04  # metres: a sway approaches it and never exceeds it
HANG = 0.025  # metres by which cloth hangs off a horizontal bone
INWARDS = 0.25  # share of a sway into the body that is kept
SMOOTHING = 4  # rounds that spread looseness from vertex to vertex


class Crease(NamedTuple):
    """A joint that creases cloth."""

    bone: str  # that bends
    base: str  # that it bends against
    end: str  # of the creased limb
    reach: float  # metres along the limb over which folds fade


CREASES = (
    Crease("LeftForeArm", "LeftArm", "LeftHand", 0.12),
    Crease("LeftArm", "LeftShoulder", "LeftForeArm", 0.10),
    Crease("LeftLeg", "LeftUpLeg", "LeftFoot", 0.15),
    Crease("LeftUpLeg", "Hips", "LeftLeg", 0.13),
    Crease("RightForeArm", "RightArm", "RightHand", 0.12),
    Crease("RightArm", "RightShoulder", "RightForeArm", 0.10),
    Crease("RightLeg", "RightUpLeg", "RightFoot", 0.15),
    Crease("RightUpLeg", "Hips", "RightLeg", 0.13),
    Crease("Spine2", "Hips", "Neck", 0.15),
)
WAVELENGTH = 0.055  # metres from one fold to the next
MAX_SLOPE = 0.8  # of the deepest folds
STIFFNESS = 1.5  # how soon folds appear as a joint bends
FLANK = 0.05  # metres from a limb's axis at which folds are fully one-sided


class Moving(Protocol):
    """A motion with poses at any times ``[F]``, in seconds from 0 to ``duration``."""

    duration: float

    def at(self, times: Array) -> Animation: ...


class Secondary:
    """Offsets of the skinned vertices and normals of a character in motion."""

    def __init__(self, character: Character, motion: Moving) -> None:
        self.character = character
        self._index = {name: i for i, name in enumerate(character.bones)}

        # Vertices that a seam of the texture duplicates are welded, so that they move as one.
        _, first, weld = np.unique(
            np.round(character.vertices, 5),
            axis=0,
            return_index=True,
            return_inverse=True,
        )
        self._weld = weld.ravel()
        self._count = np.bincount(self._weld)
        self._faces = self._weld[character.faces]
        self._corner = self._faces.ravel()
        self._rest = character.vertices[first]

        # The skinning weights as a sparse matrix [W, J].
        rows = np.repeat(np.arange(len(first)), 4)
        columns = character.bone_index[first].ravel()
        weights = character.bone_weight[first].ravel()
        shape = (len(first), len(character.bones))
        self._skin = coo_array((weights, (rows, columns)), shape=shape).tocsr()

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
        # The sway at this time, between two samples of the springs.
        at = np.clip(time, 0, self._times[-1]) * SAMPLE_RATE
        low = min(int(at), len(self._times) - 2)
        share = at - low
        sway = (1 - share) * self._sway[low] + share * self._sway[low + 1]
        offset = self._loose[:, None] * (self._skin @ sway)

        # Cloth hardly sways into the body.
        outwards = self._merge_duplicates(normals)
        into = np.minimum((offset * outwards).sum(axis=1, keepdims=True), 0)
        offset -= (1 - INWARDS) * into * outwards

        # Cloth does not sway below the floor.
        before = self._merge_duplicates(vertices)
        after = before + offset
        floor = np.minimum(before[:, 2], 0)
        after[:, 2] = np.maximum(after[:, 2], floor)

        # Normals turn as the faces do.
        turned = self._face_normals(after) - self._face_normals(before)
        moved = vertices + (after - before)[self._weld]
        shaded = unit(normals + turned[self._weld])
        return moved, shaded, self._wrinkles(rotations)

    def _merge_duplicates(self, x: Array) -> Array:
        """Mean ``[W, 3]`` of the duplicates of each vertex."""
        sums = [np.bincount(self._weld, weights=x[:, i]) for i in range(3)]
        return np.stack(sums, axis=1) / self._count[:, None]

    def _face_normals(self, vertices: Array) -> Array:
        """``[W, 3]`` unit normals of a mesh, faces weighted by their area."""
        a = vertices[self._faces[:, 0]]
        b = vertices[self._faces[:, 1]]
        c = vertices[self._faces[:, 2]]
        area = np.repeat(np.cross(b - a, c - a), 3, axis=0)
        W = len(vertices)
        sums = [np.bincount(self._corner, area[:, i], W) for i in range(3)]
        return unit(np.stack(sums, axis=1))

    def _share_of(self, label: str) -> Array:
        """``[W]`` 1 on a label, falling smoothly to 0 beyond its hem."""
        c = self.character
        W = len(self._rest)
        # A person without such clothes has none of it.
        if label not in c.label_names:
            return np.zeros(W)

        # Share of the label among the faces around each vertex.
        has_label = np.repeat(c.labels == c.label_names.index(label), 3)
        faces = np.bincount(self._corner, minlength=W)
        share = np.bincount(self._corner, has_label, W) / np.maximum(faces, 1)

        # Smoothing over each vertex and its neighbours along the edges.
        start = self._corner
        end = np.roll(self._faces, 1, axis=1).ravel()

        # Each vertex with itself and its neighbours.
        every = np.arange(W)
        rows = np.r_[start, end, every]
        columns = np.r_[end, start, every]
        near: csr_array = coo_array(
            (np.ones(len(rows)), (rows, columns)), shape=(W, W)
        ).tocsr()
        total = near.sum(axis=1)
        for _ in range(SMOOTHING):
            share = (near @ share) / total

        # At the hem, half of the faces have the label: it keeps the share 1.
        return np.minimum(2 * share, 1)

    def _looseness(self) -> Array:
        """``[W]`` share of a sway that each vertex follows: 0 where tight, growing to the hems."""
        loose = np.zeros(len(self._rest))
        for cloth in LOOSE_CLOTH:
            of_label = self._share_of(cloth.label)
            if not of_label.any() or cloth.origin not in (None, *self._index):
                continue

            # The point that the cloth hangs from.
            if cloth.origin is not None:
                top = self.character.joints[self._index[cloth.origin]]
            else:
                hair = self._rest[of_label > 0.5]
                top = hair[hair[:, 2].argmax()] if len(hair) else self._rest[0]

            # A smooth step with the distance from that point.
            distance = np.linalg.norm(self._rest - top, axis=1)
            far = (distance - cloth.start) / (cloth.full - cloth.start)
            far = np.clip(far, 0, 1)
            bones = [self._index[b] for b in cloth.bones if b in self._index]
            carried = self._skin[:, bones].sum(axis=1)
            loose += (
                cloth.share * of_label * carried * far * far * (3 - 2 * far)
            )
        return loose

    def _springs(self, motion: Moving) -> tuple[Array, Array]:
        """Times ``[T]`` and the sway ``[T, J, 3]`` of what hangs on each bone.

        A damped spring holds a mass at the middle of the bone's loose vertices. With the place
        x(t) of its anchor and the displacement h(t) at which it hangs, its sway s follows
        s'' + 2 D w s' + w^2 s = -x'' + w^2 h.
        """
        joints = self.character.joints
        count = max(2, int(np.ceil(motion.duration * SAMPLE_RATE)) + 1)
        times = np.arange(count) / SAMPLE_RATE
        poses = motion.at(np.minimum(times, motion.duration))

        # The middle of the loose vertices of each bone, the joint if it has none.
        hold = self._skin.multiply(self._loose[:, None]).tocsr()
        total = hold.sum(axis=0)
        middle = (hold.T @ self._rest) / np.maximum(total, 1e-9)[:, None]
        middle = np.where((total > 1e-9)[:, None], middle, joints)
        arm = middle - joints

        # The anchors over time. Cloth hangs straight down, but not along its own bone.
        place = poses.joints + np.einsum("tjab,jb->tja", poses.rotations, arm)
        along = np.einsum("tjab,jb->tja", poses.rotations, unit(arm))
        up = np.array([0, 0, 1.0])
        hang = -HANG * (up - along * along[..., 2:])

        # The springs' transfer functions.
        w = 2 * np.pi * SPRING_FREQUENCY
        spring = [1, 2 * SPRING_DAMPING * w, w * w]
        inertia = _filter([-1, 0, 0], spring, place)
        sway = inertia + _filter([w * w], spring, hang)

        # The sway is limited smoothly.
        size = np.linalg.norm(sway, axis=-1, keepdims=True)
        limited = LIMIT * np.tanh(size / LIMIT)
        return times, sway * (limited / np.maximum(size, 1e-9))

    def _crease(self) -> None:
        """Pose-independent part of the wrinkles: each vertex has the folds of its nearest joint."""
        x = self._rest
        index = self._index
        creases = []
        for crease in CREASES:
            if {crease.bone, crease.base, crease.end} <= index.keys():
                creases.append(crease)

        self._bends = np.zeros((len(creases), 2), np.int64)
        self._axis = np.zeros((len(creases), 3))
        near = np.zeros((len(creases), len(x)))
        phase = np.zeros((len(creases), len(x)))
        for k, crease in enumerate(creases):
            # The limb's axis, and coordinates along and across it.
            joint = self.character.joints[index[crease.bone]]
            axis = unit(self.character.joints[index[crease.end]] - joint)
            across = unit(np.cross(axis, [0.36, 0.48, 0.8]))
            offset = x - joint
            along = offset @ axis
            self._bends[k] = index[crease.bone], index[crease.base]
            self._axis[k] = axis

            # Folds run askew round the limb, and are neither straight nor evenly spaced.
            warp = 1.1 * np.sin(offset @ across / 0.03)
            warp = warp + 0.9 * np.sin(along / 0.05 + 1)
            askew = offset @ (axis + 0.5 * across)
            phase[k] = 2 * np.pi * askew / WAVELENGTH + warp

            # Only the limb's own skin is creased, not a hand that rests on the hip.
            limb = self._skin[:, self._bends[k]].sum(axis=1)
            fading = np.exp(-((along / crease.reach) ** 2))
            near[k] = fading * np.minimum(2 * limb, 1)

        # Folds belong to the nearest joint, and vanish where two joints are equally near.
        self._own = np.zeros(len(x), np.int64)
        self._phase = np.zeros(len(x))
        if creases:
            self._own = near.argmax(axis=0)
            self._phase = phase[self._own, np.arange(len(x))]
        ordered = np.sort(np.vstack([np.zeros((2, len(x))), near]), axis=0)
        cloth = np.maximum(
            self._share_of("upper_clothes"), self._share_of("lower_clothes")
        )
        self._near = cloth * (ordered[-1] - ordered[-2])

    def _wrinkles(self, rotations: Array) -> Wrinkles:
        """The folds of a pose, deepest on the inner side of bent joints."""
        slope = np.zeros(len(self._rest))
        across = np.zeros_like(self._rest)
        if len(self._bends):
            # The limb's end moves in this direction as the joint bends: its inner side.
            bone, base = self._bends.T
            bent = np.swapaxes(rotations[base], 1, 2) @ rotations[bone]
            inner = np.einsum("kij,kj->ki", bent, self._axis) - self._axis
            flexion = np.linalg.norm(inner, axis=1)[self._own]

            # Folds deepen as the joint bends.
            offset = self._rest - self.character.joints[bone[self._own]]
            side = (offset * inner[self._own]).sum(axis=1) / FLANK
            side = np.clip(side, -flexion, flexion)
            deep = np.tanh(STIFFNESS * (0.6 * flexion + 0.4 * side))
            slope = MAX_SLOPE * self._near * deep

            # Their direction turns with the skin.
            blended = self._skin @ rotations.reshape(len(rotations), 9)
            R = np.reshape(blended, (-1, 3, 3))
            across = unit(np.einsum("vij,vj->vi", R, self._axis[self._own]))
        return Wrinkles(
            phase=self._phase[self._weld].astype(np.float32),
            slope=slope[self._weld].astype(np.float32),
            across=across[self._weld].astype(np.float32),
        )


def _filter(
    numerator: list[float], denominator: list[float], signal: Array
) -> Array:
    """Samples ``[T, …]`` after a transfer function in s (bilinear transform), from rest."""
    b, a = bilinear(numerator, denominator, SAMPLE_RATE)

    # The signal is extended by its mirror image about the first sample: it starts with its
    # speed, without a jerk.
    lead = min(int(LEAD * SAMPLE_RATE), len(signal) - 1)
    padded = signal
    if lead:
        before = 2 * signal[:1] - signal[lead:0:-1]
        padded = np.concatenate([before, signal])

    # A constant signal is only scaled, so the filter starts at rest from the first value.
    gain = numerator[-1] / denominator[-1]
    filtered: Array = lfilter(b, a, padded - padded[:1], axis=0)
    return filtered[lead:] + gain * padded[0]
