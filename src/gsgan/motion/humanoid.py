"""Bone and face shape names of common rigs, as those of Mixamo and a canonical set of shapes."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from itertools import chain
from typing import Any

import numpy as np

from gsgan.motion.rig import FINGERS, SIDES
from gsgan.motion.rotations import Array

# Mixamo's names of bones; those of limbs, side and fingers follow "Left" or "Right".
LIMB_BONES = ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot")
SIDE_BONES = ("Shoulder", "ToeBase", "ToeEnd", "Eye")
FINGER_BONE_NAMES = [
    f"Hand{finger}{k}" for finger in FINGERS for k in (1, 2, 3, 4)
]


def _on_both_sides(names: Iterable[str]) -> list[str]:
    return [side + name for side in SIDES for name in names]


REQUIRED_BONES = ("Hips", "Spine", "Head", *_on_both_sides(LIMB_BONES))
HUMANOID_BONES = (
    *REQUIRED_BONES,
    "Spine1",
    "Spine2",
    "Neck",
    "Jaw",
    *_on_both_sides(SIDE_BONES),
    *_on_both_sides(FINGER_BONE_NAMES),
)
# The number that ends a name: files of Sketchfab give one of its own to each.
NUMBER = re.compile(r"_\d+$")
# The first and the last word of a name of several words, and the share of names from which a word
# is no part of the bones' names: Robot_Hips, hips_joint.
FIRST_WORD = re.compile(r"^([^\W_]+)[\W_]+(?=[^\W_])")
LAST_WORD = re.compile(r"(?<=[^\W_])[\W_]+([^\W_]+)$")
SHARED = 0.6
WHOLE = 12  # names of a whole rig, and not of a hand
# Words that tell which rig or side it is.
TELLING = re.compile(r"l|r|left|right|j|bip\d*|cc|def", re.IGNORECASE)
# Mixamo's names by their lower-case form.
CANONICAL = {bone.lower(): bone for bone in HUMANOID_BONES}

# Mixamo's names by VRM's; those of limbs without the side.
VRM_LIMBS = {
    "shoulder": "Shoulder",
    "upperArm": "Arm",
    "lowerArm": "ForeArm",
    "hand": "Hand",
    "upperLeg": "UpLeg",
    "lowerLeg": "Leg",
    "foot": "Foot",
    "toes": "ToeBase",
    "eye": "Eye",
}
VRM_BONES = {
    "hips": "Hips",
    "spine": "Spine",
    "chest": "Spine1",
    "upperChest": "Spine2",
    "neck": "Neck",
    "head": "Head",
    "jaw": "Jaw",
}


def vrm_bone(name: str, version: int) -> str | None:
    """Mixamo's name of a humanoid bone of VRM; ``version`` 0 or 1 (thumbs differ)."""
    if name in VRM_BONES:
        return VRM_BONES[name]
    # VRM's names of limbs begin with a side.
    side = "Left" if name.startswith("left") else "Right"
    rest = name[len(side) :]
    limb = rest[:1].lower() + rest[1:]
    if limb in VRM_LIMBS:
        return side + VRM_LIMBS[limb]

    # Fingers have numbered segments in Mixamo's names.
    match = re.fullmatch(
        r"(\w+?)(Metacarpal|Proximal|Intermediate|Distal)", rest
    )
    if match is None:
        return None

    # VRM 1 names the bones of the thumb Metacarpal, Proximal and Distal.
    finger = {"Little": "Pinky"}.get(match[1], match[1])
    segments = ["Proximal", "Intermediate", "Distal"]
    if finger == "Thumb" and version == 1:
        segments = ["Metacarpal", "Proximal", "Distal"]
    return f"{side}Hand{finger}{segments.index(match[2]) + 1}"


def plain_names(names: Iterable[str | None]) -> list[str]:
    """Names without the numbers and the words that programs add to those of all joints."""
    plain = [name or "" for name in names]
    enough = SHARED * sum(map(bool, plain))
    numbers = {match[0] for match in map(NUMBER.search, plain) if match}
    if len(numbers) > enough:
        plain = [NUMBER.sub("", name) for name in plain]

    # Word by word, from both ends.
    for pattern in (FIRST_WORD, LAST_WORD):
        while len(plain) >= WHOLE:
            words = [match and match[1] for match in map(pattern.search, plain)]
            ((word, count),) = Counter(words).most_common(1)
            if word is None or count <= enough or TELLING.fullmatch(word):
                break
            plain = [
                pattern.sub("", name) if plain_name == word else name
                for name, plain_name in zip(plain, words, strict=True)
            ]
    return plain


