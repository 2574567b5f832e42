"""Fits 3D Gaussians to one image by gradients of the rasteriser.

python docs/examples/fit_image.py IMAGE OUT.png
"""

import sys

import numpy as np
import torch
from PIL import Image

import gsgan

SIDE = 128  # pixels of the square image
COUNT = 1500  # Gaussians


def main(image: str, out: str, iterations: int = 300) -> float:
    pixels = np.array(Image.open(image).convert("RGB").resize((SIDE, SIDE)))
    target = torch.from_numpy(pixels).permute(2, 0, 1)[None] / 255

    # A camera that sees the plane at depth 1 from -0.5 to 0.5.
    K = torch.tensor([[[SIDE, 0, SIDE / 2], [0, SIDE, SIDE / 2], [0, 0, 1.0]]])
    R, t = torch.eye(3)[None], torch.zeros(1, 3)
    camera = gsgan.Camera(K, R, t, size=(SIDE, SIDE))

    # Round grey Gaussians on that plane; logits hold opacity and colour.
    torch.manual_seed(0)
    places = torch.rand(1, COUNT, 2) - 0.5
    means = torch.cat([places, torch.ones(1, COUNT, 1)], dim=-1)
    log_scales = torch.full((1, COUNT, 1), -4.5)
    logits = torch.zeros(1, COUNT, 4)
    rates = ((means, 0.002), (log_scales, 0.02), (logits, 0.1))
    optimiser = torch.optim.Adam(
        [{"params": x.requires_grad_(), "lr": rate} for x, rate in rates]
    )

    for _ in range(iterations):
        gaussians = gsgan.Gaussians(
            means=means,
            quats=torch.tensor([1.0, 0, 0, 0]).expand(1, COUNT, 4),
            scales=log_scales.exp().expand(1, COUNT, 3),
            opacities=logits[..., 0].sigmoid(),
            features=logits[..., 1:].sigmoid(),
        )
        found = gsgan.rasterise(gaussians, camera, settings="high").features
        loss = (found - target).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()

    psnr = -10 * float(loss.detach().log10())
    result = (255 * found[0].detach().clamp(0, 1)).byte().permute(1, 2, 0)
    Image.fromarray(result.numpy()).save(out)
    print(f"{out}: {psnr:.1f} dB after {iterations} iterations")
    return psnr


if __name__ == "__main__":
    main(*sys.argv[1:3])
