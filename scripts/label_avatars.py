"""Labels and landmarks of the avatars that come with gsgan, from their shapes and colours.

Run it after `scripts/bake_avatars.py`: `python scripts/label_avatars.py` writes a .npz beside each
avatar. A user's own character is labelled by names and bones alone, and its face by proportions
(`gsgan.synthetic.parts`, `gsgan.synthetic.anchors`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import cv2
import numpy as np
import trimesh
from scipy.spatial import cKDTree
from trimesh.graph import connected_component_labels

from gsgan.motion.character import Character, Ints
from gsgan.motion.rig import SIDES
from gsgan.motion.rotations import Array
from gsgan.skeleton.face import BROW_POINTS, LIP_POINTS
from gsgan.synthetic.anchors import with_anchors
from gsgan.synthetic.gltf import AVATARS, read_character
from gsgan.synthetic.parts import LABEL, LABEL_NAMES, SHOES
from gsgan.synthetic.trace import Tracer

HAIR, FACE, UPPER, LOWER = (LABEL[k] for k in LABEL_NAMES[1:5])
# A bone, and all below it without an entry: the label of cloth there, and of bare skin there.
OF_BONE = {
    "Hips": ("lower_clothes", "lower_clothes"),
    "Spine": ("upper_clothes", "face_neck"),
    "Neck": ("upper_clothes", "face_neck"),
    "Head": ("face_neck", "face_neck"),
    "Arm": ("upper_clothes", "{}_arm"),
    "Hand": ("{}_hand", "{}_hand"),
    "UpLeg": ("lower_clothes", "{}_leg"),
    "Foot": ("{}_shoe", "{}_shoe"),
}
SKIN_DISTANCE = 22.0  # CIELAB, lightness counted half: below it a face has the skin's colour
HAIR_DISTANCE = 12.0  # a crown nearer to the skin's colour is a bald one
GARMENT_DISTANCE = 8.0  # garments nearer in colour are told apart by bones
TRUNK = ("Spine1", "Spine2", "LeftArm", "RightArm")
SHANKS = ("LeftLeg", "RightLeg")
BETWEEN = ("Hips", "Spine", "LeftUpLeg", "RightUpLeg")
CHEST = 0.16  # metres below the shoulders: skin above is the neck's, below the trunk's


def face_labels(c: Character) -> Ints:
    """``[F]`` the part of each face, at least 1.

    Bones decide which limb a face is on, and its colour whether it is skin, hair or cloth; pieces
    of cloth (connected vertices) are then upper or lower clothes or a shoe as a whole.
    """
    corner = c.faces[:, 0]
    bone = c.dominant_bones()[corner]
    cloth, skin, root = (rows[bone] for rows in _bone_labels(c))
    lab = _lab(c)
    corners = c.vertices[c.faces]
    centre, area = corners.mean(1), trimesh.triangles.area(corners)
    shoulders = c.joints[_numbers(c, ("LeftArm", "RightArm")), 2].min()
    low = (skin == FACE) & (root == "Spine") & (centre[:, 2] < shoulders - CHEST)
    skin = np.where(low, UPPER, skin)

    head, neck = root == "Head", c.joints[c.bones.index("Head"), 2]
    cheeks = float(neck + 0.35 * (c.vertices[:, 2].max() - neck))
    front = head & (c.normals[corner, 1] < -0.6) & (np.abs(centre[:, 2] - cheeks) < 0.05)
    tone = np.median(lab[front] if front.any() else lab, 0)
    bare = _voted(c, np.linalg.norm(lab - tone, axis=1) < SKIN_DISTANCE)
    labels = np.where(bare, skin, cloth)
    upper, lower = (
        _tone(lab, ~bare & np.isin(bone, _numbers(c, bones)), tone) for bones in (TRUNK, SHANKS)
    )
    if np.linalg.norm(upper - lower) > GARMENT_DISTANCE:
        nearer = np.linalg.norm(lab - upper, axis=1) < np.linalg.norm(lab - lower, axis=1)
        between = ~bare & np.isin(bone, _numbers(c, BETWEEN))
        labels = np.where(between, np.where(_voted(c, nearer), UPPER, LOWER), labels)

    right = np.array([name.startswith("Right") for name in c.bones])[bone]
    near = head | (root == "Neck")
    labels = np.where(_hair(c, lab, np.array([tone, upper]), near, centre), HAIR, labels)
    shoes = np.where(right, *SHOES[::-1])
    return _whole_garments(c, labels, shoes, area)


def _numbers(c: Character, bones: tuple[str, ...]) -> list[int]:
    return [c.bones.index(bone) for bone in bones if bone in c.bones]


def _tone(lab: Array, at: np.ndarray, default: Array) -> Array:
    return cast(Array, np.median(lab[at], 0)) if at.any() else default


def _bone_labels(c: Character) -> tuple[Ints, Ints, np.ndarray]:
    """``[J]`` labels of cloth and of skin on each bone, and the bone of ``OF_BONE`` it is below."""
    rows: list[tuple[int, int, str]] = []
    for bone, parent in zip(c.bones, c.parents, strict=True):
        side = next((s for s in ("Left", "Right") if bone.startswith(s)), "")
        entry = OF_BONE.get(bone[len(side) :])
        if entry:
            cloth, skin = (LABEL[name.format(side.lower())] for name in entry)
            rows.append((cloth, skin, bone[len(side) :]))
        else:
            rows.append(rows[parent] if parent >= 0 else (LOWER, LOWER, "Hips"))
    labels = np.array([row[:2] for row in rows])
    return labels[:, 0], labels[:, 1], np.array([row[2] for row in rows])


def texture_lab(c: Character, uv: Array, material: Ints) -> Array:
    """``[N, 3]`` CIELAB colours of the materials ``[N]`` at texture coordinates ``[N, 2]``."""
    colour = np.zeros((len(uv), 3))
    for m, surface in enumerate(c.surfaces):
        at = material == m
        h, w = surface.colour.shape[:2]
        x, y = np.minimum(uv[at] % 1 * (w, h), (w - 1, h - 1)).astype(int).T
        colour[at] = surface.colour[y, x, :3] / 255
    lab = cv2.cvtColor(colour[:, None].astype(np.float32), cv2.COLOR_RGB2LAB)[:, 0]
    return lab.astype(np.float64)


def _lab(c: Character) -> Array:
    """``[F, 3]`` CIELAB colour of each face, lightness halved: the mean of four points."""
    points = np.vstack([np.full((1, 3), 1 / 3), 0.2 + 0.4 * np.eye(3)])
    uv = np.einsum("pk,fkd->pfd", points, c.uv[c.faces])
    lab = np.mean([texture_lab(c, at, c.material) for at in uv], 0)
    return lab * np.array([0.5, 1, 1])


def _neighbours(c: Character) -> Ints:
    """``[E, 2]`` pairs of faces with a common edge, vertices at one place taken as one."""
    _, place = np.unique(np.round(c.vertices, 5), axis=0, return_inverse=True)
    return trimesh.graph.face_adjacency(faces=place.reshape(-1)[c.faces])


def _voted(c: Character, flag: np.ndarray, rounds: int = 4) -> np.ndarray:
    """A flag of faces without its specks: the majority of each face and its neighbours."""
    pairs = _neighbours(c)
    for _ in range(rounds):
        votes = 2.0 * flag - 1
        total = votes.copy()
        np.add.at(total, pairs[:, 0], votes[pairs[:, 1]])
        np.add.at(total, pairs[:, 1], votes[pairs[:, 0]])
        flag = total > 0
    return flag


def _hair(c: Character, lab: Array, others: Array, near: np.ndarray, centre: Array) -> np.ndarray:
    """Faces of the scalp's hair: nearer to the crown's colours than to others, connected."""
    head = c.joints[c.bones.index("Head"), 2]
    crown = near & (centre[:, 2] > head + 0.8 * (c.vertices[:, 2].max() - head))
    far = np.linalg.norm(lab[crown] - others[0], axis=1)
    if not crown.any() or np.median(far) < HAIR_DISTANCE:
        return np.zeros_like(crown)
    palette = lab[crown][far > HAIR_DISTANCE]  # strands and highlights
    to_hair, _ = cKDTree(palette[:: max(1, len(palette) // 64)]).query(lab)
    to_others, _ = cKDTree(others).query(lab)
    like = _voted(c, (near & (to_hair < to_others)) | crown, 2) & near
    pairs = _neighbours(c)
    parts = connected_component_labels(pairs[like[pairs].all(1)], len(like))
    hair = like & np.isin(parts, np.unique(parts[crown & like]))
    # small islands within the hair are hair: highlights, and shadows of strands
    rest = connected_component_labels(pairs[~hair[pairs].any(1)], len(like))
    edge = pairs[hair[pairs].sum(1) == 1]
    touching = np.unique(rest[edge[~hair[edge]]])
    sizes = np.bincount(rest[~hair], minlength=rest.max() + 1)
    small = touching[sizes[touching] < 0.1 * hair.sum()]
    return hair | (~hair & np.isin(rest, small) & near)


def _whole_garments(c: Character, labels: Ints, shoes: Ints, area: Array) -> Ints:
    """Each piece of cloth gets the label of most of its area."""
    edges = np.concatenate([c.faces[:, [0, 1]], c.faces[:, [1, 2]]])
    piece = connected_component_labels(edges, len(c.vertices))[c.faces[:, 0]]
    kind = np.select([labels == UPPER, labels == LOWER, np.isin(labels, SHOES)], [0, 1, 2], -1)
    cloth = kind >= 0
    total = np.zeros((piece.max() + 1, 3))
    np.add.at(total, (piece[cloth], kind[cloth]), area[cloth])
    share = total / np.maximum(total.sum(1, keepdims=True), 1e-12)
    winner = np.where(share.max(1) > 0.85, share.argmax(1), -1)[piece]
    changed = cloth & (winner >= 0) & (winner != kind)
    return np.where(changed, np.choose(np.maximum(winner, 0), [UPPER, LOWER, shoes]), labels)


STEP = 0.0005  # metres between the rays cast at the face


class _Face:
    """The front of the head as a map of rays: first hit, its colour, its bone."""

    def __init__(self, c: Character, main: Ints) -> None:
        self.c, self.main = c, main
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
            if np.linalg.norm(eyes[0] - eyes[1]) > 0.03:  # some rigs put both at the head's joint
                return eyes
        head, x = c.joints[self.head], c.vertices[self.skin]
        height = head[2] + 0.45 * (c.vertices[:, 2].max() - head[2])
        return np.array([[head[0] + s * 0.033, x[:, 1].min() + 0.03, height] for s in (1, -1)])

    def _look(self) -> None:
        """Rays along +Y through a grid: ``vertex [h, w]`` nearest to each hit, -1 for none."""
        c, d = self.c, self.d
        self.x = np.arange(-1.2 * d, 1.2 * d, STEP) + self.mid[0]
        self.z = np.arange(0.9 * d, -1.9 * d, -STEP) + self.mid[2]
        grid = np.stack(np.meshgrid(self.x, self.z), -1).reshape(-1, 2)
        start = np.c_[grid[:, 0], np.full(len(grid), c.vertices[:, 1].min() - 1), grid[:, 1]]
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
        self.drop = None if opened is None else -(share * opened[corners, 2]).sum(1).reshape(shape)

    def at(self, x: float, z: float) -> int:
        """The vertex seen at a place of the face; the nearest on its skin beside the map."""
        row, column = np.abs(self.z - z).argmin(), np.abs(self.x - x).argmin()
        if (vertex := int(self.vertex[row, column])) >= 0:
            return vertex
        far = np.linalg.norm(self.c.vertices[:, [0, 2]] - [x, z], axis=1)
        return int(np.where(self.skin, far, np.inf).argmin())

    def vertices(self) -> dict[str, int]:
        """Landmark → vertex."""
        x, d, mid = self.c.vertices, self.d, self.mid
        found = {}
        below = (mid[2] - x[:, 2]) / d
        nose = self.skin & (np.abs(x[:, 0] - mid[0]) < 0.2 * d) & (below > 0.1) & (below < 1)
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
        d, bone = self.d, f"{side.capitalize()}Eye"
        inner, outer, upper, lower = (
            eye[0] - sign * 0.23 * d, eye[0] + sign * 0.23 * d, eye[2] + 0.08 * d,
            eye[2] - 0.07 * d)  # fmt: skip
        if bone in self.c.bones:
            ball = self.c.with_descendants(self.c.bones.index(bone))
            seen = np.isin(self.main[self.vertex], ball) & (self.vertex >= 0)
            if seen.any():
                rows, columns = np.nonzero(seen)
                left, right = self.x[columns.max()], self.x[columns.min()]
                inner, outer = (right, left) if sign > 0 else (left, right)
                middle = rows[np.abs(self.x[columns] - (left + right) / 2) < 0.1 * d]
                upper, lower = self.z[middle.min()], self.z[middle.max()]
        centre = (inner + outer) / 2
        corner = (upper + lower) / 2
        edge = 2 * STEP  # on the lid, not on the ball
        found = {"inner": self.at(inner - sign * edge, corner - 0.02 * d),
                 "outer": self.at(outer + sign * edge, corner),
                 "upper": self.at(centre, upper + edge),
                 "lower": self.at(centre, lower - edge)}  # fmt: skip
        named = {f"{side}_lid_{name}": vertex for name, vertex in found.items()}
        return named | {f"{side}_eye": self.at(centre, corner),
                        f"{side}_eye_inner": found["inner"],
                        f"{side}_eye_outer": found["outer"]}  # fmt: skip

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
            height[k] = self.z[np.where(free, smooth + 8 * away**2, 1000 + np.abs(away)).argmin()]
        middle, most = np.median(height - usual), 0.06 * self.d  # a brow has no jumps
        height = usual + np.clip(height - usual, middle - most, middle + most)
        return {f"{side}_brow_{k}": self.at(x[k], height[k]) for k in range(BROW_POINTS)}

    def _lips(self) -> list[tuple[float, float]]:
        """Points (x, z) round the lips, from the left corner over the upper lip."""
        d, mid = self.d, self.mid
        half, centre = 0.38 * d, mid[0]
        line = np.full(len(self.x), mid[2] - 1.08 * d)
        if self.drop is not None:
            region = (self.z < mid[2] - 0.7 * d)[:, None] & (np.abs(self.x - mid[0]) < 0.7 * d)
            jump = np.diff(self.drop, axis=0, append=self.drop[-1:]) * region
            slit = jump > 0.1 * jump.max()
            if slit.any():
                columns = np.flatnonzero(slit.any(0))
                line = np.interp(self.x, self.x[columns], self.z[jump.argmax(0)[columns]])
                half = (self.x[columns[-1]] - self.x[columns[0]]) / 2
                centre = (self.x[columns[-1]] + self.x[columns[0]]) / 2
        points = []
        for k in range(LIP_POINTS):
            angle = 2 * np.pi * k / LIP_POINTS
            x, rise = centre + half * np.cos(angle), np.sin(angle)
            thickness = (0.11 if rise > 0 else 0.14) * d
            points.append((x, float(np.interp(x, self.x, line)) + thickness * rise))
        return points


def main() -> None:
    for path in AVATARS.values():
        c = read_character(path)
        c = with_anchors(replace(c, labels=face_labels(c)))
        names, vertex = list(c.anchor_names), c.anchor_vertex.copy()
        for name, found in _Face(c, c.dominant_bones()).vertices().items():
            vertex[names.index(name)] = found
        np.savez_compressed(
            path.with_suffix(".npz"),
            labels=c.labels.astype(np.uint8),
            anchor_joint=c.anchor_joint.astype(np.int16),
            anchor_vertex=vertex.astype(np.int32),
        )
        print(path.with_suffix(".npz").name)


if __name__ == "__main__":
    main()
