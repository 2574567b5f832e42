"""Completes skeletons: unseen joints are filled in before any arithmetic."""

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from gsgan.skeleton.frames import bone_frames, hubs_of, palms_of, swings
from gsgan.skeleton.holistic import TEMPLATES
from gsgan.skeleton.template import CHEST, HEAD, MEDIAPIPE33, N_HUBS, SkeletonTemplate
from gsgan.skeleton.tensors import Constants, check_skeleton, constants
from gsgan.utils.tensors import constant

SIZES = {len(t.names) for t in TEMPLATES.values()}
MIN_TRUNK_JOINTS = 3
"""Of the two shoulders and two hips: with fewer the trunk's frame is undefined."""


def limb_length_sum(
    p: Tensor, valid: Tensor | None = None, template: SkeletonTemplate = MEDIAPIPE33
) -> Tensor:
    """The sum of limb lengths, h_body: a measure of the subject's size, the same in every pose.

    Convention: metres; about 2.4 times the stature. Limbs with an unseen end are accounted for by
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
    seen = valid.index_select(1, starts) & valid.index_select(1, ends)
    bones = p.index_select(1, ends) - p.index_select(1, starts)
    lengths = torch.where(seen.unsqueeze(-1), bones, 0.0).norm(dim=-1).sum(-1)
    rest = (c.rest[ends] - c.rest[starts]).norm(dim=-1)
    return lengths * rest.sum() / (seen * rest).sum(-1)


def sanitise(
    p: Tensor,
    visibility: Tensor | None = None,
    template: SkeletonTemplate = MEDIAPIPE33,
    body_height: Tensor | float | None = None,
) -> tuple[Tensor, Tensor]:
    """Fills in unseen joints and marks them.

    Convention: metres, world frame. A joint is unseen when a coordinate is NaN or infinite or its
    visibility is not above 0. One missing shoulder or hip is completed from the
    other three; two unseen hips keep finite positions, as estimates; a joint or landmark of the
    face is placed by the head's frame; any other joint at the end of its rest bone in its parent's
    frame. Filled-in joints move with the seen ones and pass gradients to them. Seen joints are
    returned unchanged. The check costs one device synchronisation.

    Args:
        p: ``[B, J, 3]``.
        visibility: ``[B, J]`` or None (all visible).
        template: defines the joints and the rest pose.
        body_height: the subject's h_body as of :func:`limb_length_sum`, a number or ``[B]``,
            which scales the missing bones. None: from the seen limbs.

    Returns:
        ``p [B, J, 3]`` finite, and ``valid [B, J]`` bool.

    Raises:
        ValueError: on a wrong shape, or when too few shoulders and hips are seen, naming batch
            items and joints.

    Source: ours; the paper does not treat missing joints.
    """
    check_skeleton("sanitise", p, None, template)
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
    placed = valid | _estimated_hips(p, valid, template)
    _refuse_without_trunk(placed, template)
    return _filled(p, placed, template, body_height), valid


def complete_skeleton(
    skeleton: Tensor,
    visibility: Tensor | None,
    template: SkeletonTemplate,
    body_height: float,
) -> tuple[Tensor, Tensor]:
    """Joints ``[B, J, 3]`` of a template, finite, and their visibility ``[B, J]``, 0 for stand-ins.

    Convention: hands and a face that only the template has are marked as unseen; those that only
    the skeleton has are left out.

    Args:
        skeleton: ``[J, 3]`` or ``[B, J, 3]`` metres; NaN for joints not seen.
        visibility: ``[J]`` or ``[B, J]`` in [0, 1]; None: all seen.
        template, body_height: see `sanitise`.

    Raises:
        ValueError: as `sanitise` does.
    """
    J = len(template.names)
    p = skeleton.reshape(-1, *skeleton.shape[-2:]).to(torch.float32)
    shown = torch.ones_like(p[..., 0]) if visibility is None else visibility.to(p)
    shown = shown.reshape(-1, shown.shape[-1])
    if (found := p.shape[1]) != J and {found, J} <= SIZES:
        missing = (0, max(J - found, 0))
        p = pad(p[:, :J], (0, 0, *missing), value=torch.nan)
        shown = pad(shown[:, :J], missing)
    p, valid = sanitise(p, None, template, body_height)
    return p, valid * shown


def _estimated_hips(p: Tensor, valid: Tensor, template: SkeletonTemplate) -> Tensor:
    """``[B, J]`` bool: both hips of skeletons that show both shoulders and no hip, if finite
    and apart: zeros are no estimate."""
    hips = list(template.hips)
    shoulders = list(template.shoulders)
    seen = valid[:, shoulders].all(1) & ~valid[:, hips].any(1)
    estimated = torch.zeros_like(valid)
    apart = (p[:, hips[0]] != p[:, hips[1]]).any(1)
    estimated[:, hips] = (seen & apart & p[:, hips].isfinite().all((1, 2))).unsqueeze(1)
    return estimated


def _refuse_without_trunk(valid: Tensor, template: SkeletonTemplate) -> None:
    trunk = valid[:, list(template.torso)]
    bad = (trunk.sum(-1) < MIN_TRUNK_JOINTS).nonzero().flatten().tolist()
    if bad:
        names = (
            ", ".join(template.names[j] for j in template.torso if not valid[b, j])
            for b in bad
        )
        lost = "; ".join(
            f"item {b}: {missing}" for b, missing in zip(bad, names, strict=True)
        )
        raise ValueError(
            f"sanitise: p needs {MIN_TRUNK_JOINTS} of the four shoulders and hips, but in "
            f"{len(bad)} of {len(valid)} skeletons too many are NaN or invisible "
            f"({lost}); leave these frames out"
        )


def _filled(
    p: Tensor,
    valid: Tensor,
    template: SkeletonTemplate,
    body_height: Tensor | float | None,
) -> Tensor:
    c = constants(template, p.device, p.dtype)
    # the origin of the completion: a seen hip or shoulder
    order = constant((*template.hips, *template.shoulders), p, torch.int64)
    first = order[valid.index_select(1, order).to(torch.uint8).argmax(-1)]
    root = p.gather(1, first[:, None, None].expand(-1, 1, 3)).detach()
    q = torch.where(valid.unsqueeze(-1), p, 0.0)
    q = torch.where(valid.unsqueeze(-1), q - root, 0.0)
    if body_height is None:
        scale = limb_length_sum(q, valid, template) / template.limb_length_sum
        scale = torch.where(scale.isnan(), 1.0, scale)
    else:
        scale = torch.as_tensor(body_height, dtype=p.dtype, device=p.device)
        scale = (scale / template.limb_length_sum).expand(len(p))

    q = _complete_trunk(q, valid, template, c)
    known = hubs_of(q, valid, c)  # what is placed below moves none of them
    q = _complete_face(q, valid, template, known, scale)
    for level, bones in zip(c.levels, _bones(template, p.device, p.dtype), strict=True):
        if template.palms:  # their knuckles may have been placed
            hubs, palms, limbs = known.tensor_split((N_HUBS, template.n_hubs), dim=1)
            palms = palms_of(q, hubs[:, CHEST : CHEST + 1], c)
            known = torch.cat([hubs, palms, limbs], dim=1)
        frames = known.index_select(1, bones.frames)
        bone = (frames @ bones.rest.unsqueeze(-1)).squeeze(-1) * scale[:, None, None]
        q = _put(q, valid, bones.ends, q.index_select(1, bones.starts) + bone)
        if template.bare:
            # two limbs for one bone, as from elbow to wrist: both end at the same place
            q = _put(q, valid, bones.bare, q.index_select(1, bones.same))
        if level is c.levels[-1]:
            break
        parent = known.index_select(1, level.parents)
        starts = c.starts[level.limbs]
        ends = c.ends[level.limbs]
        found = q.index_select(1, ends) - q.index_select(1, starts)
        known = torch.cat([known, parent @ swings(found, parent, level)], dim=1)
    return torch.where(valid.unsqueeze(-1), p, q + root)


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
    def index(values: list[int]) -> Tensor:
        return torch.tensor(values, dtype=torch.int64, device=device)

    with torch.inference_mode(False), torch.no_grad():
        c = constants(template, device, dtype)
        at_rest = bone_frames(c.rest.unsqueeze(0), None, template)
        frames = torch.cat([at_rest.hubs, at_rest.limbs], dim=1)[0]
        tree = set(template.incoming.values())
        found = []
        for level, tensors in zip(template.levels, c.levels, strict=True):
            placed = [k for k, limb in enumerate(level) if limb in tree]
            limbs = tensors.limbs[placed]
            starts = c.starts[limbs]
            ends = c.ends[limbs]
            hung = frames[[template.limb_parents[level[k]] for k in placed]]
            rest = (hung.mT @ (c.rest[ends] - c.rest[starts]).unsqueeze(-1)).squeeze(-1)
            bare = [limb for limb in level if limb in tree and limb in template.bare]
            same = [template.limbs[_same_bone(template, limb)][1] for limb in bare]
            bare = [template.limbs[limb][1] for limb in bare]
            of_parents = tensors.parents[placed]
            found.append(
                _Bones(of_parents, starts, ends, rest, index(bare), index(same))
            )
        return tuple(found)


def _same_bone(template: SkeletonTemplate, bare: int) -> int:
    start = template.limbs[bare][0]
    return next(
        i for i, (a, _) in enumerate(template.limbs) if a == start and i != bare
    )


def _put(q: Tensor, valid: Tensor, joints: Tensor, where_to: Tensor) -> Tensor:
    """``q`` with the unseen ones of ``joints`` at ``where_to [B, len(joints), 3]``."""
    seen = valid.index_select(1, joints).unsqueeze(-1)
    return q.index_copy(
        1, joints, torch.where(seen, q.index_select(1, joints), where_to)
    )


def _complete_trunk(
    q: Tensor, valid: Tensor, template: SkeletonTemplate, c: Constants
) -> Tensor:
    """One missing corner: its partner plus the other line, scaled by the rest skeleton's ratio."""
    l_sh, r_sh, l_hip, r_hip = c.rest.index_select(0, c.torso)
    ratio = (l_sh - r_sh).norm() / (l_hip - r_hip).norm()
    l_sh, r_sh, l_hip, r_hip = q.index_select(1, c.torso).unbind(1)
    hips = (l_hip - r_hip) * ratio
    shoulders = (l_sh - r_sh) / ratio
    corners = (r_sh + hips, l_sh - hips, r_hip + shoulders, l_hip - shoulders)
    return _put(q, valid, c.torso, torch.stack(corners, dim=1))


