"""Properties of the scene, computed from the training split."""

from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from torch.utils.data import Subset

from gsgan.body import open_body
from gsgan.data.dataset import CaptureDataset
from gsgan.data.layout import Layout
from gsgan.data.pixels import IGNORE_LABEL, read_labels
from gsgan.data.skeletons import median_limb_length_sum
from gsgan.data.splits import Item, Splits
from gsgan.data.surface_colours import (
    SurfaceColours,
    body_inside,
    surface_colours,
)
from gsgan.data.texture import SIDE, grey, texture
from gsgan.scene import NEAR
from gsgan.skeleton.joints import BODY
from gsgan.skeleton.proportions import (
    Proportions,
    degrees_seen,
    measure_proportions,
)
from gsgan.skeleton.sides import refuse_swapped
from gsgan.skeleton.template import Vector
from gsgan.skeleton.training_poses import TrainingPoses, training_poses
from gsgan.utils.arrays import evenly_spaced
from gsgan.utils.errors import DataError

# mask value of solid pixels: those at the outline are darkened by the black behind them
SOLID = 0.9
# Images per requested sample on which the posed body is compared with masks.
MAX_BODY_IMAGES = 2


@dataclass(frozen=True)
class SceneInfo:
    """Properties of the scene, computed from the training split; plain values, for checkpoints.

    Args:
        camera_names: all cameras; `Frame.camera_index` counts in this order.
        n_train_cameras: cameras of the training split.
        has_distortion: a lens coefficient of a training camera is not zero.
        has_labels: training images have part labels.
        has_body_pose: every frame has a body pose.
        body: kind of the skinned body ("free", "smpl", "smplx"), or None.
        skeleton: name of the landmark set.
        n_labels: part labels, background included; 0 without labels.
        label_names: their names, empty if unknown.
        limb_length_sum: metres, median over frames of the summed limb lengths.
        centre: metres, median position of the person: the middle of the capture volume.
        frames: number of training frames.
        body_file: the user's model file of the body, None for the free body.
        betas: shape of that body.
        train_cameras: names, in the order of ``camera_names``.
        held_out_distortion: a lens coefficient of a held-out camera is not zero.
        has_rational_lens: a lens has coefficients beyond the fifth (k4, k5, k6).
        scale_train: pixels per metre at the person, smallest and largest of the training
            cameras' medians.
        surface: colour differences between training cameras on the same surface, or None if
            they share too little.
        darkest: brightness in [0, 1] of the person's darkest percent.
        texture: mean over the person's pixels, without a margin, of `gsgan.data.texture.texture`.
        degrees_seen: of 360 around the person, from which training cameras see the training frames.
        body_inside: share of the posed body that lies inside the masks of training images; None
            without a body pose or mesh.
        proportions: the subject's proportions.
        face: metres, the subject's face at rest in the head's frame, see `face_at_rest`; None for
            skeletons without a face.
        poses: the spread of the training poses; None in checkpoints from before it was stored.
    """

    # Without a default: every checkpoint has them.
    camera_names: tuple[str, ...]
    n_train_cameras: int
    has_distortion: bool
    has_labels: bool
    has_body_pose: bool
    body: str | None
    skeleton: str
    n_labels: int
    label_names: tuple[str, ...]
    limb_length_sum: float
    centre: tuple[float, float, float]
    frames: int

    # With the values for checkpoints from before they were stored.
    body_file: str | None = None
    betas: tuple[float, ...] = ()
    train_cameras: tuple[str, ...] = ()
    held_out_distortion: bool = False
    has_rational_lens: bool = False
    scale_train: tuple[float, float] = (1.0, 1.0)
    surface: SurfaceColours | None = None
    darkest: float = 0.0
    texture: float = 0.0
    degrees_seen: int = 0
    body_inside: float | None = None
    proportions: Proportions | None = None
    face: tuple[Vector, ...] | None = None
    poses: TrainingPoses | None = None


def refuse_swapped_sides(layout: Layout, frames: Sequence[int]) -> None:
    """Refuses a capture whose left and right are swapped in most frames, with a DataError."""
    # The check knows joints, but not the dataset that they come from.
    try:
        p, valid = layout.landmarks.joints(frames)
        refuse_swapped(p[:, :BODY], valid[:, :BODY])
    except ValueError as error:
        raise DataError(f"{layout.root}: {error}") from None


