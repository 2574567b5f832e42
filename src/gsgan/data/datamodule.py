"""The LightningDataModule: one capture, its splits, its loaders, and facts about the scene."""

import inspect
import logging
import math
import os
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import gsgan.utils.compat  # noqa: F401  (must come before lightning)

# isort: split
import cv2
import torch
from lightning import LightningDataModule
from torch.utils.data import DataLoader, Subset

from gsgan.data.crop import PersonCrop
from gsgan.data.dataset import (
    CaptureDataset,
    ImageCache,
    Lens,
    StepSampler,
    pass_order,
)
from gsgan.data.formats.capture import FACE_FILE, HANDS_FILE, CaptureReader
from gsgan.data.layout import Layout
from gsgan.data.protocol import Protocol
from gsgan.data.scene_info import SceneInfo, count_labels, scene_info
from gsgan.data.skeletons import complete_skeletons, face_at_rest
from gsgan.data.splits import (
    SPLITS,
    VALIDATION,
    Splits,
    make_splits,
    protocol_splits,
)
from gsgan.data.validation import Thresholds
from gsgan.scene import Frame, cat
from gsgan.skeleton import TEMPLATES, template_of
from gsgan.skeleton.template import Vector
from gsgan.utils.arrays import evenly_spaced
from gsgan.utils.checks import at_least, integer, one_of
from gsgan.utils.errors import ConfigError

__all__ = [
    "GsganData",
    "SceneInfo",
    "StepSampler",
    "count_labels",
    "pass_order",
    "scene_info",
]

log = logging.getLogger(__name__)

# The maximum number of loading processes of each training process.
MAX_WORKERS = 8
# Choices of data.body.
BODY_SOURCES = ("auto", "file", "fit", "none")
# choices of effects.distortion, as the dataset calls them
LENSES: dict[str, Lens] = {
    "auto": "undistort",
    "on": "undistort",
    "undistort": "undistort",
    "off": "ignore",
    "project": "raw",
}

Reader = Callable[[str | Path, Thresholds, str | None], Layout]
"""The layout of a dataset's folder, by thresholds and the user's body model file."""


def _quiet_worker(_: int) -> None:
    # One thread per worker process: OpenCV's pool does not survive a fork.
    cv2.setNumThreads(0)


