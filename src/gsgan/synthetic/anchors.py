"""Landmarks of a character: joints, and vertices by the proportions of a body at rest."""

from dataclasses import replace

import numpy as np

from gsgan.body.free import free_body
from gsgan.motion.character import Character, Ints
from gsgan.motion.rig import FINGERS, SIDES
from gsgan.motion.rotations import Array, unit
from gsgan.skeleton.face import BROW_POINTS, FACE_NAMES, LIP_POINTS
from gsgan.synthetic.parts import LABEL_NAMES

JOINTS = {"shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand", "hip": "UpLeg", "knee": "Leg",
          "ankle": "Foot", "thumb": "HandThumb2", "index": "HandIndex1",
          "pinky": "HandPinky1"}  # fmt: skip
SEGMENTS = ("mcp", "pip", "dip", "tip")
THUMB = ("cmc", "mcp", "ip", "tip")
# Thumb to pinky: first joint, step to the next, offset to the thumb's side, in hand lengths.
ABSENT_FINGERS = ((0.2, 0.13, 0.35), (0.5, 0.15, 0.18), (0.5, 0.17, 0.05), (0.5, 0.15, -0.08),
                  (0.45, 0.13, -0.2))  # fmt: skip
# Of the left half of a face: to the left and upwards from between the eyes, in their distance.
LIDS = {"inner": (0.27, 0.0), "outer": (0.73, 0.0), "upper": (0.5, 0.08), "lower": (0.5, -0.07)}
BROW = tuple(zip(np.linspace(0.22, 0.92, BROW_POINTS), (0.25, 0.31, 0.34, 0.31, 0.24), strict=True))
MOUTH = (0.38, -1.08, 0.11, 0.14)  # half its width, its height, thickness of the lips
Anchors = dict[str, tuple[int, int]]  # landmark → joint and vertex, one of them -1


def anchor_names() -> tuple[str, ...]:
    """Names of a character's landmarks: 33 of MediaPipe's pose, 42 of the hands, 30 of the face."""
    body = free_body()
    return (*body.landmark_names, *body.hand_names, *FACE_NAMES)


def with_anchors(c: Character) -> Character:
    """The character with 33 MediaPipe pose, 42 hand and 30 face landmarks.

    Body and hands are joints where bones exist. Those of the face are the vertices nearest to
    where eyes, lids, brows, lips, nose and ears usually are.
    """
    main = c.dominant_bones()
    found: Anchors = {}
    for side in SIDES:
        found |= _limb_anchors(c, main, side)
    found |= {name: (-1, vertex) for name, vertex in _face(c, main).items()}
    names = anchor_names()
    pairs = np.array([found[name] for name in names], dtype=np.int64)
    return replace(c, anchor_names=names, anchor_joint=pairs[:, 0], anchor_vertex=pairs[:, 1])


def _limb_anchors(c: Character, main: Ints, side: str) -> Anchors:
    """Joints of arm, hand and leg, and vertices of foot, finger tips and absent fingers."""
    low = side.lower()
    found = {f"{low}_{name}": (c.bones.index(side + bone), -1) for name, bone in JOINTS.items()
             if side + bone in c.bones}  # fmt: skip
    hand = _hand(c, main, side)
    for name, knuckle in (("thumb", "thumb_mcp"), ("index", "index_mcp"), ("pinky", "pinky_mcp")):
        found.setdefault(f"{low}_{name}", hand[f"{low}_{knuckle}"])
    return found | hand | _foot(c, main, side)