def scene_info(
    layout: Layout,
    splits: Splits,
    dataset: CaptureDataset,
    samples: int,
    tested: Collection[str] = (),
) -> SceneInfo:
    """Computes the properties of the scene from the training split.

    Args:
        layout: the capture.
        splits: of the capture.
        dataset: of the training items; its cache keeps the decoded images.
        samples: images per camera to take colours from, evenly spaced.
        tested: names of the held-out cameras. Only their lenses are looked at, since a lens
            decides what can be rendered.
    """
    # Only training items are looked at.
    items = splits.items["train"]
    frames = items.frames
    cameras = set(items.cameras)
    names = tuple(name for name in layout.cameras if name in cameras)
    refuse_swapped_sides(layout, frames)

    # The centre of the volume: the median over frames of the middle of the visible joints.
    p, valid = layout.landmarks.joints(frames)
    middles = []
    for joints, seen in zip(p, valid, strict=True):
        middles.append(joints[seen].mean(0))
    x, y, z = torch.stack(middles).median(0).values.tolist()

    # Proportions of the body with hands; poses of the completed skeletons.
    whole = layout.landmarks
    if layout.hands is not None:
        whole = whole.with_hands(layout.hands)
    whole_p, whole_valid = whole.joints(frames)
    # [F, J, 3]
    completed = np.stack([dataset.skeletons.p[frame] for frame in frames])

    centres = np.stack([layout.cameras[name].centre for name in names])

    # The skinned body, whose file is the user's.
    body = layout.meta.body
    labelled = bool(layout.labels)
    return SceneInfo(
        camera_names=layout.camera_names,
        n_train_cameras=len(cameras),
        has_labels=labelled and any(layout.label_path(*item) for item in items),
        has_body_pose=layout.poses is not None,
        body=None if body is None else body.kind,
        skeleton=layout.meta.skeleton,
        n_labels=count_labels(layout, items),
        label_names=layout.meta.label_names or (),
        limb_length_sum=median_limb_length_sum(p, valid),
        centre=(x, y, z),
        frames=len(frames),
        body_file=None if body is None else body.file,
        betas=() if body is None else body.betas,
        train_cameras=names,
        surface=_compare_cameras(dataset, names, samples),
        darkest=_darkest(dataset, samples),
        texture=_texture(dataset, samples),
        degrees_seen=degrees_seen(completed, centres),
        body_inside=_body_inside(layout, dataset, samples),
        scale_train=_scale(dataset, samples),
        poses=training_poses(torch.from_numpy(completed)),
        proportions=measure_proportions(
            whole_p, whole_valid, layout.meta.up_axis
        ),
        **_lenses(layout, cameras, set(tested) - cameras),
    )


def count_labels(layout: Layout, items: Sequence[Item]) -> int:
    """Number of part labels, background included: that of the names, else up to the highest label.

    Without names every label image of the items is read once.
    """
    if not layout.labels:
        return 0

    # Without names, the labels themselves tell.
    if layout.meta.label_names is not None:
        return len(layout.meta.label_names)

    # Pixels to ignore have the highest value, and are no part.
    highest = 0
    for item in items:
        path = layout.label_path(*item)
        if path:
            labels = read_labels(path, layout.pixels, None)
            image_highest = int(
                labels.max(where=labels != IGNORE_LABEL, initial=0)
            )
            highest = max(highest, image_highest)
    return highest + 1


def _lenses(
    layout: Layout,
    cameras: set[str],
    tested: set[str],
) -> dict[str, Any]:
    """The fields of `SceneInfo` about distortion."""
    # Held-out cameras are those that do not train.
    training = [layout.cameras[name] for name in cameras]
    held_out = [layout.cameras[name] for name in tested]
    everyone = training + held_out
    return {
        "has_distortion": any(camera.distorted for camera in training),
        "held_out_distortion": any(camera.distorted for camera in held_out),
        "has_rational_lens": any(
            camera.distorted and not camera.keeps_lens for camera in everyone
        ),
    }


