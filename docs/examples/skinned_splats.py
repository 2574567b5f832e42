"""Writes an avatar as skinned splats, which spark.html shows with three.js and Spark.

    python docs/examples/skinned_splats.py OUT_FOLDER [AVATAR [LANDMARKS.npz]]

OUT_FOLDER gets rest.ply, the Gaussians in a T-pose, and skin.json: four bones with their weights of
each Gaussian, and the motion of the bones since the T-pose. AVATAR and LANDMARKS are those of
drive_avatar.py. Gaussians keep the shapes and colours of the T-pose, without what Ψ adds to a pose.
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from gsgan.export.page import poses_of
from gsgan.export.splats import ply_bytes, splats_of
from gsgan.run.drive import Drive, inputs_of, rest_pose
from gsgan.run.runs import Run
from gsgan.run.shared import DEMO_MOTION
from gsgan.scene import BodyPose

FPS = 25
BONES = 4  # of each Gaussian, at most


@torch.no_grad()
def main(
    out: Path, name: str = "demo", motion: Path = DEMO_MOTION, frames: int = 100
) -> None:
    run = Run.load(name, device="cpu")
    avatar = run.avatar
    points = avatar.body_points.points
    out.mkdir(parents=True, exist_ok=True)

    # The Gaussians in a T-pose, in the order of the body's points.
    p, seen, rest = inputs_of(avatar, rest_pose(run.proportions), 0)
    splats = splats_of(avatar, p, seen > 0, rest)
    content = ply_bytes(splats, avatar.accuracy.antialias)
    (out / "rest.ply").write_bytes(content)

    # Where each bone moves from there: x → R x + t.
    with np.load(motion) as file:
        skeletons = file["p"][:frames]  # [F, 75, 3] metres
    visibility = np.isfinite(skeletons).all(-1).astype(float)
    theta, transl = poses_of(
        avatar, Drive(skeletons, visibility, None, [], "landmarks")
    )
    pose = BodyPose(torch.from_numpy(theta), torch.from_numpy(transl))
    at_rest = points.with_bones(rest).bones
    moves = points.with_bones(pose).bones @ torch.linalg.inv(at_rest)
    turns = Rotation.from_matrix(moves[..., :3, :3].flatten(0, 1).numpy())
    shape = moves.shape[:2]

    # The largest weights of each Gaussian.
    index, weight = points.weights
    weight, largest = weight.topk(min(BONES, weight.shape[1]))
    skin = {
        "fps": FPS,
        "bones": index.gather(1, largest).tolist(),
        "weights": (weight / weight.sum(1, keepdim=True)).tolist(),
        "quaternions": turns.as_quat().reshape(*shape, 4).tolist(),  # x y z w
        "translations": moves[..., :3, 3].tolist(),  # metres
    }
    (out / "skin.json").write_text(json.dumps(skin))
    print(f"{out}: {len(index)} Gaussians, {shape[1]} bones, {shape[0]} frames")


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
