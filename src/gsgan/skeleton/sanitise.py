"""Completes skeletons: unseen joints are filled in before any arithmetic."""

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from gsgan.skeleton.frames import bone_frames, hubs_of, palms_of, swings
from gsgan.skeleton.holistic import TEMPLATES
from gsgan.skeleton.template import (
    CHEST,
    HEAD,
    MEDIAPIPE33,
    N_HUBS,
    SkeletonTemplate,
)
from gsgan.skeleton.tensors import Constants, check_skeleton, constants
from gsgan.utils.tensors import constant, matvec

TEMPLATE_SIZES = {len(t.names) for t in TEMPLATES.values()}
MIN_TRUNK_JOINTS = 3
"""Number of shoulders and hips that must be seen: with fewer the trunk's frame is undefined."""


def limb_length_sum(
    p: Tensor,
    valid: Tensor | None = None,
    template: SkeletonTemplate = MEDIAPIPE33,
) -> Tensor:
    """The sum of limb lengths, h_body: a measure of the subject's size, the same in every pose.

    It is in metres, about 2.4 times the stature. Limbs with an unseen end are accounted for by
    their share of the rest skeleton's sum; with no limb seen the result is NaN, which a nanmedian
    over frames ignores.

    Args:
        p: ``[B, J, 3]`` metres; unseen joints may hold anything.
        valid: ``[B, J]`` bool or None.
        template: defines the limbs.

    Returns:
        ``[B]`` metres.

    Raises:
        ValueError: when a shape does not match the template.

    Source: ours; one constant per subject, the median over training frames.
    """
    valid = check_skeleton("limb_length_sum", p, valid, template)
    c = constants(template, p.device, p.dtype)
    starts = c.starts[c.measured]
    ends = c.ends[c.measured]

    # The sum over the limbs that are seen, divided by their share of the sum at rest.
    seen = valid.index_select(1, starts) & valid.index_select(1, ends)
    bones = p.index_select(1, ends) - p.index_select(1, starts)
    lengths = torch.where(seen.unsqueeze(-1), bones, 0.0).norm(dim=-1).sum(-1)
    rest = (c.rest[ends] - c.rest[starts]).norm(dim=-1)
    return lengths * rest.sum() / (seen * rest).sum(-1)


def sanitise(
    p: Tensor,
    visibility: Tensor | None = None,
    template: SkeletonTemplate = MEDIAPIPE33,
    limb_length_sum: Tensor | float | None = None,
) -> tuple[Tensor, Tensor]:
    """Fills in unseen joints and marks them.

    Units are metres in the world frame. A joint is unseen when a coordinate is NaN or infinite or
    its visibility is not above 0. One missing shoulder or hip is completed from the other three;
    two unseen hips keep finite positions, as estimates; a joint or landmark of the face is placed
    by the head's frame; any other joint at the end of its rest bone in its parent's frame.
    Filled-in joints move with the seen ones and pass gradients to them. Seen joints are returned
    unchanged. The check costs one device synchronisation.

    Args:
        p: ``[B, J, 3]``.
        visibility: ``[B, J]`` or None (all visible).
        template: defines the joints and the rest pose.
        limb_length_sum: the subject's h_body, see the function of that name, a number or ``[B]``,
            which scales the missing bones. None: from the seen limbs.

    Returns:
        ``p [B, J, 3]`` finite, and ``valid [B, J]`` bool.

    Raises:
        ValueError: on a wrong shape, or when too few shoulders and hips are seen, naming batch
            items and joints.

    Source: ours; the paper does not treat missing joints.
    """
    check_skeleton("sanitise", p, None, template)

    # Seen joints are finite and visible.
    valid = torch.isfinite(p).all(-1)
    if visibility is not None:
        if visibility.shape != valid.shape:
            raise ValueError(
                f"sanitise: visibility must have shape {list(valid.shape)}, "
                f"got {list(visibility.shape)}"
            )
        valid = valid & (visibility > 0)
    if bool(valid.all()):
        return p, valid

    # Estimated hips are used, but not marked as seen.
    placed = valid | _find_hips(p, valid, template)
    _refuse_without_trunk(placed, template)
    return _fill(p, placed, template, limb_length_sum), valid


