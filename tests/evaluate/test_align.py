"""`gsgan.evaluate align=pose`: a pose is found in the image that a frozen avatar makes of it."""

from dataclasses import replace

import pytest
import torch
from configs import build_training

from gsgan.evaluate.align import align_poses
from gsgan.utils.errors import ConfigError


def test_a_turned_arm_is_found_again(tiny):
    data, module = build_training(
        tiny("model=splat_only", "effects.body_points=on")
    )
    avatar = module.avatar.freeze()
    frame = data.dataset("train")[0]
    skeleton, seen, camera, true, _ = frame.inputs
    with torch.no_grad():
        rendering = avatar(skeleton, seen, camera, true)
    shown = replace(frame, image=rendering.image, mask=rendering.alpha)

    # The start: both upper arms are turned by 8 degrees, and the root is moved by 2 cm.
    turned = true.theta.clone()
    for side in ("L", "R"):
        bone = avatar.solver.joint_names.index(f"upperarm01.{side}")
        turned[:, bone, 2] += 0.14
    start = replace(true, theta=turned, transl=true.transl + 0.02)
    aligned = align_poses(avatar, replace(shown, body=start), None)

    # Landmarks come back to less than half of their distance.
    def away(pose):
        means = avatar.body_points(pose).means
        return (means - avatar.body_points(true).means).norm(dim=-1).mean()

    assert away(aligned) < 0.5 * away(start)


def test_an_avatar_without_a_body_is_refused(tiny):
    data, module = build_training(tiny("model=image_to_image"))
    with pytest.raises(ConfigError, match="align=pose"):
        align_poses(module.avatar, data.dataset("train")[0], None)
