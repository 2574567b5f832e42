"""Places Gaussians on a skeleton (Algorithm 1 of the paper), poses it, and draws both.

python docs/examples/densify_and_pose.py OUT.png
"""

import sys

import torch
from PIL import Image
from torch import Tensor

import gsgan
from gsgan.body import free_body

SIDE = 256  # pixels of each of the two images


def front(side: int) -> gsgan.Camera:
    """A camera three metres before a person who stands at the origin; z is up."""
    K = torch.tensor([[[side, 0, side / 2], [0, side, side / 2], [0, 0, 1.0]]])
    # x is to the right in the image, z upwards, y away from the camera.
    R = torch.tensor([[[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]])
    t = torch.tensor([[0.0, 0.9, 3.0]])  # the camera is 0.9 m high
    return gsgan.Camera(K, R, t, size=(side, side))


def drawn(skeleton: Tensor, densify: gsgan.Densify) -> Tensor:
    """[3, SIDE, SIDE]: the Gaussians of a skeleton [1, 33, 3], one colour per part."""
    points = densify(skeleton)
    palette = torch.rand(100, 3, generator=torch.Generator().manual_seed(1))
    count = points.means.shape[1]
    gaussians = gsgan.Gaussians(
        means=points.means,
        quats=torch.tensor([1.0, 0, 0, 0]).expand(1, count, 4),
        scales=torch.full((1, count, 3), 0.008),  # metres
        opacities=torch.full((1, count), 0.8),
        features=palette[points.part_id].expand(1, count, 3),
    )
    return gsgan.rasterise(gaussians, front(SIDE), settings="high").features[0]


def main(out: str) -> None:
    # The rest pose of the free body, and the same with its right arm turned.
    body = free_body()
    theta = torch.zeros(1, len(body.joints), 3)  # axis-angle of each bone
    still = gsgan.BodyPose(theta=theta.clone(), transl=torch.zeros(1, 3))
    theta[0, body.joint_names.index("upperarm01.R"), 1] = -1.0  # radians
    moved = gsgan.BodyPose(theta=theta, transl=torch.zeros(1, 3))

    # Points keep their place on a limb: the same Gaussians follow the skeleton.
    densify = gsgan.Densify()
    poses = [body.posed_landmarks(pose).float() for pose in (still, moved)]
    images = [drawn(skeleton, densify) for skeleton in poses]
    pixels = (255 * torch.cat(images, dim=-1)).byte()
    Image.fromarray(pixels.permute(1, 2, 0).numpy()).save(out)
    print(f"{out}: {len(densify.rest_points)} Gaussians")


if __name__ == "__main__":
    main(sys.argv[1])
