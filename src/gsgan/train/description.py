"""What a run prints when it begins: its data, parts, effects and stand-ins."""

from pathlib import Path
from typing import Any

import gsgan.utils.compat  # noqa: F401  (must come before lightning)

# isort: split
import torch
from rich.console import Console
from rich.table import Table

from gsgan.data.datamodule import GsganData
from gsgan.model.body_points import DENSE, points_per_pixel
from gsgan.skeleton import TEMPLATES
from gsgan.splat import resolve_backend
from gsgan.train.module import AvatarTraining
from gsgan.utils.config import BFLOAT16_SINCE

Row = tuple[str, str]  # a name, and what is said of it


def describe(
    console: Console,
    folder: Path,
    data: GsganData,
    module: AvatarTraining,
    device: torch.device,
    precision: str,
    hours: float | None,
) -> None:
    """Prints the data, the parts with their sizes, the effects and the stand-ins in use.

    Args:
        console, folder: where it is printed, and the run's folder.
        data, module: of the run.
        device, precision: of the training.
        hours: that training is expected to take; None: unknown.
    """
    # The data, the parts and what they learn from, then how they are trained.
    table = Table(title=f"gsgan: {folder}", show_header=False)
    schedule = module.schedule
    rows = [
        *_data(data),
        *_parts(module),
        *_gaussians(module, data),
        *_losses(module, data),
        *_rasteriser(module, device),
        ("precision", _precision(precision)),
        (
            "schedule",
            f"segmentation {schedule.segmentation}, Step I {schedule.step_one}, "
            f"Step II {schedule.step_two}",
        ),
    ]
    if hours is not None:
        rows.append(("time", f"{_duration(hours)} of training on this CPU"))
    for name, text in rows:
        table.add_row(name, text)
    console.print(table)

    # The stand-ins and the effects.
    for mark in module.marks:
        console.print(f"stand-in in use: {mark}", highlight=False)
    console.print(module.avatar.effects.table())


def _duration(hours: float) -> str:
    """Hours as text, rounded: an estimate."""
    if hours < 1.5:
        return f"about {max(60 * hours, 1):.0f} minutes"
    return f"about {hours:.0f} hours"


def _data(data: GsganData) -> list[Row]:
    """The images, and the memory that is kept for them."""
    info = data.info
    held_out = ", ".join(
        f"{len(data.dataset(name))} {name}" for name in data.eval_names
    )
    processes = data.loading_processes
    megabytes = data.cache_mb / processes
    each = (
        "" if processes == 1 else f" in each of {processes} loading processes"
    )
    return [
        (
            "data",
            f"{len(data.dataset('train'))} training images: {info.n_train_cameras} cameras, "
            f"{info.frames} frames; held out: {held_out}",
        ),
        (
            "images",
            f"{data.size or 'their own'} pixels (data.size); skeleton {info.skeleton} of "
            f"{len(TEMPLATES[info.skeleton].names)} joints (data.skeleton)",
        ),
        ("cache of images", f"{megabytes:,.0f} MB{each} (data.cache_mb)"),
    ]


def _parts(module: AvatarTraining) -> list[Row]:
    """The networks and their sizes."""
    avatar = module.avatar
    plain = getattr(avatar.deformation, "from_normal", avatar) is None
    parts: dict[str, Any] = {
        "Ψ, without normals" if plain else "Ψ": avatar.deformation,
        "surface": avatar.surface,
        "colour correction": avatar.colour,
        "pose encoder": avatar.pose_encoder,
        "generator": avatar.generator,
        "discriminator": module.discriminator,
        "segmentation S": avatar.segmentation,
    }
    rows = []
    for name, part in parts.items():
        if part is None:
            continue
        size = sum(p.numel() for p in part.parameters())
        rows.append((name, f"{size:,} parameters"))
        # A generator of one's own has no patch.
        if getattr(part, "patch", 1) > 1 and part.refinement is None:
            rows.append(("", "without a last level at the image's resolution"))
    return rows


def _gaussians(module: AvatarTraining, data: GsganData) -> list[Row]:
    """The Gaussians on the body, and where registration found its surface."""
    rows = []
    on_body = module.avatar.body_points
    if on_body is not None:
        scale = data.info.scale_train[1]
        apart = on_body.pixels_apart(scale)
        number = f"{len(on_body.points):,} on the body"
        rows.append(
            (
                "Gaussians",
                f"{number}, {apart:.1f} pixels apart in the training images",
            )
        )
        rows += _advice(module, len(on_body.points), scale)
    if module.surface_offsets is not None:
        metres = module.surface_offsets.offsets.norm(dim=2).median()
        rows.append(
            (
                "registration",
                f"{len(module.surface_offsets)} frames; their surface is "
                f"{1000 * float(metres):.0f} mm (median) from where their poses put it",
            )
        )
    return rows


def _advice(module: AvatarTraining, count: int, scale: float) -> list[Row]:
    """Whether the model could do without its generator, as ``count`` Gaussians on the body are as
    many as pixels in images of ``scale`` pixels per metre."""
    per_pixel = points_per_pixel(count, module.avatar.stature, scale)
    if module.avatar.generator is None or per_pixel < DENSE:
        return []
    return [
        (
            "advice",
            f"{per_pixel:.2g} Gaussians per pixel of the person: from {DENSE:g} on, Step I's "
            "colour scored as well as the final image, and model=splat_only trains it alone, in "
            "less time (docs/ablations.md#who-needs-the-generator)",
        )
    ]


def _losses(module: AvatarTraining, data: GsganData) -> list[Row]:
    """The losses that need other networks or labels."""
    rows = []
    if module.perceptual is not None:
        every = module.step_two.perceptual_every
        when = "every iteration" if every == 1 else f"every {every} iterations"
        rows.append(
            (
                "perceptual loss",
                f"{module.perceptual.description}; {when} of Step II",
            )
        )

    # The segmentation has a row of its size, if it is built.
    avatar = module.avatar
    if avatar.segmentation is None:
        rows.append(("segmentation S", f"not built: {avatar.segmentation_why}"))
    else:
        source = (
            "part labels"
            if data.info.has_labels
            else "masks: the data has no part labels"
        )
        rows.append(("", f"{avatar.segmentation_why}; S learns from {source}"))
    return rows


def _rasteriser(module: AvatarTraining, device: torch.device) -> list[Row]:
    """The rasteriser's backend, if anything is splatted."""
    avatar = module.avatar
    if avatar.splats is None:
        return []
    backend, _ = resolve_backend(avatar.backend, device, avatar.accuracy)
    return [("rasteriser", backend)]


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
