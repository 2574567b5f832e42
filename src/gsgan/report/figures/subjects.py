"""The content of figures: images of a split, and the avatars that render them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from gsgan.data.datamodule import GsganData
from gsgan.data.splits import SPLITS, Item
from gsgan.data.validation import spans
from gsgan.evaluate.origin import fingerprint
from gsgan.metrics.image import edge_f1, psnr
from gsgan.model.avatar import Avatar
from gsgan.report.runs import DATA, NAME, ScoredRun, check_same, read_run
from gsgan.run.assemble import RunSettings
from gsgan.run.runs import load_avatar
from gsgan.run.stored import CHECKPOINT, DataPaths, load_config, read_checkpoint
from gsgan.scene import Frame, Window, body_window, cat
from gsgan.utils.arrays import evenly_spaced
from gsgan.utils.checks import one_of
from gsgan.utils.errors import ConfigError, DataError

MIN_WINDOW = 16  # pixels, the shortest side of a window
TITLES = {  # of models, in print
    "full": "gsgan",
    "wo_seg": "w/o S",
    "wo_gcn": "w/o GCN",
    "wo_feat": "w/o L_feat",
    "splat_only": "splat only",
    "lbs_splat": "LBS splat",
    "image_to_image": "image to image",
}
Numbers = dict[str, float | None]


@dataclass(frozen=True, eq=False)
class Shot:
    """One image of a split, and the part of it that is shown."""

    item: Item  # camera name and frame number
    frame: Frame
    window: Window  # the part

    @property
    def name(self) -> str:
        """The name of its files in a capture: camera/frame."""
        return f"{self.item[0]}/{self.item[1]:06d}"

    @property
    def truth(self) -> Tensor:
        """``[1, 3, h, w]`` the ground truth as shown."""
        return self.window.cut(self.frame.image)


def choose_items(
    data: GsganData,
    split: str,
    *,
    frames: Sequence[int] | None,
    camera: str | None,
    count: int,
    one_camera: bool = False,
) -> list[Item]:
    """Camera and frame of each image to show.

    Without ``frames``, ``count`` of them are spread evenly over the split; without ``camera``, its
    cameras are taken in turn, one per image, or only the first (``one_camera``).

    Raises:
        ConfigError: on an unknown split, camera or frame.
        DataError: when the split is empty.
    """
    items = data.splits.items[one_of("split", split, SPLITS)]
    if not items:
        others = [f"split={name}" for name in SPLITS if data.splits.items[name]]
        use = ", ".join(others)
        raise DataError(
            f"split {split} has no images: {data.reasons[split]}; use {use}"
        )

    # The cameras: a chosen one, the first, or all.
    cameras = list(dict.fromkeys(name for name, _ in items))
    if camera not in (None, *cameras):
        names = ", ".join(cameras)
        raise ConfigError(
            f"camera {camera} is not in split {split}, which has {names}"
        )
    if one_camera:
        camera = camera or cameras[0]

    # The cameras of each frame.
    seen_by: dict[int, list[Item]] = {}
    for item in items:
        if camera in (None, item[0]):
            seen_by.setdefault(item[1], []).append(item)
    shared = sorted(seen_by)

    # The frames: chosen ones that all exist, or some that are spread evenly.
    if frames is None:
        frames = [shared[i] for i in evenly_spaced(len(shared), count)]
    if lacking := [frame for frame in frames if frame not in shared]:
        of = (
            f"split {split}"
            if camera is None
            else f"camera {camera} in split {split}"
        )
        raise ConfigError(
            f"frames: {of} lacks {spans(lacking)}; it has {spans(shared)}"
        )

    # The i-th of n frames is shown by the camera at (i + 1/2) / n of its cameras.
    chosen = []
    for place, frame in enumerate(frames):
        views = seen_by[frame]
        chosen.append(views[(2 * place + 1) * len(views) // (2 * len(frames))])
    return chosen


def make_shots(
    data: GsganData, split: str, items: Sequence[Item], margin: float
) -> list[Shot]:
    """Images of a split in windows that reach ``margin`` metres beyond the joints, all of one size
    if the images are."""
    dataset = data.dataset(split)
    frames = [dataset[dataset.items.index(item)] for item in items]

    # Images of one size are one batch, whose windows have one size.
    one_size = len({frame.camera.size for frame in frames}) == 1
    batch_size = len(frames) if one_size else 1
    shots: list[Shot] = []
    for first in range(0, len(frames), batch_size):
        batch = frames[first : first + batch_size]

        # One window size for all frames of a batch.
        boxes = body_window(
            torch.cat([frame.skeleton for frame in batch]),
            cat([frame.camera for frame in batch]),
            margin=margin,
            multiple=1,
            minimum=MIN_WINDOW,
        )
        for corner, frame in zip(boxes.corners, batch, strict=True):
            window = Window((corner,), boxes.size, boxes.whole)
            shots.append(Shot(items[len(shots)], frame, window))
    return shots


@dataclass
class Subject:
    """A trained avatar and its data."""

    name: str  # in print
    run: ScoredRun  # with the fingerprint of ``data``
    data: GsganData
    avatar: Avatar  # in eval mode, on the device that renders
    marks: list[str]  # carried by every figure
    # Whole images that were rendered, on the CPU.
    _images: dict[Item, Tensor] = field(default_factory=dict, repr=False)

    def image(self, shot: Shot) -> Tensor:
        """``[1, 3, h, w]`` I_pred in [0, 1], as shown; rendered once and kept on the CPU.

        Raises:
            DataError: when the image is not finite.
        """
        # Several figures may show parts of one image.
        if shot.item not in self._images:
            device = next(self.avatar.parameters()).device
            with torch.no_grad():
                image = self.avatar(
                    *shot.frame.to(device).inputs, maps=False
                ).image
            assert image is not None
            if not image.isfinite().all():
                where = f"{self.run.folder}: its image of {shot.name}"
                raise DataError(f"{where} is not finite; train it again")
            self._images[shot.item] = image.cpu()
        return shot.window.cut(self._images[shot.item]).clamp(0, 1)


def open_subjects(
    folders: Sequence[Path], moved: DataPaths, device: torch.device | str
) -> list[Subject]:
    """The avatars of run folders, named as their models, with a number if models are equal.

    Raises:
        ConfigError: on a folder given twice, or runs of different data.
        DataError: when a run cannot be read.
    """
    # A link and its target are the same run.
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise ConfigError(
            "a run is given twice; every run in run and compare must differ"
        )
    subjects = [_open(folder, moved, device) for folder in folders]
    runs = [subject.run for subject in subjects]
    check_same(
        "figures", runs, [{DATA: run.data["fingerprint"]} for run in runs]
    )

    # Equal names get the place of the run.
    models = [subject.name for subject in subjects]
    for i, subject in enumerate(subjects, 1):
        if models.count(subject.name) > 1:
            subject.name += f" ({i})"
    return subjects


def _open(
    folder: Path, moved: DataPaths, device: torch.device | str
) -> Subject:
    # The run's seed and data are those of the config that is opened.
    settings = RunSettings.from_config(load_config(folder, moved))
    data = settings.data.read()
    avatar, marks = load_avatar(folder, settings.avatar, data)
    run = read_run(folder, scored=False)
    facts = run.data | {"fingerprint": fingerprint(data)}

    # The figures' data may differ from those of the scores.
    run = replace(run, seed=settings.avatar.seed, data=facts)
    name = TITLES.get(run.name, run.name)
    if run.name == "full" and run.departures == []:
        name = NAME

    # A figure of an unfinished run says so.
    step = int(read_checkpoint(folder / CHECKPOINT)["gsgan"]["step"])
    total = run.plan_length(segmentation=avatar.segmentation is not None)
    if step < total:
        marks = [
            *marks,
            f"{folder} is unfinished: {step} of {total} iterations",
        ]
    return Subject(name, run, data, avatar.to(device), marks)


def measure(image: Tensor, truth: Tensor) -> Numbers:
    """PSNR in dB and edge F1 of one image ``[1, 3, h, w]`` as it is shown; None if not defined:
    equal images, or a ground truth without edges."""
    return {
        "psnr": finite(psnr(image, truth)),
        "edge_f1": finite(edge_f1(image, truth)),
    }


def finite(score: Tensor) -> float | None:
    """The number in a tensor of one; None if it is not finite."""
    value = float(score)
    return value if math.isfinite(value) else None