def mixamo_bone(name: str) -> str | None:
    """Mixamo's name without prefix of a bone, None for other bones."""
    # Without namespaces and separators.
    plain = re.sub(r"^.*[:|]|^mixamorig\d*_?|[ _.-]", "", name)
    return CANONICAL.get(re.sub(r"^mixamorig\d*", "", plain).lower())


def humanoid_bones(
    names: Iterable[str | None], extensions: Mapping[str, Any]
) -> dict[int, str]:
    """Node number → Mixamo's bone name, of a document's node names and extensions."""
    version_1 = extensions.get("VRMC_vrm") or extensions.get(
        "VRMC_vrm_animation"
    )
    if version_1:
        # Version 1 lists bones by name, version 0 as a list.
        bones = version_1["humanoid"]["humanBones"]
        pairs = [
            (bone["node"], vrm_bone(name, 1)) for name, bone in bones.items()
        ]
    elif "VRM" in extensions:
        bones = extensions["VRM"]["humanoid"]["humanBones"]
        pairs = [(bone["node"], vrm_bone(bone["bone"], 0)) for bone in bones]
    else:
        plain = plain_names(names)
        pairs = [(node, mixamo_bone(name)) for node, name in enumerate(plain)]

    # The first node of each bone counts.
    nodes_of_bones: dict[str, int] = {}
    for node, bone in pairs:
        if bone is not None:
            nodes_of_bones.setdefault(bone, node)
    return {node: bone for bone, node in nodes_of_bones.items()}


def _choices(table: str) -> dict[str, tuple[dict[str, float], ...]]:
    """Canonical shape → choices, of lines ``shape: name, 0.5*name+name``.

    ``{side}`` stands for left and right, ``{S}`` for l and r.
    """
    shapes = {}
    for line in table.strip().splitlines():
        shape, choices = line.split(":")
        shape = shape.strip()
        if "{" not in choices:
            shapes[shape] = _sums(shape, choices)
            continue
        for side in ("left", "right"):
            sided = f"{shape}_{side}"
            shapes[sided] = _sums(sided, choices.format(S=side[0], side=side))
    return shapes


def _sums(shape: str, choices: str) -> tuple[dict[str, float], ...]:
    """Weights of each choice's terms by name; the first choice is the shape's own name."""
    sums = [{plain_shape(shape): 1.0}]
    for choice in choices.split(","):
        weights = {}
        for term in choice.split("+"):
            weight, _, name = term.strip().rpartition("*")
            weights[name] = float(weight or 1)
        sums.append(weights)
    return tuple(sums)


def plain_shape(name: str) -> str:
    """A shape's name in lower case without separators, prefix and VALID's suffix."""
    name = re.sub(r"^.*(?=Fcl_)|^t_|_h$", "", name.split(".")[-1])
    return re.sub(r"[ _-]", "", name).lower()


# The sums that make a canonical shape, best choice first: names as `plain_shape` writes them, of
# gsgan's own avatars (always the first choice), VALID, ARKit, Ready Player Me and VRoid.
PART_SHAPES = _choices("""
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
WANTED: set[str] = set()
for _choice in chain.from_iterable(PART_SHAPES.values()):
    WANTED.update(_choice)


def canonical_shapes(file_shapes: Mapping[str, Array]) -> dict[str, Array]:
    """The canonical shapes ``[V, 3]`` that a file's own shapes can make."""
    shapes = {}
    for shape, choices in PART_SHAPES.items():
        for choice in choices:
            if not choice.keys() <= file_shapes.keys():
                continue
            # The first choice that the file has all terms of is taken, unless it is empty.
            terms = [
                weight * file_shapes[name] for name, weight in choice.items()
            ]
            total = np.sum(terms, axis=0)
            if np.abs(total).max() > 0:
                shapes[shape] = total
            break
    return shapes
