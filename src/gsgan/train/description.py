"""What a run prints when it begins: its data, parts, effects and stand-ins."""

from pathlib import Path

import gsgan.utils.compat  # noqa: F401  (must come before lightning)

# isort: split
import torch
from rich.console import Console
from rich.table import Table

from gsgan.data.datamodule import GsganData
from gsgan.splat import resolve_backend
from gsgan.train.module import AvatarTraining
from gsgan.utils.config import BFLOAT16_SINCE


def describe(
    console: Console,
    folder: Path,
    data: GsganData,
    module: AvatarTraining,
    device: torch.device,
    precision: str,
) -> None:
    """Prints the data, the parts with their sizes, the effects and the stand-ins in use."""
    info = data.info
    avatar = module.avatar

    # The data.
    held_out = ", ".join(
        f"{len(data.dataset(name))} {name}" for name in data.eval_names
    )
    table = Table(title=f"gsgan: {folder}", show_header=False)
    table.add_row(
        "data",
        f"{len(data.dataset('train'))} training images: {info.n_train_cameras} cameras, "
        f"{info.frames} frames; held out: {held_out}",
    )
    processes = data.loading_processes
    megabytes = data.cache_mb / data.loading_processes
    each = (
        "" if processes == 1 else f" in each of {processes} loading processes"
    )
    table.add_row(
        "cache of images", f"{megabytes:,.0f} MB{each} (data.cache_mb)"
    )

    # The parts and their sizes.
    plain = getattr(avatar.deformation, "from_normal", avatar) is None
    parts = {
        "Ψ, without normals" if plain else "Ψ": avatar.deformation,
        "surface": avatar.surface,
        "colour correction": avatar.colour,
        "pose encoder": avatar.pose_encoder,
        "generator": avatar.generator,
        "discriminator": module.discriminator,
        "segmentation S": avatar.segmentation,
    }
    for name, part in parts.items():
        if part is not None:
            table.add_row(
                name,
                f"{sum(p.numel() for p in part.parameters()):,} parameters",
            )

    # The Gaussians.
    on_body = avatar.body_points
    if on_body is not None:
        apart = on_body.pixels_apart(info.scale_train[1])
        number = f"{len(on_body.points):,} on the body"
        table.add_row(
            "Gaussians",
            f"{number}, {apart:.1f} pixels apart in the training images",
        )

    # The surface of the training frames.
    if module.registered is not None:
        metres = module.registered.offsets.norm(dim=2).median()
        table.add_row(
            "registration",
            f"{len(module.registered)} frames; their surface is {1000 * float(metres):.0f} mm "
            "(median) from where their poses put it",
        )

    # The losses that need other networks or labels.
    if module.perceptual is not None:
        every = module.step_two.perceptual_every
        when = "every iteration" if every == 1 else f"every {every} iterations"
        table.add_row(
            "perceptual loss",
            f"{module.perceptual.description}; {when} of Step II",
        )
    if avatar.segmentation is None:
        table.add_row("segmentation S", f"not built: {avatar.segmentation_why}")
    else:
        source = (
            "part labels"
            if info.has_labels
            else "masks: the data has no part labels"
        )
        table.add_row("", f"{avatar.segmentation_why}; S learns from {source}")

    # The rasteriser, the precision and the schedule.
    if avatar.splats is not None:
        backend = resolve_backend(avatar.backend, device, avatar.accuracy)[0]
        table.add_row("rasteriser", backend)
    table.add_row("precision", _precision(precision))
    s = module.schedule
    table.add_row(
        "schedule",
        f"segmentation {s.segmentation}, Step I {s.step_one}, Step II {s.step_two}",
    )
    console.print(table)
    for mark in module.marks:
        console.print(f"stand-in in use: {mark}", highlight=False)
    console.print(avatar.effects.table())


def _precision(chosen: str) -> str:
    """The trainer's precision, and why it is 32 bits on an old GPU."""
    # Without a GPU, or with bf16, the setting speaks for itself.
    if chosen == "bf16-mixed" or not torch.cuda.is_available():
        return chosen

    # On a GPU that has bf16 the user chose another precision.
    capability = torch.cuda.get_device_capability()
    if capability >= BFLOAT16_SINCE:
        return chosen
    return f"{chosen}: this GPU (compute capability {'.'.join(map(str, capability))}) has no bf16"
