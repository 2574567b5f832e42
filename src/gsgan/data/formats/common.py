"""The shared part of the readers: settings, the user's body model, and the final checks."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from gsgan.body.smpl import SkinnedModel, read_smpl
from gsgan.data.cameras import CameraEntry
from gsgan.data.formats.consistency import Consistency, check_consistency
from gsgan.data.layout import (
    DatasetFiles,
    Layout,
    MaskIndex,
    assemble,
    dataset_folder,
)
from gsgan.data.pixels import MaskFile, mask_file
from gsgan.data.splits import parse_frames
from gsgan.data.validation import Thresholds
from gsgan.skeleton.proportions import axis_name
from gsgan.skeleton.smpl_landmarks import TABLES
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.image_files import read_header

IMAGES = (".jpg", ".jpeg", ".png")
# By kind of body: its name, and an example of a model's file.
MODELS = {
    "smpl": ("SMPL", "SMPL_NEUTRAL.pkl"),
    "smplx": ("SMPL-X", "SMPLX_NEUTRAL.npz"),
}


@dataclass(frozen=True, kw_only=True)
class FolderReader:
    """Reads a published dataset's folder; a subclass finds its files and sets the defaults.

    conf/data/*.yaml explain the settings.
    """

    # Settings that a format may have other defaults for.
    drop_frames: Any = None
    distance: tuple[float, float] = (0.5, 20.0)
    max_missing_masks: float = 0.05
    pixel_centre: float = 0.0
    consistency: Consistency = field(default_factory=Consistency)

    contents: ClassVar[str]
    """The folder's content, for messages."""
    hint: ClassVar[str]
    """Advice for a message when body and masks do not agree."""

    def __call__(
        self, root: str | Path, limits: Thresholds, smpl: str | None = None
    ) -> Layout:
        """Reads and checks everything except most images' pixels.

        Args:
            root: the dataset's folder.
            limits: thresholds of all formats.
            smpl: the user's SMPL or SMPL-X model file.

        Raises:
            DataError: for whatever is missing, damaged or contradictory, naming the file.
        """
        folder = dataset_folder(root, self.contents)

        # The images of a release are alike, so fewer headers are read.
        limits = replace(
            limits,
            distance=(self.distance[0], self.distance[1]),
            max_missing_masks=self.max_missing_masks,
            header_stride=20,
        )
        layout = self.find(folder, limits, smpl)
        return finish(
            layout, limits, self.consistency, self.hint, self.drop_frames
        )

    def find(
        self, root: Path, limits: Thresholds, smpl: str | None
    ) -> DatasetFiles:
        """The dataset's files, each checked separately.

        Raises:
            DataError: for whatever is missing or damaged, naming the file.
        """
        raise NotImplementedError


def finish(
    files_found: DatasetFiles,
    limits: Thresholds,
    consistency: Consistency,
    hint: str,
    drop_frames: Any = None,
) -> Layout:
    """Checks the files against each other and a few masks against the joints.

    Args:
        files_found: by a reader.
        limits: thresholds.
        consistency: number of compared images, and thresholds.
        hint: what to check when joints and masks do not agree.
        drop_frames: frames to leave out, or None.

    Raises:
        DataError: for whatever is missing or contradictory, naming the file.
        ConfigError: when ``drop_frames`` is malformed or leaves no frame.
    """
    # Frames that the user leaves out.
    if drop_frames is not None:
        gone = parse_frames(drop_frames, "data.reader.drop_frames")
        images = {
            name: files.without(gone)
            for name, files in files_found.images.items()
        }
        if not any(images.values()):
            raise ConfigError(
                f"data.reader.drop_frames={drop_frames} leaves no frame"
            )
        files_found = replace(files_found, images=images)

    # Files against each other, then a few masks against the joints.
    layout = assemble(files_found, limits)
    check_consistency(layout, consistency, hint)
    return layout


def body_model(
    root: Path, smpl: str | None, kind: str
) -> tuple[Path, SkinnedModel]:
    """The user's body model file and the model in it.

    Args:
        root: the dataset, for messages.
        smpl: the file.
        kind: "smpl" or "smplx", which it must be.

    Raises:
        ConfigError: when the file does not exist.
        DataError: when none is given, or it is damaged or of another kind.
    """
    name, example = MODELS[kind]

    # The model has its own licence, so that the user must provide it.
    if smpl is None:
        raise DataError(
            f"{root} holds {name} parameters but no joints, and joints need the body model: give "
            f"data.smpl=/path/to/your {name} file ({example}), which has its own licence and is "
            "not part of this project"
        )
    path = Path(smpl).expanduser()
    if not path.is_file():
        raise ConfigError(
            f"data.smpl={smpl} does not exist; expected an SMPL or SMPL-X .pkl or .npz"
        )

    # The right kind of body, with the vertices that the landmarks are defined on.
    model = read_smpl(path)
    joints, vertices = TABLES[kind].counts
    if model.kind != kind:
        raise DataError(
            f"{path} is a model of {len(model.parents)} joints; this dataset's parameters are of "
            f"{name} ({joints} joints)"
        )
    if len(model.v_template) != vertices:
        raise DataError(
            f"{path} has {len(model.v_template)} vertices; expected the {vertices} of {name}, "
            "whose numbers the landmarks use: get the model from its own site"
        )
    return path, model


def up_axis(cameras: Iterable[CameraEntry]) -> str:
    """The world axis nearest to the mean of the cameras' upward directions, e.g. "-z"."""
    # Camera axes point right, down and forward.
    upward = [-camera.R[1] for camera in cameras]
    return axis_name(np.mean(upward, axis=0))


def image_size(root: Path, files: Mapping[int, str]) -> tuple[int, int]:
    """``(H, W)`` of a camera's first image.

    Raises:
        DataError: when it is damaged.
    """
    # All images of a camera have one size, which is checked later.
    first = next(iter(files.values()))
    size, _, _ = read_header(root / first)
    return size


class _Masks(Mapping[int, tuple[MaskFile, ...]]):
    """Files as masks, one per image, made when they are asked for; JPEG files with alpha from 0 to
    255 have the rule of JPEG masks."""

    def __init__(self, files: Mapping[int, str], rule: str) -> None:
        self.files = files
        self.rule = rule

    def __getitem__(self, frame: int) -> tuple[MaskFile, ...]:
        # Millions of tuples would take more memory than the paths.
        path = self.files[frame]
        if self.rule == "grey" and path.lower().endswith((".jpg", ".jpeg")):
            return (mask_file(path),)
        return (MaskFile(self.rule, path),)

    def __iter__(self) -> Iterator[int]:
        return iter(self.files)

    def __len__(self) -> int:
        return len(self.files)


def one_mask_each(
    files: Mapping[str, Mapping[int, str]], rule: str
) -> MaskIndex:
    """Masks by camera and frame, one file per image, all of one rule."""
    return {name: _Masks(paths, rule) for name, paths in files.items()}
