"""The avatar's networks as programs for other runtimes: ONNX and ``torch.export``."""

import copy
import io
from typing import Any
from warnings import catch_warnings

import torch
from torch import Tensor, nn
from torch.export import Dim

from gsgan.model.avatar import Avatar
from gsgan.model.generator import Generator
from gsgan.scene import BodyPose, Camera
from gsgan.utils.errors import ConfigError

MAX_PROGRAM_SIDE = 8192  # largest side of an ONNX program's images, pixels


def unfrozen(avatar: Avatar) -> Avatar:
    """A copy without the values that `Avatar.freeze` caches: it computes from its weights alone."""
    bare = copy.deepcopy(avatar).cpu()
    # Frozen modules keep derived values in this dictionary.
    for part in bare.modules():
        vars(part).pop("derived", None)
    # The exporters record the strides of weights: they are made contiguous.
    return bare.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload, no-any-return]


class Whole(nn.Module):
    """Skeleton and camera in, the whole image out; a window's size would depend on the pose.

    Args:
        avatar: unfrozen.
        size: ``(H, W)`` pixels of the image.
    """

    def __init__(self, avatar: Avatar, size: tuple[int, int]) -> None:
        super().__init__()
        self.avatar = avatar
        self.size = size

        # A window would have another size in every pose.
        avatar.window_margin = None
        avatar.generator_margin = None

    def forward(
        self,
        skeleton: Tensor,
        visibility: Tensor,
        K: Tensor,
        R: Tensor,
        t: Tensor,
        theta: Tensor | None = None,
        transl: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """``[1, 3, H, W]`` RGB on black and ``[1, 1, H, W]`` alpha, both in [0, 1].

        Args:
            skeleton: ``[1, J, 3]`` metres, world frame, finite; J is 33, 75 with hands, 105
                with a face.
            visibility: ``[1, J]`` 0 marks a stand-in.
            K, R, t: ``[1, 3, 3]``, ``[1, 3, 3]``, ``[1, 3]`` of the camera.
            theta, transl: pose of the skinned body, if the avatar needs one.
        """
        body = (
            None if theta is None or transl is None else BodyPose(theta, transl)
        )
        rendering = self.avatar(
            skeleton, visibility, Camera(K, R, t, self.size), body
        )
        assert rendering.image is not None and rendering.alpha is not None  # noqa: PT018
        return rendering.image.clamp(0, 1), rendering.alpha.clamp(0, 1)


def torch_program(avatar: Avatar, size: tuple[int, int]) -> bytes:
    """A .pt2 file of `Whole`, which ``torch.export.load`` reads.

    Rasterisation is the operator ``gsgan::rasterise``, so a program that loads it imports
    `gsgan.splat` first.
    """
    # Example inputs: the template at rest, before a camera three metres away.
    p = torch.tensor(avatar.template.rest_positions)[None]
    height, width = size
    K = torch.tensor(
        [
            [
                [float(width), 0, width / 2],
                [0, width, height / 2],
                [0, 0, 1],
            ]
        ]
    )
    R = torch.tensor([[[-1.0, 0, 0], [0, -1, 0], [0, 0, 1]]])
    t = torch.tensor([[0.0, 0.9, 3.0]])
    given = [p, torch.ones(p.shape[:2]), K, R, t]

    # The body's pose is an input of avatars that move with a skinned body.
    if avatar.needs_body:
        part = avatar.body_points or avatar.surface or avatar.segmentation
        bones = len(part.points.parents)  # type: ignore[union-attr]
        given += [torch.zeros(1, bones, 3), torch.zeros(1, 3)]

    # Constants are made by a first call, outside of the recording. The exporter warns about
    # internals of its own.
    program = Whole(unfrozen(avatar), size)
    stream = io.BytesIO()
    with torch.no_grad(), catch_warnings(action="ignore"):
        program(*given)
        recorded = torch.export.export(program, tuple(given), strict=False)
        torch.export.save(recorded, stream)
    return stream.getvalue()


class PoseAndGenerator(nn.Module):
    """Images of the avatar's splats and skeleton in, its image out: pose encoder and UNet.

    Its inputs, by name: ``features`` F ``[1, C, H, W]``, ``fine`` F before it was averaged, if the
    avatar supersamples; ``splat_alpha`` of F ``[1, 1, H, W]``; ``segmentation`` S ``[1,
    classes, H, W]``, if it has one; ``skeleton`` p₂D ``[1, groups, H, W]``; ``omega`` Ω ``[1, J,
    6]`` and ``joints`` ``[1, J, 3]``, see `gsgan.model.pose_graph.pose_inputs`.

    Args:
        avatar: unfrozen, with a generator.
    """

    def __init__(self, avatar: Avatar) -> None:
        super().__init__()
        if avatar.generator is None:
            raise ConfigError(
                "this avatar has no generator to export: its image is Step I's colour"
            )
        self.splats = avatar.splat_channels > 0
        self.template = avatar.template
        self.pose_encoder = avatar.pose_encoder
        assert isinstance(avatar.generator, Generator)
        self.generator = avatar.generator

        # Images that the avatar does not render have no channels.
        classes = (
            0 if avatar.segmentation is None else avatar.segmentation.classes
        )
        self.channels = {
            "features": avatar.splat_channels,
            "segmentation": classes,
        }

    def inputs(self) -> tuple[dict[str, Tensor], dict[str, int]]:
        """Examples by name, for the exporter; of images, the pixels per pixel of the output."""
        # Channels of each image; an image without channels is no input.
        k = self.generator.supersample
        channels = self.channels | {
            "skeleton": len(self.template.draw_groups),
            "splat_alpha": int(self.splats),
            "fine": self.channels["features"] if k > 1 else 0,
        }

        # Random images of a small size that the UNet can halve as often as it does.
        side = 4 * self.generator.stride
        times = {}
        examples = {}
        for name, count in channels.items():
            if count:
                times[name] = k if name == "fine" else 1
                pixels = times[name] * side
                examples[name] = torch.rand(1, count, pixels, pixels)

        J = len(self.template.names)
        examples["omega"] = torch.rand(1, J, 6)
        examples["joints"] = torch.rand(1, J, 3)
        return examples, times

    def forward(
        self,
        omega: Tensor,
        joints: Tensor,
        skeleton: Tensor,
        features: Tensor | None = None,
        fine: Tensor | None = None,
        splat_alpha: Tensor | None = None,
        segmentation: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """``[1, 3, H, W]`` RGB on black and ``[1, 1, H, W]`` alpha, both in [0, 1]."""
        assert self.pose_encoder is not None
        g = self.pose_encoder(omega, joints)
        # Without splats (image_to_image) the drawn skeleton takes F's place.
        if features is None:
            made = self.generator(skeleton, segmentation, None, g)
        else:
            made = self.generator(
                features, segmentation, skeleton, g, fine, splat_alpha
            )
        made = made.clamp(0, 1)
        return made[:, :3], made[:, 3:]


def onnx_program(avatar: Avatar) -> bytes:
    """A .onnx file of `PoseAndGenerator`; height and width: any multiples of the UNet's stride.

    Raises:
        ConfigError: when the packages are missing, or the avatar has no generator.
    """
    try:
        import onnx  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError:
        raise ConfigError(
            "format=onnx needs: pip install 'gsgan[export]'"
        ) from None
    networks = PoseAndGenerator(unfrozen(avatar)).eval()
    given, times = networks.inputs()

    # Sides of images are free multiples of the UNet's stride.
    stride = networks.generator.stride
    maximum = MAX_PROGRAM_SIDE // stride
    height = stride * Dim("h", min=1, max=maximum)
    width = stride * Dim("w", min=1, max=maximum)
    shapes: dict[str, dict[int, Any] | None] = dict.fromkeys(given)
    for name, factor in times.items():
        shapes[name] = {2: factor * height, 3: factor * width}

    # The exporter warns about internals of its own.
    with torch.no_grad(), catch_warnings(action="ignore"):
        program = torch.onnx.export(
            networks,
            kwargs=given,
            dynamo=True,
            dynamic_shapes=shapes,
            input_names=list(given),
            output_names=["image", "alpha"],
            verbose=False,
        )
    assert program is not None

    # A single file: the weights are part of it.
    content: bytes = program.model_proto.SerializeToString()
    return content