def complete_skeleton(
    skeleton: Tensor,
    visibility: Tensor | None,
    template: SkeletonTemplate,
    limb_length_sum: float,
) -> tuple[Tensor, Tensor]:
    """Joints ``[B, J, 3]`` of a template, finite, and their visibility ``[B, J]``, 0 for stand-ins.

    Hands and a face that only the template has are marked as unseen; those that only
    the skeleton has are left out.

    Args:
        skeleton: ``[J, 3]`` or ``[B, J, 3]`` metres; NaN for joints not seen.
        visibility: ``[J]`` or ``[B, J]`` in [0, 1]; None: all seen.
        template, limb_length_sum: see `sanitise`.

    Raises:
        ValueError: as `sanitise` does.
    """
    J = len(template.names)
    p = skeleton.reshape(-1, *skeleton.shape[-2:]).to(torch.float32)
    shown = (
        torch.ones_like(p[..., 0]) if visibility is None else visibility.to(p)
    )
    shown = shown.reshape(-1, shown.shape[-1])

    # The joints of each template are the first ones of the next larger template.
    count = p.shape[1]
    if count != J and {count, J} <= TEMPLATE_SIZES:
        missing = (0, max(J - count, 0))
        p = pad(p[:, :J], (0, 0, *missing), value=torch.nan)
        shown = pad(shown[:, :J], missing)
    p, valid = sanitise(p, None, template, limb_length_sum)
    return p, valid * shown


def _find_hips(p: Tensor, valid: Tensor, template: SkeletonTemplate) -> Tensor:
    """``[B, J]`` bool: estimated hips of skeletons that show both shoulders and no hip.

    Hips are estimates if they are finite and apart: zeros are none.
    """
    hips = list(template.hips)
    left, right = template.hips

    # Both shoulders are seen, and the hips have finite places that differ.
    seen = valid[:, list(template.shoulders)].all(1) & ~valid[:, hips].any(1)
    apart = (p[:, left] != p[:, right]).any(1)
    finite = p[:, hips].isfinite().all((1, 2))
    estimated = torch.zeros_like(valid)
    estimated[:, hips] = (seen & apart & finite).unsqueeze(1)
    return estimated


def _refuse_without_trunk(valid: Tensor, template: SkeletonTemplate) -> None:
    """Raises a ValueError that names the missing joints of each skeleton without a trunk."""
    # Skeletons with too few joints of the trunk.
    trunk = valid[:, list(template.torso)]
    bad = (trunk.sum(-1) < MIN_TRUNK_JOINTS).nonzero().flatten().tolist()
    if not bad:
        return

    # The message names the joints that each of them lacks.
    lost = []
    for item in bad:
        names = [
            template.names[j] for j in template.torso if not valid[item, j]
        ]
        lost.append(f"item {item}: {', '.join(names)}")
    raise ValueError(
        f"sanitise: p needs {MIN_TRUNK_JOINTS} of the four shoulders and hips, but in "
        f"{len(bad)} of {len(valid)} skeletons too many are NaN or invisible "
        f"({'; '.join(lost)}); leave these frames out"
    )