def _hand(c: Character, main: Ints, side: str) -> Anchors:
    """Joints of the fingers, tips without a bone, and places on the hand of absent fingers."""
    found, at = {}, {bone: k for k, bone in enumerate(c.bones)}
    wrist = c.joints[at[f"{side}Hand"]]
    along = unit(wrist - c.joints[at[f"{side}ForeArm"]])
    ahead = unit(np.array([0, -1.0, 0]) + along * along[1])  # the thumb's side in a T pose
    hand = np.flatnonzero(np.isin(main, c.with_descendants(at[f"{side}Hand"])))
    length = float(((c.vertices[hand] - wrist) @ along).max()) if len(hand) else 0.0
    for finger, (first, step, across) in zip(FINGERS, ABSENT_FINGERS, strict=True):
        for k, part in enumerate(THUMB if finger == "Thumb" else SEGMENTS):
            bone, name = f"{side}Hand{finger}{k + 1}", f"{side.lower()}_{finger.lower()}_{part}"
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
    low, ankle = side.lower(), c.bones.index(f"{side}Foot")
    ball = c.bones.index(f"{side}ToeBase") if f"{side}ToeBase" in c.bones else ankle
    shod = np.zeros(len(main), bool)
    shod[c.faces[c.labels == LABEL_NAMES.index(f"{low}_shoe")]] = True  # no hem of the trousers
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
    return {f"{low}_heel": _nearest(c, foot, heel, ankle), f"{low}_foot_index": (-1, tip)}


def _face(c: Character, main: Ints) -> dict[str, int]:
    """Landmark → vertex."""
    x, head = c.vertices, c.bones.index("Head")
    on_head = np.isin(main, c.with_descendants(head))
    skin = np.zeros(len(x), bool)
    skin[c.faces[c.labels == LABEL_NAMES.index("face_neck")]] = True
    skin &= on_head
    if not skin.any():
        skin = on_head if on_head.any() else np.ones_like(on_head)
    eyes = _eyes(c, head, x[skin])
    d, middle = float(np.linalg.norm(eyes[0] - eyes[1])), eyes.mean(0)
    at = (x - middle)[:, [0, 2]] / d
    front = np.flatnonzero(skin & (x[:, 1] <= np.median(x[skin, 1])))

    def nearest(left: float, up: float) -> int:
        return int(front[np.linalg.norm(at[front] - (left, up), axis=1).argmin()])

    nose = skin & (np.abs(at[:, 0]) < 0.2) & (at[:, 1] < -0.1) & (at[:, 1] > -1)
    found = {"nose": int(np.where(nose, x[:, 1], np.inf).argmin())}
    for side, sign in (("left", 1), ("right", -1)):
        lids = {name: nearest(sign * left, up) for name, (left, up) in LIDS.items()}
        found |= {f"{side}_lid_{name}": vertex for name, vertex in lids.items()}
        found |= {f"{side}_eye_{name}": lids[name] for name in ("inner", "outer")}
        found[f"{side}_eye"] = nearest(sign * 0.5, 0)
        found |= {f"{side}_brow_{k}": nearest(sign * u, v) for k, (u, v) in enumerate(BROW)}
        level = skin & (np.abs(at[:, 1] + 0.25) < 0.45)
        level = level if level.any() else skin
        found[f"{side}_ear"] = int(np.where(level, sign * x[:, 0], -np.inf).argmax())
    half, height, upper, lower = MOUTH
    for k, angle in enumerate(2 * np.pi * np.arange(LIP_POINTS) / LIP_POINTS):
        rise = np.sin(angle) * (upper if np.sin(angle) > 0 else lower)
        found[f"mouth_outer_{k}"] = nearest(half * np.cos(angle), height + rise)
    corners = found["mouth_outer_0"], found[f"mouth_outer_{LIP_POINTS // 2}"]
    return found | dict(zip(("mouth_left", "mouth_right"), corners, strict=True))


def _eyes(c: Character, head: int, face: Array) -> Array:
    """``[2, 3]`` centres of the eyes: of their bones, else from the size of the head."""
    if {"LeftEye", "RightEye"} <= set(c.bones):
        eyes = c.joints[[c.bones.index(f"{side}Eye") for side in SIDES]]
        if np.linalg.norm(eyes[0] - eyes[1]) > 0.03:  # some rigs put both at the head's joint
            return eyes
    height = c.joints[head, 2] + 0.45 * (c.vertices[:, 2].max() - c.joints[head, 2])
    ahead = face[:, 1].min() + 0.03
    return np.array([[c.joints[head, 0] + s * 0.033, ahead, height] for s in (1, -1)])


def _nearest(c: Character, among: Ints, target: Array, joint: int) -> tuple[int, int]:
    """The nearest of some vertices as (-1, vertex), or a joint where there are none."""
    if len(among) == 0:
        return joint, -1
    return -1, int(among[np.linalg.norm(c.vertices[among] - target, axis=1).argmin()])
