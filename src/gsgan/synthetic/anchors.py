"""Landmarks of a character: joints, and vertices found once on the rest pose."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gsgan.body.free import free_body
from gsgan.motion.character import Character, Ints
from gsgan.motion.rig import FINGERS, SIDES
from gsgan.motion.rotations import Array, unit
from gsgan.skeleton.face import BROW_POINTS, FACE_NAMES, LIP_POINTS
from gsgan.synthetic.parts import LABEL_NAMES, texture_lab
from gsgan.synthetic.trace import Tracer

# The bone whose joint is a pose landmark, without sides.
JOINT_BONES = {
    "shoulder": "Arm",
    "elbow": "ForeArm",
    "wrist": "Hand",
    "hip": "UpLeg",
    "knee": "Leg",
    "ankle": "Foot",
    "thumb": "HandThumb2",
    "index": "HandIndex1",
    "pinky": "HandPinky1",
}
# Landmarks of a finger and of the thumb, from the base.
SEGMENTS = ("mcp", "pip", "dip", "tip")
THUMB = ("cmc", "mcp", "ip", "tip")


class AbsentFinger(NamedTuple):
    """Where a finger without bones is, in hand lengths from the wrist."""

    first: float  # along the hand to the first joint
    step: float  # along the hand to each next joint
    thumbwards: float  # across the hand


ABSENT_FINGERS = (  # thumb to pinky
    AbsentFinger(first=0.2, step=0.13, thumbwards=0.35),
    AbsentFinger(first=0.5, step=0.15, thumbwards=0.18),
    AbsentFinger(first=0.5, step=0.17, thumbwards=0.05),
    AbsentFinger(first=0.5, step=0.15, thumbwards=-0.08),
    AbsentFinger(first=0.45, step=0.13, thumbwards=-0.2),
)
STEP = 0.0005  # metres between the rays cast at the face
# landmark → joint and vertex, one of them -1
Anchors = dict[str, tuple[int, int]]


def with_anchors(c: Character) -> Character:
    """The character with 33 MediaPipe pose, 42 hand and 30 face landmarks.

    Body and hands are joints where bones exist. Eyes, lids, brows, lips, nose and ears are
    vertices: found with rays from the front, from the eyeballs' bones, the colours of the brows
    and lips, and the slit that the shape ``mouth_open`` opens; in their absence from the
    proportions of a face.
    """
    # Limbs by their bones, the face by rays.
    main = c.dominant_bones()
    anchors: Anchors = {}
    for side in SIDES:
        anchors |= _limb_anchors(c, main, side)
    for name, vertex in _Face(c, main).vertices().items():
        anchors[name] = -1, vertex

    # Each landmark is a joint or a vertex; the other number is -1.
    body = free_body()
    names = (*body.landmark_names, *body.hand_names, *FACE_NAMES)
    pairs = np.array([anchors[name] for name in names], dtype=np.int64)
    return replace(
        c,
        anchor_names=names,
        anchor_joint=pairs[:, 0],
        anchor_vertex=pairs[:, 1],
    )


def _limb_anchors(c: Character, main: Ints, side: str) -> Anchors:
    """Joints of arm, hand and leg, and vertices of foot, finger tips and absent fingers."""
    low = side.lower()
    anchors = _hand(c, main, side) | _foot(c, main, side)
    # Without bones, the fingers of the pose landmarks are at the knuckles of the hand landmarks.
    for finger in ("thumb", "index", "pinky"):
        anchors[f"{low}_{finger}"] = anchors[f"{low}_{finger}_mcp"]
    for name, bone in JOINT_BONES.items():
        if side + bone in c.bones:
            anchors[f"{low}_{name}"] = c.bones.index(side + bone), -1
    return anchors


def _hand(c: Character, main: Ints, side: str) -> Anchors:
    """Joints of the fingers, tips without a bone, and places on the hand of absent fingers."""
    anchors = {}
    at = {bone: k for k, bone in enumerate(c.bones)}
    hand_joint = at[f"{side}Hand"]

    # The hand's axes, the second one towards the thumb in a T pose, and its length.
    wrist = c.joints[hand_joint]
    along = unit(wrist - c.joints[at[f"{side}ForeArm"]])
    ahead = unit(np.array([0, -1.0, 0]) + along * along[1])
    hand = np.flatnonzero(np.isin(main, c.with_descendants(hand_joint)))
    length = 0.0
    if len(hand):
        length = float(((c.vertices[hand] - wrist) @ along).max())

    # A finger without bones is placed on the hand, in shares of the hand's length.
    for finger, absent in zip(FINGERS, ABSENT_FINGERS, strict=True):
        for k, part in enumerate(THUMB if finger == "Thumb" else SEGMENTS):
            name = f"{side.lower()}_{finger.lower()}_{part}"

            # Rigs may have fewer phalanges, or no fingers.
            bone = at.get(f"{side}Hand{finger}{k + 1}")
            last = at.get(f"{side}Hand{finger}{k}", -1)
            tip = np.flatnonzero(main == last)
            if bone is not None:
                anchors[name] = bone, -1
            elif last >= 0 and len(tip):
                # The tip is the outermost vertex of the last bone.
                outwards = c.joints[last] - c.joints[c.parents[last]]
                anchors[name] = (
                    -1,
                    int(tip[(c.vertices[tip] @ outwards).argmax()]),
                )
            else:
                place = (absent.first + absent.step * k) * along
                target = wrist + length * (place + absent.thumbwards * ahead)
                anchors[name] = _nearest(c, hand, target, hand_joint)
    return anchors


def _foot(c: Character, main: Ints, side: str) -> Anchors:
    """Heel and toe tip: the ends of the foot along its direction, near the ground."""
    low = side.lower()
    ankle = c.bones.index(f"{side}Foot")
    ball = ankle
    if f"{side}ToeBase" in c.bones:
        ball = c.bones.index(f"{side}ToeBase")

    # Vertices of the shoe, which leaves out the hem of the trousers; without a shoe, of the foot.
    shod = np.zeros(len(main), bool)
    shod[c.faces[c.labels == LABEL_NAMES.index(f"{low}_shoe")]] = True
    on_foot = np.isin(main, c.with_descendants(ankle))
    if (on_foot & shod).any():
        on_foot &= shod
    foot = np.flatnonzero(on_foot)
    if len(foot) == 0:
        return {f"{low}_heel": (ankle, -1), f"{low}_foot_index": (ball, -1)}

    # Distances along the foot of the vertices near the ground.
    outwards = (c.joints[ball] - c.joints[ankle]) * [1, 1, 0] + [0, -0.01, 0]
    outwards = unit(outwards)
    x = c.vertices[foot]
    ground = x[:, 2].min()
    ahead = np.where(x[:, 2] < ground + 0.08, x @ outwards, np.nan)

    # The heel is below the ankle's line, a little above the ground.
    backwards = np.nanmin(ahead) - c.joints[ankle] @ outwards
    heel = c.joints[ankle] + outwards * backwards
    heel[2] = ground + 0.025
    tip = int(foot[np.nanargmax(ahead)])
    return {
        f"{low}_heel": _nearest(c, foot, heel, ankle),
        f"{low}_foot_index": (-1, tip),
    }


class _Face:
    """The front of the head as a map of rays: first hit, its colour, its bone."""

    def __init__(self, c: Character, main: Ints) -> None:
        self.c = c
        self.main = main
        self.head = c.bones.index("Head")

        # Vertices of the face's skin; of the whole head if no face is labelled.
        on_head = np.isin(main, c.with_descendants(self.head))
        self.skin = np.zeros(len(c.vertices), bool)
        self.skin[c.faces[c.labels == LABEL_NAMES.index("face_neck")]] = True
        self.skin &= on_head
        if not self.skin.any():
            self.skin = on_head if on_head.any() else np.ones_like(on_head)

        # The eyes, their distance (metres) and the middle between them.
        self.eyes = self._eye_centres()
        self.d = float(np.linalg.norm(self.eyes[0] - self.eyes[1]))
        self.mid = self.eyes.mean(0)
        self._look()

    def _eye_centres(self) -> Array:
        """``[2, 3]`` the eyeballs' bones, or the usual place of eyes in a head."""
        c = self.c
        if {"LeftEye", "RightEye"} <= set(c.bones):
            eyes = c.joints[[c.bones.index(f"{side}Eye") for side in SIDES]]
            # Some rigs put both at the head's joint.
            if np.linalg.norm(eyes[0] - eyes[1]) > 0.03:
                return eyes

        head = c.joints[self.head]
        depth = c.vertices[self.skin, 1].min() + 0.03
        height = head[2] + 0.45 * (c.vertices[:, 2].max() - head[2])
        return np.array(
            [
                [head[0] + 0.033, depth, height],
                [head[0] - 0.033, depth, height],
            ]
        )

    def _look(self) -> None:
        """Rays along +Y through a grid: ``vertex [h, w]`` nearest to each hit, -1 for none."""
        c = self.c
        d = self.d
        self.x = np.arange(-1.2 * d, 1.2 * d, STEP) + self.mid[0]
        self.z = np.arange(0.9 * d, -1.9 * d, -STEP) + self.mid[2]
        shape = (len(self.z), len(self.x))

        # The rays start in front of the person.
        x, z = np.meshgrid(self.x, self.z)
        front = np.full(x.size, c.vertices[:, 1].min() - 1)
        start = np.column_stack([x.ravel(), front, z.ravel()])
        ray = np.tile(np.array([0, 1, 0], np.float32), (len(start), 1))
        face, share = Tracer(c.vertices, c.faces).first(
            start.astype(np.float32), ray
        )

        # Vertex, hair and colour at each hit.
        corners = c.faces[face]
        nearest = np.take_along_axis(
            corners, share.argmax(axis=1)[:, None], axis=1
        )
        self.vertex = np.where(face >= 0, nearest[:, 0], -1).reshape(shape)
        self.hair = (c.labels[face] == LABEL_NAMES.index("hair")).reshape(shape)
        uv = np.einsum("nk,nki->ni", share, c.uv[corners])
        tint = None
        if c.tint is not None:
            tint = np.einsum("nk,nki->ni", share, c.tint[corners])
        lab = texture_lab(c, uv, c.material[face], tint)
        self.lab = lab.reshape(*shape, 3)

        # Metres that the open mouth lowers each hit.
        self.drop = None
        opened = c.shapes.get("mouth_open")
        if opened is not None:
            self.drop = -(share * opened[corners, 2]).sum(axis=1).reshape(shape)

    def at(self, x: float, z: float) -> int:
        """The vertex seen at a place of the face; the nearest on its skin beside the map."""
        # The ray that is nearest to the place.
        row = np.abs(self.z - z).argmin()
        column = np.abs(self.x - x).argmin()
        vertex = int(self.vertex[row, column])
        if vertex >= 0:
            return vertex
        far = np.linalg.norm(self.c.vertices[:, [0, 2]] - [x, z], axis=1)
        return int(np.where(self.skin, far, np.inf).argmin())

    def vertices(self) -> dict[str, int]:
        """Landmark → vertex."""
        x = self.c.vertices
        numbers = {}

        # The nose is the foremost vertex in the middle below the eyes. Lengths are shares of the
        # distance between the eyes.
        below = (self.mid[2] - x[:, 2]) / self.d
        central = np.abs(x[:, 0] - self.mid[0]) < 0.2 * self.d
        nose = self.skin & central & (below > 0.1) & (below < 1)
        numbers["nose"] = int(np.where(nose, x[:, 1], np.inf).argmin())

        # The ears are the outermost places at the height of the nose.
        level = self.skin & (np.abs(below - 0.25) < 0.45)
        if not level.any():
            level = self.skin
        for side, sign, eye in zip(
            ("left", "right"), (1, -1), self.eyes, strict=True
        ):
            numbers |= self._eye(side, sign, eye)
            numbers |= self._brow(side, sign, eye)

            # The vertex nearest to the mean of the outermost ones.
            outwards = np.where(level, sign * x[:, 0], -np.inf)
            ear = x[outwards > outwards.max() - 0.012].mean(axis=0)

            # The vertex of skin nearest to the middle of the ear's outer part.
            far = np.linalg.norm(x - ear, axis=1)
            numbers[f"{side}_ear"] = int(
                np.where(self.skin, far, np.inf).argmin()
            )

        for k, point in enumerate(self._lips()):
            numbers[f"mouth_outer_{k}"] = self.at(*point)
        numbers["mouth_left"] = numbers["mouth_outer_0"]
        numbers["mouth_right"] = numbers[f"mouth_outer_{LIP_POINTS // 2}"]
        return numbers

    def _eye(self, side: str, sign: int, eye: Array) -> dict[str, int]:
        """Landmarks of an eye: the lids bound what is seen of the eyeball."""
        d = self.d

        # The usual extent of an eye.
        inner = eye[0] - sign * 0.23 * d
        outer = eye[0] + sign * 0.23 * d
        upper = eye[2] + 0.08 * d
        lower = eye[2] - 0.07 * d

        # The visible extent of the eyeball, if it has a bone.
        bone = f"{side.capitalize()}Eye"
        if bone in self.c.bones:
            ball = self.c.with_descendants(self.c.bones.index(bone))
            seen = np.isin(self.main[self.vertex], ball) & (self.vertex >= 0)
            if seen.any():
                # Corners and lids are where the visible part of the eyeball
                # ends.
                rows, columns = np.nonzero(seen)
                left = self.x[columns.max()]
                right = self.x[columns.min()]
                inner, outer = (right, left) if sign > 0 else (left, right)
                central = np.abs(self.x[columns] - (left + right) / 2) < 0.1 * d
                upper = self.z[rows[central].min()]
                lower = self.z[rows[central].max()]

        # Landmarks are on the lids, not on the ball.
        edge = 2 * STEP
        x = (inner + outer) / 2
        z = (upper + lower) / 2
        inner_corner = self.at(inner - sign * edge, z - 0.02 * d)
        outer_corner = self.at(outer + sign * edge, z)
        return {
            f"{side}_lid_inner": inner_corner,
            f"{side}_lid_outer": outer_corner,
            f"{side}_lid_upper": self.at(x, upper + edge),
            f"{side}_lid_lower": self.at(x, lower - edge),
            f"{side}_eye": self.at(x, z),
            f"{side}_eye_inner": inner_corner,
            f"{side}_eye_outer": outer_corner,
        }

    def _brow(self, side: str, sign: int, eye: Array) -> dict[str, int]:
        """The darkest height above the eye, near where a brow usually is."""
        x = eye[0] + sign * np.linspace(-0.28, 0.42, BROW_POINTS) * self.d
        usual = eye[2] + np.array([0.25, 0.31, 0.34, 0.31, 0.24]) * self.d
        height = usual.copy()
        for k in range(BROW_POINTS):
            # Lightness along a column of the map, a few rays wide and smoothed.
            column = np.abs(self.x - x[k]).argmin()
            strip = self.lab[:, max(column - 4, 0) : column + 5, 0].mean(axis=1)
            smooth = np.convolve(strip, np.ones(7) / 7, "same")

            # Only heights without hair near the usual one count, the nearer the more.
            away = (self.z - usual[k]) / (0.14 * self.d)
            free = (np.abs(away) < 1) & ~self.hair[:, column]
            cost = np.where(free, smooth + 8 * away**2, 1000 + np.abs(away))
            height[k] = self.z[cost.argmin()]

        # A brow has no jumps.
        middle = np.median(height - usual)
        limit = 0.06 * self.d
        height = usual + np.clip(height - usual, middle - limit, middle + limit)
        return {
            f"{side}_brow_{k}": self.at(x[k], height[k])
            for k in range(BROW_POINTS)
        }

    def _lips(self) -> list[tuple[float, float]]:
        """Points (x, z) round the lips, from the left corner over the upper lip."""
        d = self.d

        # The usual place of a mouth: half its width, its middle and its line.
        half = 0.38 * d
        centre = self.mid[0]
        line = np.full(len(self.x), self.mid[2] - 1.08 * d)

        # The slit between the lips is where the open mouth lowers one ray more than the next.
        if self.drop is not None:
            below = self.z < self.mid[2] - 0.7 * d
            central = np.abs(self.x - self.mid[0]) < 0.7 * d
            jump = np.diff(self.drop, axis=0, append=self.drop[-1:])
            jump = jump * (below[:, None] & central)
            slit = jump > 0.1 * jump.max()
            if slit.any():
                # The line of the lips, and the corners of the mouth at its
                # ends.
                columns = np.flatnonzero(slit.any(axis=0))
                heights = self.z[jump.argmax(axis=0)[columns]]
                line = np.interp(self.x, self.x[columns], heights)
                left = self.x[columns[-1]]
                right = self.x[columns[0]]
                half = (left - right) / 2
                centre = (left + right) / 2

        # An ellipse of the lips' thickness about the line.
        points = []
        for k in range(LIP_POINTS):
            angle = 2 * np.pi * k / LIP_POINTS
            x = centre + half * np.cos(angle)

            # The lower lip is thicker than the upper one.
            rise = np.sin(angle)
            thickness = (0.11 if rise > 0 else 0.14) * d
            height = float(np.interp(x, self.x, line))
            points.append((x, height + thickness * rise))
        return points


def _nearest(
    c: Character, among: Ints, target: Array, joint: int
) -> tuple[int, int]:
    """The nearest of some vertices as (-1, vertex), or a joint if there are none."""
    if len(among) == 0:
        return joint, -1
    distance = np.linalg.norm(c.vertices[among] - target, axis=1)
    return -1, int(among[distance.argmin()])
