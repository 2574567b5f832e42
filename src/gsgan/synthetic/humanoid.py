"""Bone and face shape names of common rigs, as those of Mixamo and a canonical set of shapes."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

import numpy as np

from gsgan.motion.rig import FINGERS, SIDES
from gsgan.motion.rotations import Array

LIMBS = ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot")
REQUIRED = ("Hips", "Spine", "Head", *(side + limb for side in SIDES for limb in LIMBS))
BONES = (
    *REQUIRED,
    *("Spine1", "Spine2", "Neck", "Jaw"),
    *(side + name for side in SIDES for name in ("Shoulder", "ToeBase", "ToeEnd", "Eye")),
    *(f"{side}Hand{finger}{k}" for side in SIDES for finger in FINGERS for k in (1, 2, 3, 4)),
)
CANONICAL = {bone.lower(): bone for bone in BONES}


def mixamo_bone(name: str) -> str | None:
    """Mixamo's name without prefix of a bone, None for other bones."""
    plain = re.sub(r"^.*[:|]|^mixamorig\d*_?|[ _.-]", "", name)
    return CANONICAL.get(re.sub(r"^mixamorig\d*", "", plain).lower())


def humanoid_bones(names: Iterable[str | None]) -> dict[int, str]:
    """Node number → Mixamo's bone name, of a document's node names."""
    found: dict[str, int] = {}
    for node, name in enumerate(names):
        if bone := mixamo_bone(name or ""):
            found.setdefault(bone, node)
    return {node: bone for bone, node in found.items()}


def _choices(table: str) -> dict[str, tuple[dict[str, float], ...]]:
    """Canonical shape → choices, of lines ``shape: name, 0.5*name+name``.

    ``{side}`` stands for left and right, ``{S}`` for l and r.
    """
    shapes = {}
    for line in table.strip().splitlines():
        shape, names = (part.strip() for part in line.split(":"))
        for side in ("left", "right") if "{" in names else ("",):
            whole = f"{shape}_{side}" if side else shape
            sums = [{plain_shape(whole): 1.0}]
            for choice in names.format(S=side[:1], side=side).split(","):
                terms = [term.strip().split("*") for term in choice.split("+")]
                sums.append({term[-1]: float(term[0]) if term[1:] else 1.0 for term in terms})
            shapes[whole] = tuple(sums)
    return shapes


def plain_shape(name: str) -> str:
    """A shape's name in lower case without separators, prefix and VALID's suffix."""
    name = re.sub(r"^.*(?=Fcl_)|^t_|_h$", "", name.split(".")[-1])
    return re.sub(r"[ _-]", "", name).lower()


# What a canonical shape is made of, best choice first: names as `plain_shape` writes them, of
# gsgan's own avatars (always the first choice), VALID, ARKit, Ready Player Me and VRoid.
SHAPES = _choices("""
    mouth_open: jawopen, mouthopen, fclmtha
    mouth_round: kiss, mouthpucker, fclmthu
    mouth_wide: tdi, mouthstretchleft+mouthstretchright, fclmthi
    lips_pressed: mpbup+mpbdown, mouthpressleft+mouthpressright, fclmthclose
    smile: {S}smileclose, mouthsmile{side}, 0.5*mouthsmile, 0.5*fclmthjoy
    frown: {S}mouthsad, mouthfrown{side}, 0.5*fclmthsorrow
    puff: {S}blow, 0.5*cheekpuff
    blink: {S}eyeclose, eyeblink{side}, fcleyeclose{S}
    wide: {S}eyeopen, eyewide{side}
    squint: {S}squint, eyesquint{side}
    brow_up: {S}browup+{S}{S}browup, browouterup{side}+0.5*browinnerup, 0.5*fclbrwsurprised
    brow_down: {S}browdown+{S}{S}browdown, browdown{side}, 0.5*fclbrwangry
""")
WANTED = {name for choices in SHAPES.values() for choice in choices for name in choice}


def canonical_shapes(found: Mapping[str, Array]) -> dict[str, Array]:
    """The canonical shapes ``[V, 3]`` that a file's own shapes can make."""
    shapes = {}
    for shape, choices in SHAPES.items():
        for choice in choices:
            if all(name in found for name in choice):
                total = np.sum([weight * found[name] for name, weight in choice.items()], 0)
                if np.abs(total).max() > 0:
                    shapes[shape] = total
                break
    return shapes
