"""`gsgan.bench roofline`: arithmetic and bytes of known work, and every stage of an avatar."""

from __future__ import annotations

import math

import pandas as pd
import pytest
import torch

from gsgan.bench.roofline import Work, against, composited, stage_work
from gsgan.scene import Camera, Gaussians
from gsgan.splat import accuracy


def test_products_and_bytes_of_operations():
    a, b = torch.rand(8, 16), torch.rand(16, 4)
    with Work() as work:
        a.T.view(16, 8)  # views move nothing
        a @ b
    assert work.flop == 2 * 8 * 16 * 4
    assert work.bytes == 4 * (8 * 16 + 16 * 4 + 8 * 4)
    with Work() as work:
        a.mul(torch.rand(1).expand(8, 16))
    assert work.bytes == 4 * (8 * 16 + 1 + 8 * 16) + 4  # the random number is written too


def test_pixels_of_an_ellipse():
    """A sphere of 1 cm, 1 m away: a disc in the image whose radius follows from alpha_min."""
    camera = Camera(
        torch.tensor([[[500.0, 0, 64], [0, 500, 64], [0, 0, 1]]]),
        torch.eye(3)[None],
        torch.tensor([[0.0, 0, 1]]),
        (128, 128),
    )
    drawn = Gaussians(
        *(torch.zeros(1, 1, 3), torch.tensor([[[1.0, 0, 0, 0]]]), torch.full((1, 1, 3), 0.01)),
        *(torch.full((1, 1), 0.5), torch.rand(1, 1, 4)),
    )
    settings = accuracy("high")
    flop, moved = composited(drawn, camera, settings)
    pixels = math.pi * (25 + settings.low_pass) * 2 * math.log(0.5 / settings.alpha_min)
    assert flop == pytest.approx(pixels * (20 + 2 * 4), rel=1e-2)
    assert moved == 4 * 14 + 4 * 5 * 128**2


def test_every_stage_has_its_work(build):
    _, avatar, frame = build()
    work = stage_work(avatar.eval(), frame)
    assert {"Ψ", "F", "S", "UNet", "end to end"} <= set(work.index)
    assert (work.bytes > 0).all()
    assert work.flop["UNet"] > work.flop["pose encoder"] > 0
    assert work.flop["end to end"] == pytest.approx(work.flop.drop("end to end").sum())
    ms = pd.Series(1e6, index=work.index)
    table = against(work, ms, {"GFLOP/s": 1e-6, "GB/s": 1e3})
    assert table.bound_ms["UNet"] == pytest.approx(work.flop["UNet"])
    assert table.limit["paste"] == "memory"


@pytest.mark.slow
def test_the_command_prints_a_table(capture, tmp_path, inside):
    few = ("sizes=[tiny]", "frames=1", "warmup=0", "poses=1", f"data.root={capture}", "device=cpu")
    done = inside("bench", "roofline", *few, "data.source=null", f"hydra.run.dir={tmp_path}")
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "roofline.md").read_text()
    assert "| tiny | UNet |" in page
    assert "GFLOP/s" in page
