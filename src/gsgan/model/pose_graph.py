"""The pose encoder: skeleton to the global style code g ∈ R³⁵ (paper Sec. 3.5)."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from gsgan.model.deformation import encoding_size, positional_encoding
from gsgan.scene import Camera
from gsgan.skeleton import (
    MEDIAPIPE33,
    BoneFrames,
    SkeletonTemplate,
    face_code,
    named_template,
    omega,
    root_of,
)

NEIGHBOUR_WEIGHT = 0.05  # initial weight of an edge; the diagonal starts at 1
READOUT_START = 0.8  # initial standard deviation of g for joint channels of 1


class GraphLayer(nn.Module):
    """One graph convolution with separate weights for every joint.

    ``h' = (A ∘ W_A) (h_j W_j) + b``: the adjacency's entries are learned where the mask allows.

    Args:
        mask: ``[J, J]`` of 0 and 1, the diagonal set; an identity mask makes a per-joint layer.
        inputs, outputs: channels.

    Source: after the graph layers of DANBO (Su et al., 2022).
    """

    mask: Tensor

    def __init__(self, mask: Tensor, inputs: int, outputs: int) -> None:
        super().__init__()
        joints = mask.shape[0]

        # The adjacency starts as the joint itself with a little of its neighbours.
        self.register_buffer("mask", mask, persistent=False)
        identity = torch.eye(joints)
        self.adjacency = nn.Parameter(
            identity + NEIGHBOUR_WEIGHT * (mask - identity)
        )

        # Every joint has weights of its own.
        self.weight = nn.Parameter(torch.empty(joints, inputs, outputs))
        bound = 1 / math.sqrt(inputs)
        nn.init.uniform_(self.weight, -bound, bound)
        self.bias = nn.Parameter(torch.zeros(outputs))

    def forward(self, h: Tensor) -> Tensor:
        """``[B, J, inputs]`` to ``[B, J, outputs]``."""
        # Features pass through the weights of their joint, then joints take in their neighbours.
        h = torch.bmm(h.transpose(0, 1), self.weight).transpose(0, 1)
        return (self.adjacency * self.mask) @ h + self.bias


class PoseGraph(nn.Module):
    """A graph network over joint rotations Ω, read out to one number per skeleton edge.

    Args:
        template: the skeleton's joints and edges, or its name.
        width, joint_channels, octaves: hidden and output channels per joint, encoding of Ω.

    Source: paper Sec. 3.5, which leaves open how joints become g: here each number of g is read
        from the two joints of its edge.
    """

    edges: Tensor

    def __init__(
        self,
        template: SkeletonTemplate | str = MEDIAPIPE33,
        *,
        width: int = 128,
        joint_channels: int = 32,
        octaves: int = 5,
    ) -> None:
        super().__init__()
        template = named_template(template)

        # Joints that share an edge are neighbours; the mask is symmetric.
        joints = len(template.names)
        mask = torch.eye(joints)
        for a, b in template.gnn_edges:
            mask[a, b] = mask[b, a] = 1

        # Two layers mix neighbours, and two work on each joint alone.
        alone = torch.eye(joints)
        self.octaves = octaves
        self.layers = nn.ModuleList(
            [
                GraphLayer(mask, encoding_size(6, octaves), width),
                GraphLayer(mask, width, width),
                GraphLayer(alone, width, width),
                GraphLayer(alone, width, joint_channels),
            ]
        )

        # The readout has a number per edge, from the channels of both its joints.
        self.register_buffer(
            "edges", torch.tensor(template.edges).long(), persistent=False
        )
        self.channels = len(template.edges)
        inputs = 2 * joint_channels
        start = torch.randn(self.channels, inputs) * (
            READOUT_START / math.sqrt(inputs)
        )
        self.readout = nn.Parameter(start)
        self.readout_bias = nn.Parameter(torch.zeros(self.channels))

    def forward(self, omega: Tensor, pose: Tensor) -> Tensor:
        """g ``[B, 35]`` from Ω ``[B, J, 6]``; ``pose`` is the other encoder's input, unused."""
        # The layers turn Ω into features of the joints; the last one has no ReLU.
        h = positional_encoding(omega, self.octaves)
        for layer in self.layers[:-1]:
            h = functional.relu(layer(h))
        h = self.layers[-1](h)

        # Each number of g is a weighted sum over the two joints of its edge.
        pairs = torch.cat(
            [h[:, self.edges[:, 0]], h[:, self.edges[:, 1]]], dim=-1
        )
        return (pairs * self.readout).sum(-1) + self.readout_bias


class PoseLinear(nn.Module):
    """The ablation ``wo_gcn``: g = W p + b on the flattened skeleton (paper Sec. 4, ablation)."""

    def __init__(self, template: SkeletonTemplate | str = MEDIAPIPE33) -> None:
        super().__init__()
        template = named_template(template)
        self.channels = len(template.edges)
        self.linear = nn.Linear(3 * len(template.names), self.channels)

    def forward(self, omega: Tensor, pose: Tensor) -> Tensor:
        """g ``[B, 35]`` from ``pose`` ``[B, J, 3]`` (camera axes, body heights); Ω is unused."""
        return self.linear(pose.flatten(1))


@dataclass(frozen=True)
class PoseGraphSettings:
    """Settings of `PoseGraph`: conf/model/pose_encoder/graph.yaml."""

    template: str
    width: int
    joint_channels: int
    octaves: int

    def build(self) -> PoseGraph:
        """The network, with new weights."""
        return PoseGraph(**vars(self))


@dataclass(frozen=True)
class PoseLinearSettings:
    """Settings of `PoseLinear`: conf/model/pose_encoder/linear.yaml."""

    template: str

    def build(self) -> PoseLinear:
        """The layer, with new weights."""
        return PoseLinear(self.template)


def pose_inputs(
    p: Tensor,
    valid: Tensor,
    frames: BoneFrames,
    camera: Camera,
    template: SkeletonTemplate,
    stature: float,
) -> tuple[Tensor, Tensor]:
    """The inputs of both encoders.

    Args:
        p, valid: ``[B, J, 3]`` metres, world; ``[B, J]`` bool.
        frames: of the bones.
        camera: B cameras.
        template: of the skeleton.
        stature: metres.

    Returns:
        Ω ``[B, J, 6]``, and joints ``[B, J, 3]`` about the root in camera axes and body heights,
        those of the face replaced by its `face_code`.
    """
    # Joints in camera axes, so that g depends on what the camera sees of the pose.
    root = root_of(p, template).unsqueeze(1)
    in_camera = (p - root) @ camera.R.mT / stature

    # Landmarks of the face have a code of their own.
    if (face := face_code(p, frames.head, template)) is not None:
        in_camera = torch.cat([in_camera[:, : -face.shape[1]], face], dim=1)
    return omega(p, valid, camera.R, template, frames=frames), in_camera