def _fill(
    p: Tensor,
    valid: Tensor,
    template: SkeletonTemplate,
    known_sum: Tensor | float | None,
) -> Tensor:
    """Joints ``[B, J, 3]`` with the unseen ones placed, from the trunk outwards; ``known_sum`` is
    the subject's `limb_length_sum`."""
    c = constants(template, p.device, p.dtype)

    # The origin of the completion is a seen hip or shoulder. Unseen joints are masked before any
    # arithmetic, so that their values have no gradient.
    order = constant((*template.hips, *template.shoulders), p, torch.int64)
    first = order[valid.index_select(1, order).to(torch.uint8).argmax(-1)]
    root = p.gather(1, first[:, None, None].expand(-1, 1, 3)).detach()
    is_seen = valid.unsqueeze(-1)
    q = torch.where(is_seen, p, 0.0)
    q = torch.where(is_seen, q - root, 0.0)

    # The size of the subject relative to the template.
    if known_sum is None:
        scale = limb_length_sum(q, valid, template) / template.limb_length_sum
        scale = torch.where(scale.isnan(), 1.0, scale)
    else:
        scale = torch.as_tensor(known_sum, dtype=p.dtype, device=p.device)
        scale = (scale / template.limb_length_sum).expand(len(p))

    # Trunk and head. Joints that are placed later move none of their frames.
    q = _complete_trunk(q, valid, template, c)
    so_far = hubs_of(q, valid, c)
    q = _complete_face(q, valid, template, so_far, scale)

    # Limbs, level by level.
    for level, bones in zip(
        c.levels, _bones(template, p.device, p.dtype), strict=True
    ):
        if template.palms:  # their knuckles may have been placed
            hubs, _, limbs = so_far.tensor_split(
                (N_HUBS, template.n_hubs), dim=1
            )
            palms = palms_of(q, hubs[:, CHEST : CHEST + 1], c)
            so_far = torch.cat([hubs, palms, limbs], dim=1)

        # Joints at the ends of their rest bones.
        frames = so_far.index_select(1, bones.frames)
        bone = matvec(frames, bones.rest) * scale[:, None, None]
        q = _put(q, valid, bones.ends, q.index_select(1, bones.starts) + bone)
        if template.bare:
            # Two limbs for one bone, as from elbow to wrist, end at the same place.
            q = _put(q, valid, bones.bare, q.index_select(1, bones.same))

        # The frames of this level's limbs, for the next one.
        if level is not c.levels[-1]:
            parent = so_far.index_select(1, level.parents)
            starts = c.starts[level.limbs]
            ends = c.ends[level.limbs]
            directions = q.index_select(1, ends) - q.index_select(1, starts)
            so_far = torch.cat(
                [so_far, parent @ swings(directions, parent, level)], dim=1
            )
    return torch.where(is_seen, p, q + root)


class _Bones(NamedTuple):
    """A level's bones that place joints."""

    frames: Tensor  # [M] into the frames so far
    starts: Tensor  # [M]
    ends: Tensor  # [M]
    rest: Tensor  # [M, 3] metres, in these frames
    bare: Tensor  # [K] ends of bare limbs
    same: Tensor  # [K] and the joints in their places


@lru_cache(maxsize=64)
def _bones(
    template: SkeletonTemplate, device: torch.device, dtype: torch.dtype
) -> tuple[_Bones, ...]:
    """The bones of each level; tensors of inference mode could not be used for training later."""

    def index(values: list[int]) -> Tensor:
        return torch.tensor(values, dtype=torch.int64, device=device)

    # The rest skeleton and its frames, from which lengths and directions are taken.
    with torch.inference_mode(False), torch.no_grad():
        c = constants(template, device, dtype)
        at_rest = bone_frames(c.rest.unsqueeze(0), None, template)
        rest_frames = torch.cat([at_rest.hubs, at_rest.limbs], dim=1)[0]
        tree = set(template.incoming.values())
        level_bones = []
        for level, tensors in zip(template.levels, c.levels, strict=True):
            # The limbs that place the joint at their end, which another limb may share.
            placed = []
            parents = []
            bare = []
            same = []
            for k, limb in enumerate(level):
                if limb not in tree:
                    continue
                placed.append(k)
                parents.append(template.limb_parents[limb])
                if limb in template.bare:
                    bare.append(template.limbs[limb][1])
                    same.append(_same_bone(template, limb))

            # The bones at rest, in the frames of their parents.
            limbs = tensors.limbs[placed]
            starts = c.starts[limbs]
            ends = c.ends[limbs]
            bones = (c.rest[ends] - c.rest[starts]).unsqueeze(-1)
            level_bones.append(
                _Bones(
                    frames=tensors.parents[placed],
                    starts=starts,
                    ends=ends,
                    rest=(rest_frames[parents].mT @ bones).squeeze(-1),
                    bare=index(bare),
                    same=index(same),
                )
            )
        return tuple(level_bones)


