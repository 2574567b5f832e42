"""Completes skeletons: unseen joints are filled in before any arithmetic."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from gsgan.scene import Camera
from gsgan.skeleton.frames import bone_frames
from gsgan.skeleton.holistic import TEMPLATES
from gsgan.skeleton.template import CHEST, MEDIAPIPE33, SkeletonTemplate
from gsgan.skeleton.tensors import check_skeleton, constants

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

    Source: method notes, section 2 (one constant per subject, the median over training frames).
    """
    valid = check_skeleton("limb_length_sum", p, valid, template)
    c = constants(template, p.device, p.dtype)
    starts, ends = c.starts[c.measured], c.ends[c.measured]
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
        min_visibility: a joint at or below it is unseen.
        min_trunk_joints: number of shoulders and hips that must be seen, 3 or 4.

    Returns:
        ``p [B, J, 3]`` finite, and ``valid [B, J]`` bool.

    Raises:
        ValueError: on a wrong shape, or when too few shoulders and hips are seen, naming batch
            items and joints.

    Source: method notes, sections 1 and 10 (ours; the paper does not treat missing joints).
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
    skeleton: Tensor, visibility: Tensor | None, template: SkeletonTemplate, body_height: float
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


def recentre(
    p: Tensor, camera: Camera, template: SkeletonTemplate = MEDIAPIPE33
) -> tuple[Tensor, Camera, Tensor]:
    """Moves the world's origin to the left hip; the image stays the same.

    Convention: float32 has a resolution of 1 mm at 1e4 m. A capture in large coordinates (survey,
    geographic) is exact in float32 only if it is recentred in float64 first, joints and cameras
    together.

    Args:
        p: ``[B, J, 3]`` metres, finite.
        camera: of the same batch.
        template: names the hips.

    Returns:
        The moved joints, the moved camera, and the old position ``[B, 3]`` of the new origin.
    """
    root = p[:, template.hips[0]].detach()
    shift = (camera.R @ root.to(camera.R).unsqueeze(-1)).squeeze(-1)
    return p - root.unsqueeze(1), replace(camera, t=camera.t + shift), root


def _estimated_hips(p: Tensor, valid: Tensor, template: SkeletonTemplate) -> Tensor:
    """``[B, J]`` bool: both hips of skeletons that show both shoulders and no hip, if finite
    and apart: zeros are no estimate."""
    hips, shoulders = list(template.hips), list(template.shoulders)
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
            ", ".join(template.names[j] for j in template.torso if not valid[b, j]) for b in bad
        )
        lost = "; ".join(f"item {b}: {missing}" for b, missing in zip(bad, names, strict=True))
        raise ValueError(
            f"sanitise: p needs {MIN_TRUNK_JOINTS} of the four shoulders and hips, but in "
            f"{len(bad)} of {len(valid)} skeletons too many are NaN or invisible "
            f"({lost}); leave these frames out"
        )


def _filled(
    p: Tensor, valid: Tensor, template: SkeletonTemplate, body_height: Tensor | float | None
) -> Tensor:
    c = constants(template, p.device, p.dtype)
    # the origin of the completion: a seen hip or shoulder
    order = torch.tensor([*template.hips, *template.shoulders], device=p.device)
    first = order[valid[:, order].to(torch.uint8).argmax(-1)]
    root = p.gather(1, first[:, None, None].expand(-1, 1, 3)).detach()
    q = torch.where(valid.unsqueeze(-1), p, 0.0)
    q = torch.where(valid.unsqueeze(-1), q - root, 0.0)
    if body_height is None:
        scale = limb_length_sum(q, valid, template) / template.limb_length_sum
        scale = torch.where(scale.isnan(), 1.0, scale)
    else:
        scale = torch.as_tensor(body_height, dtype=p.dtype, device=p.device)
        scale = (scale / template.limb_length_sum).expand(len(p))

    rest_frames = bone_frames(c.rest.unsqueeze(0), None, template)
    q = _complete_trunk(q, valid, template, c.rest)
    q = _complete_face(q, valid, template, c.rest, scale)
    tree = set(template.incoming.values())
    for level in template.levels:
        limbs = [limb for limb in level if limb in tree]
        starts, ends = (c.starts[limbs], c.ends[limbs])
        frames = bone_frames(q, valid, template)
        now, at_rest = (
            torch.cat([f.hubs, f.limbs], dim=1)[:, [template.limb_parents[i] for i in limbs]]
            for f in (frames, rest_frames)
        )
        bone = (now @ at_rest.mT @ (c.rest[ends] - c.rest[starts]).unsqueeze(-1)).squeeze(-1)
        q = _put(q, valid, ends, q[:, starts] + bone * scale[:, None, None])
        if bare := [limb for limb in limbs if limb in template.bare]:
            # two limbs for one bone, as from elbow to wrist: both end at the same place
            same = [_same_bone(template, limb) for limb in bare]
            q = _put(q, valid, c.ends[bare], q[:, c.ends[same]])
    return torch.where(valid.unsqueeze(-1), p, q + root)


