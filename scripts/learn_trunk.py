"""Learns how the bends of spine and collarbones go together, from motion capture.

    python scripts/learn_trunk.py 01/*.amc 02/*.amc 03/*.amc

Each clip (an AMC file with its ASF skeleton beside it) moves the free body. The result is the
second moment of the solver's numbers (`gsgan.body.rig.TRUNK`) about the rest pose, the mean over
clips, written to src/gsgan/body/assets/trunk.json. A mirrored copy of every frame makes it
symmetrical.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsgan.body import free_body
from gsgan.body.rig import SPINE, TRUNK, build_rig, rest_axes
from gsgan.synthetic.free_subject import free_character, free_pose
from gsgan.synthetic.recorded_motion import RecordedMotion

RATE = 15  # frames per second
COLLARS = 0.18  # share of the arm's turn: CMU's collarbones do not move
# standard deviation that is added: of what a clip's skeleton cannot show
FLOOR = np.radians(2.5)


def numbers(clip: Path) -> Tensor:
    """``[F, 13]`` of a clip, in the order of `TRUNK`."""
    source = RecordedMotion(free_character(), clip, collars=COLLARS)
    theta = free_pose(
        source.at(np.arange(0, source.duration, 1 / RATE))
    ).theta.double()
    rig, axes = (
        build_rig(free_body()),
        torch.stack(rest_axes(free_body())).double(),
    )
    columns = []
    for name in TRUNK:
        entry = rig.entry_number.tolist().index(rig.names.index(name))
        turn = theta[:, rig.joint[rig.entry_turn[entry]]]
        columns.append(turn @ axes["xyz".index(name[-1])])
    return torch.stack(columns, dim=1)


def mirrored(found: Tensor) -> Tensor:
    """The same of the mirrored person: turns about y and z change sign, collarbones sides."""
    spine, left, right = found.split([3 * len(SPINE), 2, 2], dim=1)
    signs = found.new_tensor([1.0, -1.0, -1.0]).repeat(len(SPINE))
    return torch.cat([spine * signs, -right, -left], dim=1)


def covariance(clips: list[Path]) -> Tensor:
    """``[13, 13]`` square radians."""
    moments = []
    for clip in clips:
        found = numbers(clip)
        both = torch.cat([found, mirrored(found)])
        moments.append(both.mT @ both / len(both))
    return torch.stack(moments).mean(0) + FLOOR**2 * torch.eye(len(TRUNK))


if __name__ == "__main__":
    ask = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    ask.add_argument("clips", type=Path, nargs="+", help="AMC files")
    asset = (
        Path(__file__).parents[1]
        / "src"
        / "gsgan"
        / "body"
        / "assets"
        / "trunk.json"
    )
    ask.add_argument("--out", type=Path, default=asset)
    given = ask.parse_args()
    rows = [
        [round(x, 6) for x in row] for row in covariance(given.clips).tolist()
    ]
    content = {
        "numbers": TRUNK,
        "clips": [clip.stem for clip in given.clips],
        "covariance": rows,
    }
    lines = (
        json.dumps(content, indent=1)
        .replace("\n   ", " ")
        .replace("\n  ]", "]")
    )
    given.out.write_text(lines + "\n")
