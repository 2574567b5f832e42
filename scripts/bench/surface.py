"""Distance of a character's true surface from the body solved from its exact landmarks, by part.

    python scripts/bench/surface.py avatar=a.glb train='[a.amc:0:2:30]' test='[far@b.amc:4:9:40]'

The shape is fitted to the landmarks of the training frames, and the poses of all frames are solved
from landmarks alone; no image is rendered. Every point of the true surface is bound to its nearest
point of the solved body in the training frames, where it keeps its mean offset: what is left is
how far the solved body moves otherwise than the person. RMS in mm. The last rows say how much of it
offsets could take away that are linear in the rotations of the bones that carry a point, as
`gsgan.model.pose_offsets` learns them through the images: here they are fitted to the truth in the
training frames.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import torch
from bench_common import main
from numpy.typing import NDArray
from omegaconf import DictConfig
from torch import Tensor

from gsgan.body import Body
from gsgan.body.lbs import axis_angle_to_matrix
from gsgan.body.shape import shape_body
from gsgan.body.solve import Solver
from gsgan.fit.shape import fit_hands, fit_shape
from gsgan.motion.character import Animation, Character
from gsgan.scene import BodyPose
from gsgan.synthetic.passages import frame_times
from gsgan.synthetic.recorded_motion import RecordedMotion
from gsgan.synthetic.scene_setup import load_character
from gsgan.synthetic.takes import MOTIONS

JOINTS, NEAREST = (
    75,
    8,
)  # landmarks of body and hands; training frames that bind points
RIDGE = 0.03  # weight of the squared coefficients of linear offsets
COLLARS = (
    0.18  # of the arm's turn: CMU's clips have collarbones that do not move
)
PARTS = {  # by the name of a point's bone, first match
    "head": "Head|Neck|.*Eye|Jaw",
    "hands": ".*Hand.*",
    "arms": ".*Arm",
    "legs": ".*(Leg|Foot|Toe.*)$(?<!UpLeg)",
    "thighs": ".*UpLeg",
    "hips": "Hips",
    "lower spine": "Spine",
    "mid spine": "Spine1",
    "chest": "Spine2",
    "shoulders": ".*Shoulder",
}


def animation(character: Character, clip: str) -> Animation:
    """The poses of ``file:first second:last second:frames``, or of ``motion:frames``."""
    if (name := clip.split(":")[0]) in MOTIONS:
        frames = clip.split(":")[1]
        source = RecordedMotion(character, MOTIONS[name])
        return source.at(frame_times(int(frames), source.duration))
    path, first, last, frames = clip.rsplit(":", 3)
    source = RecordedMotion(character, Path(path).expanduser(), collars=COLLARS)
    return source.at(np.linspace(float(first), float(last), int(frames)))


def truth(
    character: Character, clips: list[str], chosen: NDArray[np.int64]
) -> tuple[Tensor, ...]:
    """Landmarks ``[F, 75, 3]`` and chosen vertices ``[F, N, 3]`` of clips, metres."""
    marks, points = [], []
    for clip in clips:
        motion = animation(character, clip)
        for R, joints in zip(motion.rotations, motion.joints, strict=True):
            vertices = character.skin(R, joints)[0]
            marks.append(character.landmarks(vertices, joints)[:JOINTS])
            points.append(vertices[chosen])
    return tuple(torch.from_numpy(np.stack(x)).float() for x in (marks, points))


class Bound:
    """Points of the true surface in the axes of their nearest points of the body."""

    def __init__(self, body: Body, pose: BodyPose, points: Tensor) -> None:
        self.body = body
        A, t = body.pose(pose)
        vertices = (A @ body.vertices.unsqueeze(-1)).squeeze(-1) + t
        step = -(-len(points) // NEAREST)
        apart = sum(
            torch.cdist(x, v).square()
            for x, v in zip(points[::step], vertices[::step], strict=True)
        )
        self.nearest = apart.argmin(1)
        A, t = A[:, self.nearest], t[:, self.nearest]
        self.rest = (
            torch.linalg.solve(A, (points - t).unsqueeze(-1))
            .squeeze(-1)
            .mean(0)
        )

    def error(self, pose: BodyPose, points: Tensor) -> Tensor:
        """``[F, N, 3]`` metres."""
        A, t = self.body.pose(pose)
        A, t = A[:, self.nearest], t[:, self.nearest]
        return (A @ self.rest.unsqueeze(-1)).squeeze(-1) + t - points

    def at_rest(self, pose: BodyPose, error: Tensor) -> Tensor:
        """``[F, N, 3]`` errors in the axes of the points, where offsets act."""
        A, _ = self.body.pose(pose)
        turned = torch.linalg.solve(A[:, self.nearest], error.unsqueeze(-1))
        return turned.squeeze(-1)

    def bends(self, pose: BodyPose) -> Tensor:
        """``[F, N, 9 n]``: rotations minus identity of the bones that carry each point.

        The root's are left out: it turns the whole body.
        """
        turns = axis_angle_to_matrix(pose.theta) - torch.eye(3)
        turns[:, 0] = 0
        bones = self.body.bone_index[self.nearest]
        return turns.flatten(2)[:, bones].flatten(2)


def parts(character: Character, chosen: NDArray[np.int64]) -> dict[str, Tensor]:
    """Which of the chosen vertices are of each part."""
    names = [character.bones[j] for j in character.dominant_bones()[chosen]]
    of = [
        next((p for p, rule in PARTS.items() if re.fullmatch(rule, n)), "")
        for n in names
    ]
    return {
        part: torch.tensor([o == part for o in of])
        for part in PARTS
        if part in of
    }


def linear_fit(bends: Tensor, error: Tensor) -> Tensor:
    """``[N, K, 3]`` the ridge regression of errors ``[F, N, 3]`` on ``[F, N, K]``."""
    inputs = bends.transpose(0, 1).double()
    ridge = RIDGE * torch.eye(inputs.shape[-1])
    right = inputs.mT @ error.transpose(0, 1).double()
    return torch.linalg.solve(inputs.mT @ inputs + ridge, right).float()


def rms(error: Tensor) -> float:
    """Of vectors ``[..., 3]`` metres, in millimetres."""
    return 1000 * float(error.square().sum(-1).mean().sqrt())


@torch.no_grad()
def errors(
    found: dict[str, tuple[Tensor, ...]], masks: dict[str, Tensor]
) -> dict[str, dict[str, float]]:
    """Millimetres by set and part: RMS of the surface, medians of landmarks."""
    marks, points = found["training"]
    seen = torch.ones(len(marks), JOINTS)
    shape = fit_shape(marks[:, :33], seen[:, :33])
    shape = fit_hands(
        shape, Solver(shape_body(shape)).solve(marks, seen), marks, seen
    )
    body = shape_body(shape)
    solver = Solver(body)
    pose = {
        name: solver.solve(p, torch.ones(p.shape[:2]))
        for name, (p, _) in found.items()
    }
    bound, table = Bound(body, pose["training"], points), {}

    # The offsets that would be best in the training frames.
    error = bound.error(pose["training"], points)
    offsets = linear_fit(
        bound.bends(pose["training"]),
        bound.at_rest(pose["training"], error),
    )
    for name, (p, x) in found.items():
        error = bound.error(pose[name], x)
        at_rest = bound.at_rest(pose[name], error)
        best = torch.einsum("fnk,nkj->fnj", bound.bends(pose[name]), offsets)
        left = at_rest - best
        off = (body.posed_landmarks(pose[name]) - p[:, :33]).norm(dim=-1)
        hands = (body.posed_hands(pose[name]) - p[:, 33:]).norm(dim=-1)
        table[name] = {
            **{part: rms(error[:, mask]) for part, mask in masks.items()},
            "all": rms(at_rest),
            "all, median": 1000 * float(at_rest.norm(dim=-1).median()),
            "all, less linear offsets": rms(left),
            "all, less linear offsets, median": 1000
            * float(left.norm(dim=-1).median()),
            "landmarks, median": 1000 * float(off.median()),
            "landmarks, 90 %": 1000 * float(off.quantile(0.9)),
            "hand landmarks, median": 1000 * float(hands.median()),
        }
    return table


def run(options: DictConfig, out: Path) -> None:
    torch.set_num_threads(1)
    character = load_character(options.avatar)
    chosen = np.arange(
        0,
        len(character.vertices),
        -(-len(character.vertices) // options.points),
    )
    sets: dict[str, list[str]] = {"training": list(options.train)}
    for name, clip in (word.split("@") for word in options.test):
        sets.setdefault(name, []).append(clip)
    found = {
        name: truth(character, clips, chosen) for name, clips in sets.items()
    }
    table = errors(found, parts(character, chosen))
    rows = [f"| part | {' | '.join(table)} |", "|---" * (len(table) + 1) + "|"]
    for part in table["training"]:
        rows.append(
            f"| {part} | {' | '.join(f'{t[part]:.1f}' for t in table.values())} |"
        )
    print("\n".join(rows))
    out.mkdir(parents=True, exist_ok=True)
    (out / "surface.md").write_text("\n".join(rows) + "\n")
    (out / "surface.json").write_text(json.dumps(table, indent=1))


if __name__ == "__main__":
    main("surface", run)
