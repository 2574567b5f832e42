"""STAND-IN until the branch w22/body is merged: Adam on the landmarks."""

from __future__ import annotations

import torch
from torch import Tensor

from gsgan.body.free import Body
from gsgan.body.shape import BodyShape, shaped_body
from gsgan.scene import BodyPose

FACE = range(11)
PALM = range(17, 23)


def stiffness(body: Body) -> Tensor:
    k = torch.ones(len(body.joint_names), 3)
    for j, name in enumerate(body.joint_names):
        if name == "root":
            k[j] = 0
        elif name.startswith(("spine", "neck")):
            k[j] = 2
        elif name.startswith(("clavicle", "shoulder", "pelvis")):
            k[j] = 4
        elif "02." in name:
            k[j] = 6
        elif name.startswith("finger"):
            k[j] = 30
        if name.startswith("lowerleg01"):
            k[j] = torch.tensor([0.2, 40.0, 40.0])
        elif name.startswith("upperleg02"):
            k[j] = 40
        elif name.startswith("foot"):
            k[j] = torch.tensor([1.0, 4.0, 4.0])
    return k


def weights() -> Tensor:
    w = torch.ones(33)
    w[list(FACE)] = 0.25
    w[list(PALM)] = 0.3
    return w


def align(body: Body, p: Tensor) -> tuple[Tensor, Tensor]:
    hubs = [11, 12, 23, 24]
    a = body.landmarks[hubs]
    b = p[:, hubs]
    ac, bc = a - a.mean(0), b - b.mean(1, keepdim=True)
    U, _, Vt = torch.linalg.svd(torch.einsum("bni,nj->bij", bc, ac))
    d = torch.det(U @ Vt)
    D = torch.diag_embed(torch.stack([torch.ones_like(d), torch.ones_like(d), d], -1))
    R = U @ D @ Vt
    root = body.joints[0]
    t = b.mean(1) - (R @ (a.mean(0) - root)) - root
    return R, t


def fit_poses(body, p, visibility, stretch=None, steps=500, rate=0.03):
    from kornia.geometry.conversions import rotation_matrix_to_axis_angle

    first = shaped_body(BodyShape(torch.zeros(0), stretch.detach().exp())) if body is None else body
    R, t = align(first, p)
    theta = torch.zeros(len(p), len(first.parents), 3)
    theta[:, 0] = rotation_matrix_to_axis_angle(R)
    theta.requires_grad_()
    transl = t.clone().requires_grad_()
    params = [{"params": [theta, transl], "lr": rate}]
    if stretch is not None:
        params.append({"params": [stretch], "lr": 0.01})
    opt = torch.optim.Adam(params)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(opt, steps)
    k, w = stiffness(first), weights() * (visibility > 0)
    for _ in range(steps):
        b = body if body is not None else shaped_body(BodyShape(torch.zeros(0), stretch.exp()))
        d = b.posed_landmarks(BodyPose(theta, transl)) - p
        loss = (w * ((1 + d.square().sum(-1) / 0.02**2).sqrt() - 1)).sum()
        loss = loss + 0.02 * (k * theta.square()).sum()
        if stretch is not None:
            loss = loss + 5 * stretch.square().sum()
        opt.zero_grad()
        loss.backward()
        opt.step()
        schedule.step()
    return BodyPose(theta.detach(), transl.detach())


class Solver:
    def __init__(self, body: Body) -> None:
        self.body = body

    def solve(self, skeleton: Tensor, visibility: Tensor) -> BodyPose:
        with torch.enable_grad():
            return fit_poses(self.body, skeleton, visibility)
