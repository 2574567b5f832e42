"""Adds a loss and an ablation without touching gsgan: this module, and the configs in conf/.

    python docs/examples/own_loss.py [override of gsgan.train ...]

Trains `full` and the ablation `wo_normals` with the loss, into runs/own_loss, then makes a table.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from torch import Tensor, nn

if TYPE_CHECKING:
    from gsgan.model.rendering import Rendering
    from gsgan.scene import Frame

HERE = Path(__file__).resolve().parent


class Smoothness(nn.Module):
    """Total variation of the image, a further term of Step II."""

    def __init__(self, weight: float) -> None:
        super().__init__()
        self.weight = weight

    def forward(self, rendering: Rendering, frame: Frame) -> Tensor:
        image = rendering.image  # [B, 3, H, W], as is frame.image
        return self.weight * (
            image.diff(dim=-1).abs().mean() + image.diff(dim=-2).abs().mean()
        )


def main(overrides: list[str]) -> None:
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(HERE), *sys.path]),
    }
    ours = [
        "--config-dir",
        str(HERE / "conf"),
        "model=full,wo_normals",
        "training=smooth",
    ]
    sweep = [
        "gsgan.train",
        "-m",
        *ours,
        "hydra.sweep.dir=runs/own_loss",
        *overrides,
    ]
    for command in (
        sweep,
        ["gsgan.report", "runs=[runs/own_loss]", "out=runs/own_loss_table"],
    ):
        subprocess.run(
            [sys.executable, "-m", *command], check=True, env=environment
        )


if __name__ == "__main__":
    main(sys.argv[1:])
