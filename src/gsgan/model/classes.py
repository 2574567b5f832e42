"""The classes of S: which of the data's labels get a channel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsgan.body.smpl_names import group_of_part
from gsgan.utils.errors import ConfigError

IGNORE = 255
MODES = ("body", "hands")
HANDS = ("left_hand", "right_hand")
FACE = "face_neck"


@dataclass(frozen=True)
class ClassMap:
    """The classes of S, and the class of each of the data's labels.

    Convention: class 0 is the background. Labels that no vertex has are numbered after the
    channels: S cannot learn them, and scores count them as missed.

    Args:
        names: of the channels, background first.
        absent: names of the labels without a vertex.
        table: the class of each label.
    """

    names: tuple[str, ...]
    absent: tuple[str, ...]
    table: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.names)

    @property
    def truth_classes(self) -> int:
        """Classes of the ground truth, those without a channel included."""
        return len(self.names) + len(self.absent)

    def as_table(self) -> Tensor:
        """``[256]`` int64: the class of each label; IGNORE for unnamed ones and 255."""
        table = torch.full((256,), IGNORE)
        table[: len(self.table)] = torch.tensor(self.table)
        return table


def class_map(
    label_names: Sequence[str], vertex_labels: Tensor, mode: str = "body", face: bool = False
) -> ClassMap:
    """The classes of a mode.

    Args:
        label_names: of the data's labels, background first.
        vertex_labels: ``[V]`` int64, the label of each vertex of the body.
        mode: ``body``: every label that a vertex has. ``hands``: the left and the right hand; the
            rest counts as background, and still occludes.
        face: with ``hands``, the face (and neck, where the labels join them) as a third class.

    Raises:
        ConfigError: on another mode, or when no label names a requested hand or face.
    """
    if mode not in MODES:
        raise ConfigError(f"model.segmentation.mode must be {' or '.join(MODES)}; got {mode!r}")
    if mode == "hands":
        return _hands(label_names, face)
    present = set(vertex_labels.unique().tolist()) - {0}
    kept = [0, *sorted(present)]
    absent = [label for label in range(1, len(label_names)) if label not in present]
    number = {label: i for i, label in enumerate([*kept, *absent])}
    return ClassMap(
        names=tuple(label_names[label] for label in kept),
        absent=tuple(label_names[label] for label in absent),
        table=tuple(number[label] for label in range(len(label_names))),
    )


def _hands(label_names: Sequence[str], face: bool) -> ClassMap:
    requested = (*HANDS, FACE) if face else HANDS
    groups = [group_of_part(name) for name in label_names]
    lacking = [name for name in requested if name not in groups]
    if lacking:
        raise ConfigError(
            f"model.segmentation.mode=hands needs labels for {', '.join(requested)}, but they name "
            f"no {' and no '.join(lacking)} ({', '.join(label_names)}); choose mode=body"
        )
    table = tuple(1 + requested.index(g) if g in requested else 0 for g in groups)
    return ClassMap(names=("background", *requested), absent=(), table=table)