def _complete_face(
    q: Tensor, valid: Tensor, template: SkeletonTemplate, hubs: Tensor, scale: Tensor
) -> Tensor:
    """Places unseen joints of the face: the rest face, aligned with the seen joints, else with the
    shoulders; then unseen landmarks of lips, brows and lids, at rest.

    These landmarks are not scaled: the template has the subject's own, in metres.
    """
    c = constants(template, q.device, q.dtype)
    face = constant(template.face, q, torch.int64)
    shoulders = c.torso[:2]
    joints = q.index_select(1, face)
    rest = c.rest.index_select(0, face)
    seen = valid.index_select(1, face).to(q.dtype).unsqueeze(-1)
    anchored = seen.any(1)  # [B, 1]
    weight = seen / seen.sum(1, keepdim=True).clamp_min(1.0)
    below = q.index_select(-2, shoulders).mean(-2)
    rest_below = c.rest.index_select(-2, shoulders).mean(-2)
    now = torch.where(anchored, (joints * weight).sum(1), below)
    at_rest = torch.where(anchored, (rest * weight).sum(1), rest_below)
    chest = hubs[:, CHEST]
    head = hubs[:, HEAD]
    offset = (rest - at_rest.unsqueeze(1)) @ torch.where(
        anchored.unsqueeze(-1), head, chest
    ).mT
    q = _put(q, valid, face, now.unsqueeze(1) + offset * scale[:, None, None])
    if not template.expression:
        return q
    centre = q.index_select(1, c.head_points).mean(1, keepdim=True)
    return _put(q, valid, c.expression, centre + c.face_rest @ head.mT)