def _same_bone(template: SkeletonTemplate, bare: int) -> int:
    start = template.limbs[bare][0]
    return next(i for i, (a, _) in enumerate(template.limbs) if a == start and i != bare)


def _put(q: Tensor, valid: Tensor, joints: Tensor, where_to: Tensor) -> Tensor:
    """``q`` with the unseen ones of ``joints`` at ``where_to [B, len(joints), 3]``."""
    new = torch.where(valid[:, joints].unsqueeze(-1), q[:, joints], where_to)
    return q.index_copy(1, joints, new)


def _complete_trunk(q: Tensor, valid: Tensor, template: SkeletonTemplate, rest: Tensor) -> Tensor:
    """One missing corner: its partner plus the other line, scaled by the rest skeleton's ratio."""
    (l_sh, r_sh), (l_hip, r_hip) = template.shoulders, template.hips
    ratio = (rest[l_sh] - rest[r_sh]).norm() / (rest[l_hip] - rest[r_hip]).norm()
    hips, shoulders = q[:, l_hip] - q[:, r_hip], q[:, l_sh] - q[:, r_sh]
    corners = torch.tensor(template.torso, device=q.device)
    upper = (q[:, r_sh] + hips * ratio, q[:, l_sh] - hips * ratio)
    lower = (q[:, r_hip] + shoulders / ratio, q[:, l_hip] - shoulders / ratio)
    return _put(q, valid, corners, torch.stack([*upper, *lower], dim=1))


def _complete_face(
    q: Tensor, valid: Tensor, template: SkeletonTemplate, rest: Tensor, scale: Tensor
) -> Tensor:
    """Places unseen joints of the face: the rest face, aligned with the seen joints, else with the
    shoulders; then unseen landmarks of lips, brows and lids, at rest.

    These landmarks are not scaled: the template has the subject's own, in metres.
    """
    frames = bone_frames(q, valid, template)
    face = torch.tensor(template.face, device=q.device)
    seen = valid[:, face].to(q.dtype).unsqueeze(-1)
    anchored = seen.any(1)  # [B, 1]
    weight = seen / seen.sum(1, keepdim=True).clamp_min(1.0)
    shoulders = list(template.shoulders)
    now = torch.where(anchored, (q[:, face] * weight).sum(1), q[:, shoulders].mean(1))
    at_rest = torch.where(anchored, (rest[face] * weight).sum(1), rest[shoulders].mean(0))
    R = torch.where(anchored.unsqueeze(-1), frames.head, frames.hubs[:, CHEST])
    offset = (rest[face] - at_rest.unsqueeze(1)) @ R.mT
    q = _put(q, valid, face, now.unsqueeze(1) + offset * scale[:, None, None])
    c = constants(template, q.device, q.dtype)
    centre = q.index_select(1, c.head_points).mean(1, keepdim=True)
    return _put(q, valid, c.expression, centre + c.face_rest @ frames.head.mT)
