"""Features of the part of an image that differs from its background, at the cost of that part.

Elsewhere the features are those of an image of the background alone, which is computed once. A
layer's output can only differ where its windows reach a difference of its input, so each layer is
computed there, in strips that are as wide as the differences in them, and reads what lies around
from the background's maps.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

# The first row or column, and the first one after the last.
Span = tuple[int, int]
# Rows of a strip, at least 1: lower strips follow an outline better and run slower.
STRIP = 32


class MapPart(NamedTuple):
    """A part of a map.

    Args:
        values: ``[1, C, h, w]`` in these rows and columns.
        rows, columns: of the map.
        differs: ``[1, 1, H, W]``, 1 where the whole map may differ from the background's.
    """

    values: Tensor
    rows: Span
    columns: Span
    differs: Tensor


class BackgroundMaps:
    """The maps of an image of the background alone.

    Args:
        stages: of a network, with convolutions, ReLUs and poolings without padding.
        image: ``[1, 3, H, W]`` as the first layer gets it, like all images here.
    """

    @torch.no_grad()
    def __init__(self, stages: nn.ModuleList, image: Tensor) -> None:
        self.stages = stages
        self.image = image

        # The input and the output of each layer, and the maps after each stage.
        self.inputs: dict[nn.Module, Tensor] = {}
        self.outputs: dict[nn.Module, Tensor] = {}
        self.maps = []
        values = image
        for stage in stages:
            for layer in stage.children():
                self.inputs[layer] = values
                values = layer(values)
                self.outputs[layer] = values
            self.maps.append(values)

    @torch.no_grad()
    def differing(self, image: Tensor) -> list[MapPart]:
        """The part of each map of an image in which it may differ from the background's; an empty
        list for an image that equals the background."""
        # The smallest rectangle around all pixels that differ.
        differs = (image != self.image).any(dim=1, keepdim=True)
        if not differs.any():
            return []
        rows = _span(differs.any(dim=3))
        columns = _span(differs.any(dim=2))
        values = _cut(image, rows, columns)
        part = MapPart(values, rows, columns, differs.float())

        # Each layer continues from the part of the one before.
        parts = []
        for stage in self.stages:
            for layer in stage.children():
                part = self._after(layer, part)
            parts.append(part)
        return parts

    def on(
        self, stage: int, parts: list[MapPart], rows: Span, columns: Span
    ) -> Tensor:
        """A stage's map of an image with these parts, in rows and columns that contain its part."""
        # Only a part that is smaller needs the background around it.
        if parts and (parts[stage].rows, parts[stage].columns) == (
            rows,
            columns,
        ):
            return parts[stage].values
        values = _cut(self.maps[stage], rows, columns)
        if not parts:
            return values
        return _paste(values, parts[stage], rows[0], columns[0])

    def _after(self, layer: nn.Module, part: MapPart) -> MapPart:
        """The part of a layer's output, from that of its input."""
        if isinstance(layer, nn.ReLU):
            return part._replace(values=layer(part.values))

        # The outputs that read the part, and all that they read; zeros lie around the image.
        before = self.inputs[layer]
        rows, read_rows = _reach(layer, part.rows, before.shape[-2])
        columns, read_columns = _reach(layer, part.columns, before.shape[-1])
        read = _cut(before, read_rows, read_columns)
        read = _paste(read, part, read_rows[0], read_columns[0])

        # The outputs whose windows hold a difference; the others are the background's.
        window = _window(layer)
        differs = functional.max_pool2d(part.differs, *window)
        where = _cut(differs, rows, columns) > 0
        values = _cut(self.outputs[layer], rows, columns).clone()

        # The padding is in what is read already.
        kernel, stride, _ = window
        for top in range(0, rows[1] - rows[0], STRIP):
            strip = where[:, :, top : top + STRIP]
            if not strip.any():
                continue
            left, right = _span(strip.any(dim=2))
            bottom = top + strip.shape[2]
            inputs = read[
                ...,
                top * stride : (bottom - 1) * stride + kernel,
                left * stride : (right - 1) * stride + kernel,
            ]
            outputs = values[..., top:bottom, left:right]
            outputs.copy_(_without_padding(layer, inputs))
        return MapPart(values, rows, columns, differs)


def _without_padding(layer: nn.Module, values: Tensor) -> Tensor:
    """A layer's output for inputs that hold its padding."""
    if isinstance(layer, nn.Conv2d):
        return functional.conv2d(values, layer.weight, layer.bias, layer.stride)
    return layer(values)


def union(spans: Sequence[Span]) -> Span:
    """The shortest span that contains all."""
    return min(start for start, _ in spans), max(end for _, end in spans)


def _span(marked: Tensor) -> Span:
    """From the first to the last of the marked places."""
    places = marked.flatten().nonzero().flatten().tolist()
    return places[0], places[-1] + 1


class LayerWindow(NamedTuple):
    """What a layer reads, equal for rows and columns."""

    kernel: int
    stride: int
    padding: int


def _window(layer: nn.Module) -> LayerWindow:
    """The window of a convolution or a pooling."""
    assert isinstance(layer, nn.Conv2d | nn.MaxPool2d)
    return LayerWindow(
        kernel=_side(layer.kernel_size),
        stride=_side(layer.stride),
        padding=_side(layer.padding),
    )


def _side(setting: int | tuple[int, ...] | str) -> int:
    """A setting of a layer, equal for rows and columns."""
    return int(setting[0] if isinstance(setting, tuple) else setting)


def _reach(layer: nn.Module, span: Span, length: int) -> tuple[Span, Span]:
    """The outputs whose windows read any of a span of ``length`` inputs, and all that they read."""
    kernel, stride, padding = _window(layer)

    # Output i reads from i · stride - padding on. A pooling may leave out the last inputs; then the
    # last output is computed again.
    last = (length + 2 * padding - kernel) // stride
    low = -((kernel - 1 - span[0] - padding) // stride)
    low = min(max(0, low), last)
    high = min(max(low, (span[1] - 1 + padding) // stride), last)
    start = low * stride - padding
    end = high * stride - padding + kernel
    return (low, high + 1), (start, end)


def _cut(values: Tensor, rows: Span, columns: Span) -> Tensor:
    """Rows and columns of ``[1, C, H, W]``, zeros where they are beyond it."""
    height, width = values.shape[-2:]
    inside = values[
        ...,
        max(0, rows[0]) : min(height, rows[1]),
        max(0, columns[0]) : min(width, columns[1]),
    ]
    beyond = (
        max(0, -columns[0]),
        max(0, columns[1] - width),
        max(0, -rows[0]),
        max(0, rows[1] - height),
    )
    return functional.pad(inside, beyond) if any(beyond) else inside


def _paste(values: Tensor, part: MapPart, top: int, left: int) -> Tensor:
    """Values that begin at row ``top`` and column ``left`` of a map, with a part of it in place."""
    first_row = part.rows[0] - top
    first_column = part.columns[0] - left
    place = values.clone()
    space = place[..., first_row:, first_column:]
    height = min(space.shape[-2], part.values.shape[-2])
    width = min(space.shape[-1], part.values.shape[-1])
    space[..., :height, :width] = part.values[..., :height, :width]
    return place