def _same_bone(template: SkeletonTemplate, bare: int) -> int:
    """The end of the first other limb that starts where a bare limb does."""
    start = template.limbs[bare][0]
    for limb, (other_start, end) in enumerate(template.limbs):
        if other_start == start and limb != bare:
            return end
    raise ValueError(f"no other limb starts where limb {bare} does")


def _put(q: Tensor, valid: Tensor, joints: Tensor, where_to: Tensor) -> Tensor:
    """``q`` with the unseen ones of ``joints`` at ``where_to [B, len(joints), 3]``."""
    seen = valid.index_select(1, joints).unsqueeze(-1)
    placed = torch.where(seen, q.index_select(1, joints), where_to)
    return q.index_copy(1, joints, placed)


def _complete_trunk(
    q: Tensor, valid: Tensor, template: SkeletonTemplate, c: Constants
) -> Tensor:
    """One missing corner: its partner plus the other line, scaled by the rest skeleton's ratio."""
    # The ratio of the lines between shoulders and between hips at rest.
    l_sh, r_sh, l_hip, r_hip = c.rest.index_select(0, c.torso)
    ratio = (l_sh - r_sh).norm() / (l_hip - r_hip).norm()
    l_sh, r_sh, l_hip, r_hip = q.index_select(1, c.torso).unbind(1)

    # Each corner from its partner, by the other line.
    hips = (l_hip - r_hip) * ratio
    shoulders = (l_sh - r_sh) / ratio
    corners = [
        r_sh + hips,
        l_sh - hips,
        r_hip + shoulders,
        l_hip - shoulders,
    ]
    return _put(q, valid, c.torso, torch.stack(corners, dim=1))


def _complete_face(
    q: Tensor,
    valid: Tensor,
    template: SkeletonTemplate,
    hubs: Tensor,
    scale: Tensor,
) -> Tensor:
    """Places unseen joints of the face, then unseen landmarks of lips, brows and lids, at rest.

    The rest face is aligned with the seen joints of the face, else with the shoulders. Landmarks
    are not scaled: the template has the subject's own, in metres.
    """
    c = constants(template, q.device, q.dtype)
    face = constant(template.face, q, torch.int64)
    rest = c.rest.index_select(0, face)

    # The middle of the seen joints, now and at rest.
    seen = valid.index_select(1, face).to(q.dtype).unsqueeze(-1)
    weight = seen / seen.sum(1, keepdim=True).clamp_min(1.0)
    middle = (q.index_select(1, face) * weight).sum(1)
    rest_middle = (rest * weight).sum(1)

    # Without any, the middle of the shoulders.
    anchored = seen.any(1)  # [B, 1]
    shoulders = c.torso[:2]
    below = q.index_select(-2, shoulders).mean(-2)
    rest_below = c.rest.index_select(-2, shoulders).mean(-2)
    now = torch.where(anchored, middle, below)
    at_rest = torch.where(anchored, rest_middle, rest_below)

    # The rest face turns with the head, or with the chest.
    head = hubs[:, HEAD]
    frame = torch.where(anchored.unsqueeze(-1), head, hubs[:, CHEST])
    offset = (rest - at_rest.unsqueeze(1)) @ frame.mT
    q = _put(q, valid, face, now.unsqueeze(1) + offset * scale[:, None, None])
    if not template.expression:
        return q
    centre = q.index_select(1, c.head_points).mean(1, keepdim=True)
    return _put(q, valid, c.expression, centre + c.face_rest @ head.mT)
