"""Landmarks of a character: joints, and vertices found once on the rest pose."""

from dataclasses import replace

import numpy as np

from gsgan.body.free import free_body
from gsgan.motion.character import Character, Ints
from gsgan.motion.rig import FINGERS, SIDES
from gsgan.motion.rotations import Array, unit
from gsgan.skeleton.face import BROW_POINTS, FACE_NAMES, LIP_POINTS
from gsgan.synthetic.parts import LABEL_NAMES, texture_lab
from gsgan.synthetic.trace import Tracer

JOINTS = {
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
SEGMENTS = ("mcp", "pip", "dip", "tip")
THUMB = ("cmc", "mcp", "ip", "tip")
# Thumb to pinky: first joint, step to the next, offset to the thumb's side, in hand lengths.
ABSENT_FINGERS = (
    (0.2, 0.13, 0.35),
    (0.5, 0.15, 0.18),
    (0.5, 0.17, 0.05),
    (0.5, 0.15, -0.08),
    (0.45, 0.13, -0.2),
)
STEP = 0.0005  # metres between the rays cast at the face
Anchors = dict[str, tuple[int, int]]  # landmark → joint and vertex, one of them -1


def with_anchors(c: Character) -> Character:
    """The character with 33 MediaPipe pose, 42 hand and 30 face landmarks.

    Body and hands are joints where bones exist. Eyes, lids, brows, lips, nose and ears are
    vertices: found with rays from the front, from the eyeballs' bones, the colours of the brows
    and lips, and the slit that the shape ``mouth_open`` opens; in their absence from the
    proportions of a face.
    """
    main = c.dominant_bones()
    found: Anchors = {}
    for side in SIDES:
        found |= _limb_anchors(c, main, side)
    points = _Face(c, main).vertices()
    found |= {name: (-1, vertex) for name, vertex in points.items()}
    body = free_body()
    names = (*body.landmark_names, *body.hand_names, *FACE_NAMES)
    pairs = np.array([found[name] for name in names], dtype=np.int64)
    return replace(
        c, anchor_names=names, anchor_joint=pairs[:, 0], anchor_vertex=pairs[:, 1]
    )


def _limb_anchors(c: Character, main: Ints, side: str) -> Anchors:
    """Joints of arm, hand and leg, and vertices of foot, finger tips and absent fingers."""
    low = side.lower()
    found = {
        f"{low}_{name}": (c.bones.index(side + bone), -1)
        for name, bone in JOINTS.items()
        if side + bone in c.bones
    }
    hand = _hand(c, main, side)
    for name, knuckle in (
        ("thumb", "thumb_mcp"),
        ("index", "index_mcp"),
        ("pinky", "pinky_mcp"),
    ):
        found.setdefault(f"{low}_{name}", hand[f"{low}_{knuckle}"])
    return found | hand | _foot(c, main, side)


def _hand(c: Character, main: Ints, side: str) -> Anchors:
    """Joints of the fingers, tips without a bone, and places on the hand of absent fingers."""
    found = {}
    at = {bone: k for k, bone in enumerate(c.bones)}
    wrist = c.joints[at[f"{side}Hand"]]
    along = unit(wrist - c.joints[at[f"{side}ForeArm"]])
    # the thumb's side in a T pose
    ahead = unit(np.array([0, -1.0, 0]) + along * along[1])
    hand = np.flatnonzero(np.isin(main, c.with_descendants(at[f"{side}Hand"])))
    length = float(((c.vertices[hand] - wrist) @ along).max()) if len(hand) else 0.0
    for finger, (first, step, across) in zip(FINGERS, ABSENT_FINGERS, strict=True):
        for k, part in enumerate(THUMB if finger == "Thumb" else SEGMENTS):
            bone = f"{side}Hand{finger}{k + 1}"
            name = f"{side.lower()}_{finger.lower()}_{part}"
            last = at.get(f"{side}Hand{finger}{k}", -1)
            tip = np.flatnonzero(main == last)
            if bone in at:
                found[name] = at[bone], -1
            elif last >= 0 and len(tip):
                outwards = c.joints[last] - c.joints[c.parents[last]]
                found[name] = -1, int(tip[(c.vertices[tip] @ outwards).argmax()])
            else:
                target = wrist + length * ((first + step * k) * along + across * ahead)
                found[name] = _nearest(c, hand, target, at[f"{side}Hand"])
    return found


def _foot(c: Character, main: Ints, side: str) -> Anchors:
    """Heel and toe tip: the ends of the foot along its direction, near the ground."""
    low = side.lower()
    ankle = c.bones.index(f"{side}Foot")
    ball = c.bones.index(f"{side}ToeBase") if f"{side}ToeBase" in c.bones else ankle
    shod = np.zeros(len(main), bool)
    # no hem of the trousers
    shod[c.faces[c.labels == LABEL_NAMES.index(f"{low}_shoe")]] = True
    on_foot = np.isin(main, c.with_descendants(ankle))
    foot = np.flatnonzero(on_foot & shod if (on_foot & shod).any() else on_foot)
    if len(foot) == 0:
        return {f"{low}_heel": (ankle, -1), f"{low}_foot_index": (ball, -1)}
    outwards = (c.joints[ball] - c.joints[ankle]) * [1, 1, 0] + [0, -0.01, 0]
    outwards = unit(outwards)
    x = c.vertices[foot]
    ahead = np.where(x[:, 2] < x[:, 2].min() + 0.08, x @ outwards, np.nan)
    heel = c.joints[ankle] + outwards * (np.nanmin(ahead) - c.joints[ankle] @ outwards)
    heel[2] = x[:, 2].min() + 0.025
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
        on_head = np.isin(main, c.with_descendants(self.head))
        self.skin = np.zeros(len(c.vertices), bool)
        self.skin[c.faces[c.labels == LABEL_NAMES.index("face_neck")]] = True
        self.skin &= on_head
        if not self.skin.any():
            self.skin = on_head if on_head.any() else np.ones_like(on_head)
        self.eyes = self._eye_centres()
        self.d = float(np.linalg.norm(self.eyes[0] - self.eyes[1]))
        self.mid = self.eyes.mean(0)
        self._look()

    def _eye_centres(self) -> Array:
        c = self.c
        if {"LeftEye", "RightEye"} <= set(c.bones):
            eyes = c.joints[[c.bones.index(f"{side}Eye") for side in SIDES]]
            # some rigs put both at the head's joint
            if np.linalg.norm(eyes[0] - eyes[1]) > 0.03:
                return eyes
        head = c.joints[self.head]
        x = c.vertices[self.skin]
        height = head[2] + 0.45 * (c.vertices[:, 2].max() - head[2])
        return np.array(
            [[head[0] + s * 0.033, x[:, 1].min() + 0.03, height] for s in (1, -1)]
        )

    def _look(self) -> None:
        """Rays along +Y through a grid: ``vertex [h, w]`` nearest to each hit, -1 for none."""
        c = self.c
        d = self.d
        self.x = np.arange(-1.2 * d, 1.2 * d, STEP) + self.mid[0]
        self.z = np.arange(0.9 * d, -1.9 * d, -STEP) + self.mid[2]
        grid = np.stack(np.meshgrid(self.x, self.z), -1).reshape(-1, 2)
        start = np.c_[
            grid[:, 0], np.full(len(grid), c.vertices[:, 1].min() - 1), grid[:, 1]
        ]
        ray = np.tile(np.array([0, 1, 0], np.float32), (len(grid), 1))
        face, share = Tracer(c.vertices, c.faces).first(start.astype(np.float32), ray)
        corners = c.faces[face]
        nearest = np.take_along_axis(corners, share.argmax(1)[:, None], 1)[:, 0]
        shape = len(self.z), len(self.x)
        self.vertex = np.where(face >= 0, nearest, -1).reshape(shape)
        self.hair = (c.labels[face] == LABEL_NAMES.index("hair")).reshape(shape)
        uv = np.einsum("nk,nki->ni", share, c.uv[corners])
        self.lab = texture_lab(c, uv, c.material[face]).reshape(*shape, 3)
        opened = c.shapes.get("mouth_open")
        self.drop = (
            None
            if opened is None
            else -(share * opened[corners, 2]).sum(1).reshape(shape)
        )

    def at(self, x: float, z: float) -> int:
        """The vertex seen at a place of the face; the nearest on its skin beside the map."""
        row = np.abs(self.z - z).argmin()
        column = np.abs(self.x - x).argmin()
        if (vertex := int(self.vertex[row, column])) >= 0:
            return vertex
        far = np.linalg.norm(self.c.vertices[:, [0, 2]] - [x, z], axis=1)
        return int(np.where(self.skin, far, np.inf).argmin())

    def vertices(self) -> dict[str, int]:
        """Landmark → vertex."""
        x = self.c.vertices
        d = self.d
        mid = self.mid
        found = {}
        below = (mid[2] - x[:, 2]) / d
        nose = (
            self.skin
            & (np.abs(x[:, 0] - mid[0]) < 0.2 * d)
            & (below > 0.1)
            & (below < 1)
        )
        found["nose"] = int(np.where(nose, x[:, 1], np.inf).argmin())
        for side, sign, eye in zip(("left", "right"), (1, -1), self.eyes, strict=True):
            found |= self._eye(side, sign, eye)
            found |= self._brow(side, sign, eye)
            level = self.skin & (np.abs(below - 0.25) < 0.45)
            level = level if level.any() else self.skin
            reach = np.where(level, sign * x[:, 0], -np.inf)
            ear = x[reach > reach.max() - 0.012].mean(0)
            far = np.linalg.norm(x - ear, axis=1)
            found[f"{side}_ear"] = int(np.where(self.skin, far, np.inf).argmin())
        ring = [self.at(*point) for point in self._lips()]
        found |= {f"mouth_outer_{k}": vertex for k, vertex in enumerate(ring)}
        return found | {"mouth_left": ring[0], "mouth_right": ring[LIP_POINTS // 2]}

    def _eye(self, side: str, sign: int, eye: Array) -> dict[str, int]:
        """The lids bound what is seen of the eyeball."""
        d = self.d
        bone = f"{side.capitalize()}Eye"

        inner = eye[0] - sign * 0.23 * d
        outer = eye[0] + sign * 0.23 * d
        upper = eye[2] + 0.08 * d
        lower = eye[2] - 0.07 * d
        if bone in self.c.bones:
            ball = self.c.with_descendants(self.c.bones.index(bone))
            seen = np.isin(self.main[self.vertex], ball) & (self.vertex >= 0)
            if seen.any():
                rows, columns = np.nonzero(seen)
                left = self.x[columns.max()]
                right = self.x[columns.min()]
                inner, outer = (right, left) if sign > 0 else (left, right)
                middle = rows[np.abs(self.x[columns] - (left + right) / 2) < 0.1 * d]
                upper = self.z[middle.min()]
                lower = self.z[middle.max()]
        centre = (inner + outer) / 2
        corner = (upper + lower) / 2
        edge = 2 * STEP  # on the lid, not on the ball
        found = {
            "inner": self.at(inner - sign * edge, corner - 0.02 * d),
            "outer": self.at(outer + sign * edge, corner),
            "upper": self.at(centre, upper + edge),
            "lower": self.at(centre, lower - edge),
        }
        named = {f"{side}_lid_{name}": vertex for name, vertex in found.items()}
        return named | {
            f"{side}_eye": self.at(centre, corner),
            f"{side}_eye_inner": found["inner"],
            f"{side}_eye_outer": found["outer"],
        }

    def _brow(self, side: str, sign: int, eye: Array) -> dict[str, int]:
        """The darkest height above the eye, near where a brow usually is."""
        x = eye[0] + sign * np.linspace(-0.28, 0.42, BROW_POINTS) * self.d
        usual = eye[2] + np.array([0.25, 0.31, 0.34, 0.31, 0.24]) * self.d
        height = usual.copy()
        for k in range(BROW_POINTS):
            column = np.abs(self.x - x[k]).argmin()
            strip = self.lab[:, max(column - 4, 0) : column + 5, 0].mean(1)
            smooth = np.convolve(strip, np.ones(7) / 7, "same")
            away = (self.z - usual[k]) / (0.14 * self.d)
            free = (np.abs(away) < 1) & ~self.hair[:, column]
            height[k] = self.z[
                np.where(free, smooth + 8 * away**2, 1000 + np.abs(away)).argmin()
            ]
        # a brow has no jumps
        middle = np.median(height - usual)
        most = 0.06 * self.d
        height = usual + np.clip(height - usual, middle - most, middle + most)
        return {
            f"{side}_brow_{k}": self.at(x[k], height[k]) for k in range(BROW_POINTS)
        }

    def _lips(self) -> list[tuple[float, float]]:
        """Points (x, z) round the lips, from the left corner over the upper lip."""
        d = self.d
        mid = self.mid
        half = 0.38 * d
        centre = mid[0]
        line = np.full(len(self.x), mid[2] - 1.08 * d)
        if self.drop is not None:
            region = (self.z < mid[2] - 0.7 * d)[:, None] & (
                np.abs(self.x - mid[0]) < 0.7 * d
            )
            jump = np.diff(self.drop, axis=0, append=self.drop[-1:]) * region
            slit = jump > 0.1 * jump.max()
            if slit.any():
                columns = np.flatnonzero(slit.any(0))
                line = np.interp(
                    self.x, self.x[columns], self.z[jump.argmax(0)[columns]]
                )
                half = (self.x[columns[-1]] - self.x[columns[0]]) / 2
                centre = (self.x[columns[-1]] + self.x[columns[0]]) / 2
        points = []
        for k in range(LIP_POINTS):
            angle = 2 * np.pi * k / LIP_POINTS
            x = centre + half * np.cos(angle)
            rise = np.sin(angle)
            thickness = (0.11 if rise > 0 else 0.14) * d
            points.append((x, float(np.interp(x, self.x, line)) + thickness * rise))
        return points


def _nearest(c: Character, among: Ints, target: Array, joint: int) -> tuple[int, int]:
    """The nearest of some vertices as (-1, vertex), or a joint where there are none."""
    if len(among) == 0:
        return joint, -1
    return -1, int(among[np.linalg.norm(c.vertices[among] - target, axis=1).argmin()])