def _scale(dataset: CaptureDataset, samples: int) -> tuple[float, float]:
    """Pixels per metre at the person: minimum and maximum of the cameras' medians."""
    # A camera may see the person at many distances, so its median counts.
    medians = []
    for indices in _sample(dataset, samples):
        scales = []
        for index in indices:
            item = dataset.items[index]
            camera = dataset.camera(item)

            # Focal length over the median depth of the joints.
            joints = torch.from_numpy(dataset.layout.landmarks.p[item[1]])[None]
            x_cam = camera.to_camera(joints.to(camera.K))
            depth = float(x_cam[..., 2].median())
            focal = float(camera.K[0, 0, 0])
            scales.append(focal / max(depth, NEAR))
        medians.append(float(np.median(scales)))
    return min(medians), max(medians)


def _sample(dataset: CaptureDataset, samples: int) -> list[list[int]]:
    """Indices of at most ``samples`` evenly spaced items of each camera."""
    # The indices of each camera's items.
    by_camera: dict[str, list[int]] = {}
    for index, (camera, _) in enumerate(dataset.items):
        by_camera.setdefault(camera, []).append(index)

    # From the first to the last, in even steps.
    sampled = []
    for items in by_camera.values():
        places = evenly_spaced(len(items), samples, ends=True)
        sampled.append([items[place] for place in places])
    return sampled


def _darkest(dataset: CaptureDataset, samples: int) -> float:
    """The brightness in [0, 1] below which the darkest percent of the person's pixels lies."""
    # Brightness is that of the brightest channel: a saturated colour is not dark.
    brightness = []
    for indices in _sample(dataset, samples):
        for index in indices:
            frame = dataset[index]
            brightest_channel = frame.image.amax(1, keepdim=True)
            brightness.append(brightest_channel[frame.mask > SOLID])
    solid = torch.cat(brightness).numpy()
    return float(np.percentile(solid, 1)) if solid.size else 0.0


def _texture(dataset: CaptureDataset, samples: int) -> float:
    """The mean texture of the person's pixels."""
    # Pixels nearer to the outline than this see it in their windows.
    kernel = np.ones((SIDE + 2, SIDE + 2), np.uint8)
    textures = [np.zeros(0)]
    for indices in _sample(dataset, samples):
        for index in indices:
            frame = dataset[index]
            solid = (frame.mask[0, 0] > SOLID).numpy().astype(np.uint8)
            inside = cv2.erode(solid, kernel, borderValue=0) > 0
            levels = grey(frame.image[0].permute(1, 2, 0).numpy())
            textures.append(texture(levels)[inside])
    pixels = np.concatenate(textures)
    return float(pixels.mean()) if pixels.size else 0.0


def _body_inside(
    layout: Layout,
    dataset: CaptureDataset,
    samples: int,
) -> float | None:
    """Mean share of the posed body inside the masks of some training images."""
    # The user's mesh, if the capture has poses and the model file is there.
    body = layout.meta.body
    mesh = None
    if body is not None and layout.poses is not None:
        with suppress(DataError):
            mesh = open_body(body.kind, body.file, body.betas)
    if mesh is None:
        return None

    # Images that show nothing of the body, or whose mask is empty, do not count.
    shares = []
    for index in evenly_spaced(
        len(dataset.items), MAX_BODY_IMAGES * samples, ends=True
    ):
        share = body_inside(dataset[index], mesh)
        if share is not None:
            shares.append(share)
    return float(np.mean(shares or [0.0]))


def _compare_cameras(
    dataset: CaptureDataset,
    cameras: tuple[str, ...],
    samples: int,
) -> SurfaceColours | None:
    """Differences of colour in frames that all training cameras have; None for a single camera."""
    if len(cameras) < 2:
        return None

    # Frames that every camera has, evenly spaced.
    frames: dict[str, set[int]] = {}
    for camera, frame in dataset.items:
        frames.setdefault(camera, set()).add(frame)
    shared = sorted(set.intersection(*frames.values()))

    # Subsets read a frame when it is needed: all of them at full size take gigabytes.
    moments = []
    for place in evenly_spaced(len(shared), samples, ends=True):
        items = [(camera, shared[place]) for camera in cameras]
        moments.append(Subset(dataset, list(map(dataset.items.index, items))))
    return surface_colours(moments)  # type: ignore[arg-type]