class GsganData(LightningDataModule):
    """A dataset in any format that has a reader, from a folder or made by ``source``.

    conf/data/*.yaml explain the settings.

    Args:
        root: the folder; None if ``source`` makes it.
        source: called without arguments, makes the dataset if needed and returns its folder.
        reader: of the dataset's format (`gsgan.data.formats`); None is the bring-your-own layout.
        body: ``file``, the poses that the dataset has, if any; ``fit``, those of `gsgan.fit`, which
            training runs if they are missing; ``auto``, the dataset's, else `gsgan.fit`'s;
            ``none``, no poses.
        skeleton: ``mediapipe33``; ``mediapipe33_hands``, with the hands of hands3d.npz: 75 joints;
            or ``holistic``, also with the face of face3d.npz: 105 joints.
        protocol: the splits of a publication; None takes those of the dataset or the keys below.
        workers: loading processes; 0 loads in this one; None is 0 without a GPU, else up to
            `MAX_WORKERS`, one per processor that each GPU has.
        cache_mb: bound on decoded images kept in memory, over all loading processes.
        distortion: ``auto`` and ``undistort`` undistort images on reading; ``off`` treats them as
            a pinhole's; ``project`` keeps the distortion, with the lens in ``camera.dist``.
        wanted: description of the root, for the message when it is not set.
        split_keys: train_cameras, test_cameras, train_frames, test_frames, test_share, train_poses
            and validation_frames, see `make_splits`.

    Raises:
        ConfigError: when neither root nor source is given, or a number is out of range.
    """

    def __init__(
        self,
        root: str | None = None,
        source: Callable[[], Path] | None = None,
        reader: Reader | None = None,
        smpl: str | None = None,
        body: str = "auto",
        skeleton: str = "mediapipe33",
        protocol: Protocol | None = None,
        size: int | None = None,
        crop: PersonCrop | str | None = None,
        batch_size: int = 1,
        val_images: int = 24,
        steps_per_epoch: int | None = None,
        workers: int | None = None,
        seed: int = 0,
        cache_mb: float = 1024,
        info_samples: int = 8,
        min_joints: int = Thresholds.min_joints,
        distortion: str = "auto",
        wanted: str = "a capture in the bring-your-own layout",
        **split_keys: Any,
    ) -> None:
        super().__init__()
        # An unknown key is an error.
        inspect.signature(make_splits).bind_partial(**split_keys)

        # Options that contradict each other.
        if root is None and source is None:
            raise ConfigError(
                f"data.root is not set: give the folder of {wanted}, e.g. "
                "data.root=/path/to/capture"
            )
        if not (crop in (None, "person") or isinstance(crop, PersonCrop)):
            raise ConfigError(f"data.crop must be null or person, got {crop!r}")

        # What is read: the folder, its format, the person and the splits.
        self.root = root
        self.source = source
        self.smpl = smpl
        self.reader = CaptureReader() if reader is None else reader
        self.body = one_of("data.body", body, BODY_SOURCES)
        self.skeleton = one_of("data.skeleton", skeleton, TEMPLATES)
        self.protocol = protocol
        self.split_keys = split_keys
        integer("data.min_joints", min_joints, 1)
        self.limits = replace(Thresholds(), min_joints=min_joints)

        # The form of images.
        self.size = size
        self.crop = PersonCrop() if isinstance(crop, str) else crop
        self.lens = LENSES[one_of("effects.distortion", distortion, LENSES)]

        # Batches, and the processes that load them.
        self.batch_size = integer("data.batch_size", batch_size, 1)
        if steps_per_epoch is not None:
            integer("data.steps_per_epoch", steps_per_epoch, 1)
        self.steps_per_epoch = steps_per_epoch
        self.val_images = integer("data.val_images", val_images, 1)
        if workers is None:
            workers = default_workers()
        self.workers = integer("data.workers", workers, 0)
        self.seed = integer("data.seed", seed, 0)
        self.cache_mb = at_least("data.cache_mb", cache_mb, 0)
        self.info_samples = integer("data.info_samples", info_samples, 1)

    def read(self) -> Self:
        """Makes the dataset if need be, reads and checks it."""
        self.prepare_data()
        self.setup()
        return self

    def prepare_data(self) -> None:
        """Makes the dataset if it has a ``source``; one process per machine."""
        self._folder()

    def setup(self, stage: str | None = None) -> None:
        """Reads and checks the layout, once; logs conversions and omissions.

        Raises:
            DataError: see the reader and `make_splits`.
        """
        # Lightning calls this before every stage.
        if "_datasets" not in self.__dict__:
            for note in (*self.layout.notes, *self.splits.notes):
                log.warning("%s: %s", self.layout.root, note)
            assert self._datasets

    @cached_property
    def layout(self) -> Layout:
        """The capture, read on first use."""
        # The reader checks files, frames and cameras.
        layout = self.reader(self._folder(), self.limits, self.smpl)
        skeleton = TEMPLATES[self.skeleton]

        # The capture must have the landmarks that the skeleton asks for.
        if skeleton.palms and layout.hands is None:
            raise self._lacks(HANDS_FILE, layout, "mediapipe33")
        if skeleton.expression and layout.face is None:
            raise self._lacks(FACE_FILE, layout, "mediapipe33_hands")
        if skeleton.palms:
            layout = replace(
                layout, meta=replace(layout.meta, skeleton=self.skeleton)
            )

        # Body poses, as `body` chooses them.
        poses = layout.poses
        if self.body == "none":
            return replace(
                layout, poses=None, meta=replace(layout.meta, body=None)
            )
        if poses is None:
            return layout
        if self.body == "fit" and not poses.fitted:
            raise ConfigError(
                f"data.body=fit, but {layout.root} has body poses of its own; choose data.body=file"
            )

        # Fitted poses come in two versions; the one with hands follows hand landmarks.
        if poses.fitted and skeleton.palms:
            if poses.with_hands is None:
                raise ConfigError(
                    f"{layout.root}: gsgan.fit made body_pose.npz without hands; run it again with "
                    "overwrite=true data.body=none, or choose data.skeleton=mediapipe33"
                )
            layout = replace(layout, poses=poses.with_hands)
        return layout

    def _lacks(self, file: str, layout: Layout, other: str) -> ConfigError:
        """The error of a capture without the landmarks of the skeleton; ``other`` needs fewer."""
        return ConfigError(
            f"data.skeleton={self.skeleton} needs a capture's {file}, which {layout.root} "
            f"lacks; choose data.skeleton={other}"
        )

    @property
    def lacks_body(self) -> bool:
        """Whether `gsgan.fit` is still to make the body poses."""
        # gsgan.fit works on captures, not on published datasets.
        fits = self.body in ("auto", "fit") and isinstance(
            self.reader, CaptureReader
        )
        return fits and self.layout.poses is None

    @cached_property
    def splits(self) -> Splits:
        """The training and held-out items."""
        # A protocol leaves nothing to choose.
        if self.protocol is None:
            splits = make_splits(self.layout, **self.split_keys)
        else:
            for key, value in self.split_keys.items():
                if key != "test_share" and value is not None:
                    raise ConfigError(
                        f"data.{key} is set, but protocol {self.protocol.name} sets the splits; "
                        "leave one of them out"
                    )
            splits = protocol_splits(self.layout, self.protocol)

        # Poses fitted to the masks of a held-out camera would leak the test images.
        held_out = set(splits.test_cameras) - set(splits.train_cameras)
        poses = self.layout.poses
        for camera in () if poses is None else poses.fitted_to:
            if camera in held_out:
                raise ConfigError(
                    f"{self.layout.root}: body poses were fitted to the masks of {camera}, which "
                    "is held out here; run gsgan.fit with the same data.train_cameras, "
                    "data.test_cameras or protocol, and overwrite=true"
                )
        return splits

    @property
    def trained(self) -> list[int]:
        """Frames of the training split, rising."""
        return self.splits.items["train"].frames

    @cached_property
    def face(self) -> tuple[Vector, ...] | None:
        """The person's face at rest, see `face_at_rest`; None for skeletons without a face."""
        if not TEMPLATES[self.skeleton].expression:
            return None

        # `layout` refuses a capture without a face.
        assert self.layout.face is not None
        return face_at_rest(
            self.layout.landmarks, self.layout.face, self.trained
        )

    @property
    def registered_held_out(self) -> tuple[int, ...]:
        """Frames of held-out poses whose body `gsgan.fit` registered to their own masks."""
        poses = self.layout.poses
        if poses is None:
            return ()

        # A frame that some camera trains on is not held out.
        held_out = set(self.splits.items["novel_pose"].frames) - set(
            self.trained
        )
        return tuple(sorted(held_out & poses.registered))

    @property
    def loading_processes(self) -> int:
        """Processes that decode images; each has its own share of the cache.

        Training and validation start their own workers, and the main process decodes too.
        """
        return 2 * self.workers + 1

    @cached_property
    def _datasets(self) -> dict[str, CaptureDataset]:
        layout = self.layout

        # A batch needs images of one size.
        sizes = {camera.size for camera in layout.cameras.values()}
        if (
            self.size is None
            and self.batch_size > 1
            and (self.crop or len(sizes) > 1)
        ):
            raise ConfigError(
                "data.size is not set and images differ in size, so batches of "
                f"{self.batch_size} cannot be made; set data.size (e.g. 512) or data.batch_size=1"
            )

        # All splits share one cache and one set of completed skeletons.
        cache = ImageCache(int(self.cache_mb * 2**20) // self.loading_processes)
        skeletons = complete_skeletons(
            layout.landmarks,
            layout.frames,
            self.trained,
            template=template_of(self.skeleton, self.face),
            hands=layout.hands,
            face=layout.face,
        )

        # Only training leaves out labels near outlines.
        datasets = {}
        for name, items in self.splits.items.items():
            datasets[name] = CaptureDataset(
                layout,
                items,
                size=self.size,
                crop=self.crop,
                cache=cache,
                lens=self.lens,
                skeletons=skeletons,
                ignore_band=name == "train",
            )
        return datasets

    def _folder(self) -> str | Path:
        # A folder that the user gives comes first.
        if self.root is not None:
            return self.root
        assert self.source is not None  # checked in __init__
        return self.source()

    def protocol_record(
        self, lpips_nets: Sequence[str]
    ) -> dict[str, Any] | None:
        """The record next to every score: the protocol and this run's departures from it.

        Args:
            lpips_nets: the networks that LPIPS is computed with.
        """
        if self.protocol is None:
            return None

        # Images that are not square may be padded to squares.
        sizes = [camera.size for camera in self.layout.cameras.values()]
        oblong = any(height != width for height, width in sizes)

        # Cameras of unlike sizes are scored at unlike scales; cropped images have none.
        scales = None
        if self.crop is None:
            scales = [
                self.size / max(size) if self.size else 1.0 for size in sizes
            ]

        # The departures of images and backbone are found by the protocol itself.
        departures = self.protocol.departures(
            lpips_nets=lpips_nets,
            scales=scales,
            padded=self.crop is None and self.size is not None and oblong,
        )
        return self.protocol.record() | {"departures": list(departures)}

    @property
    def reasons(self) -> dict[str, str]:
        """The reasons why splits are empty, by the empty split."""
        return self.splits.reasons

    @cached_property
    def info(self) -> SceneInfo:
        """Facts about the scene from the training split, computed on first use."""
        # The lenses of held-out cameras count as well.
        tested: list[str] = []
        for split in SPLITS[1:]:
            tested += self.splits.items[split].cameras
        train = self.dataset("train")
        scene = scene_info(
            self.layout, self.splits, train, self.info_samples, tested
        )
        return replace(scene, face=self.face)

    @property
    def eval_names(self) -> tuple[str, ...]:
        """The splits beside the training split that are not empty."""
        items = self.splits.items
        return tuple(name for name in items if name != "train" and items[name])

    def dataset(self, split: str) -> CaptureDataset:
        """The dataset of a split: "train", "novel_view", "novel_pose" or, where there is one,
        "validation".

        Raises:
            ValueError: for another name.
        """
        if split not in self.splits.items:
            raise ValueError(
                f"dataset: split must be one of {', '.join(self.splits.items)}, got {split!r}"
            )
        self.setup()
        return self._datasets[split]

    def select_labelled(self, split: str) -> Subset[Frame]:
        """The items of a split whose images have part labels; may be empty."""
        dataset = self.dataset(split)

        # The places of the items that have a label file.
        chosen = []
        if self.layout.labels:
            for place, (camera, frame) in enumerate(dataset.items):
                if self.layout.label_path(camera, frame):
                    chosen.append(place)
        return Subset(dataset, chosen)

    def train_dataloader(self) -> DataLoader[Frame]:
        """Batches of `Frame` in `StepSampler` order."""
        # Without a trainer, the loader of a single process.
        dataset = self.dataset("train")
        replicas = 1
        rank = 0
        epoch = 0
        if self.trainer is not None:
            replicas = self.trainer.world_size
            rank = self.trainer.global_rank
            epoch = self.trainer.current_epoch

        # By default an epoch is one pass over all items.
        per_pass = math.ceil(len(dataset) / (self.batch_size * replicas))
        sampler = StepSampler(
            len(dataset),
            self.batch_size,
            steps=self.steps_per_epoch or per_pass,
            seed=self.seed,
            replicas=replicas,
            rank=rank,
        )
        sampler.set_epoch(epoch)
        return self._loader(dataset, sampler=sampler)

    @property
    def watched(self) -> tuple[str, list[int]]:
        """The split and indices of the images rendered while training, evenly spaced.

        The split is the first of validation, novel_pose, novel_view and train that is not empty.
        """
        # Poses are harder than views, so they are watched first.
        name = "train"
        for split in ("novel_view", "novel_pose", VALIDATION):
            if self.splits.items.get(split):
                name = split
        return name, evenly_spaced(len(self.dataset(name)), self.val_images)

    def val_dataloader(self) -> DataLoader[Frame]:
        """The images of `watched`."""
        name, places = self.watched
        return self._loader(self.dataset(name), places)

    def transfer_batch_to_device(
        self, batch: Frame, device: torch.device, dataloader_idx: int
    ) -> Frame:
        """The batch on the device; Lightning's own walk cannot rebuild frozen records."""
        return batch.to(device, non_blocking=True).unpack()

    def _loader(
        self,
        dataset: CaptureDataset,
        places: Sequence[int] | None = None,
        sampler: StepSampler | None = None,
    ) -> DataLoader[Frame]:
        """Batches of `Frame` whose pixels are bytes, as `transfer_batch_to_device` takes them."""
        # A copy: the dataset itself gives floats.
        packed = copy(dataset)
        packed.packed = True

        # Pinned memory is for copies to a GPU.
        on_gpu = False
        if self.trainer is not None:
            on_gpu = self.trainer.strategy.root_device.type == "cuda"

        return DataLoader(
            packed if places is None else Subset(packed, places),
            batch_size=self.batch_size,
            sampler=sampler,
            collate_fn=cat,
            num_workers=self.workers,
            worker_init_fn=_quiet_worker,
            persistent_workers=self.workers > 0 and sampler is not None,
            pin_memory=on_gpu,
        )


def default_workers() -> int:
    """Loading processes per training process, which keeps one processor for itself."""
    if not torch.cuda.is_available():
        return 0

    # The processors that this process may use, which a container may restrict.
    if hasattr(os, "sched_getaffinity"):
        processors = len(os.sched_getaffinity(0))
    else:
        processors = os.cpu_count() or 1
    per_gpu = processors // torch.cuda.device_count()
    return max(0, min(MAX_WORKERS, per_gpu - 1))
