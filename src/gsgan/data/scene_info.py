"""Facts about the scene, computed from the training split."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsgan.body import SkinnedBody, open_body
from gsgan.data.cameras import CameraEntry
from gsgan.data.dataset import CaptureDataset
from gsgan.data.layout import Layout
from gsgan.data.pixels import IGNORE_LABEL, read_labels
from gsgan.data.proportions import Proportions, measure_proportions
from gsgan.data.skeletons import body_height
from gsgan.data.splits import Item, Splits
from gsgan.data.surface_colours import SurfaceColours, body_inside, surface_colours
from gsgan.scene import Frame
from gsgan.skeleton.template import Vector
from gsgan.utils.errors import DataError

SOLID = 0.9  # of the mask: pixels at the outline are darkened by the black behind them


@dataclass(frozen=True)
class SceneInfo:
    """Facts about the scene, computed from the training split; plain values, for checkpoints.

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
        foreground: mean RGB in [0, 1] of the person, by train camera name.
        body_height: metres, median over frames of the summed limb lengths.
        centre: metres, median position of the person: the middle of the capture volume.
        up_axis: of the world, e.g. "z" or "-y".
        fps: frames a second, or None.
        frames: number of training frames.
        skeleton_source: origin of the landmarks, e.g. "smpl24 -> mediapipe33".
        body_file: the user's model file of the body, None for the free body.
        betas: shape of that body.
        train_cameras: names, in the order of ``camera_names``.
        held_out_distortion: a lens coefficient of a held-out camera is not zero.
        has_rational_lens: a lens has coefficients beyond the fifth (k4, k5, k6).
        spread: degrees, the largest angle between two training cameras seen from ``centre``.
        scale_train: pixels per metre at the person, smallest and largest of the training
            cameras' medians.
        scale_test: the same for held-out images; None without any.
        surface: colour differences between training cameras on the same surface, or None if
            they share too little.
        darkest: brightness in [0, 1] of the person's darkest percent.
        body_inside: share of the posed body that lies inside the masks of training images; None
            without a body pose or mesh.
        proportions: the subject's proportions; None where they were not measured.
        face: metres, the subject's face at rest in the head's frame, see `face_at_rest`; None for
            skeletons without a face.
    """

    camera_names: tuple[str, ...]
    n_train_cameras: int
    has_distortion: bool
    has_labels: bool
    has_body_pose: bool
    body: str | None
    skeleton: str
    n_labels: int
    label_names: tuple[str, ...]
    foreground: dict[str, tuple[float, float, float]]
    body_height: float
    centre: tuple[float, float, float]
    up_axis: str
    fps: float | None
    frames: int
    skeleton_source: str = "mediapipe33"
    body_file: str | None = None
    betas: tuple[float, ...] = ()
    train_cameras: tuple[str, ...] = ()
    held_out_distortion: bool = False
    has_rational_lens: bool = False
    spread: float = 0.0
    scale_train: tuple[float, float] = (1.0, 1.0)
    scale_test: tuple[float, float] | None = None
    surface: SurfaceColours | None = None
    darkest: float = 0.0
    body_inside: float | None = None
    proportions: Proportions | None = None
    face: tuple[Vector, ...] | None = None


def scene_info(
    layout: Layout,
    splits: Splits,
    dataset: CaptureDataset,
    samples: int,
    held_out: Sequence[CaptureDataset] = (),
) -> SceneInfo:
    """Computes the facts about the scene from the training split.

    Args:
        layout: the capture.
        splits: of the capture.
        dataset: of the training items; its cache keeps the decoded images.
        samples: images per camera to take colours from, evenly spaced.
        held_out: datasets of the held-out items; their images are not read.
    """
    frames = sorted({frame for _, frame in splits.items["train"]})
    p, valid = layout.landmarks.joints(frames)
    whole = layout.landmarks
    if layout.hands is not None:
        whole = whole.with_hands(layout.hands)
    middles = torch.stack([q[v].mean(0) for q, v in zip(p, valid, strict=True)])
    cameras = {camera for camera, _ in dataset.items}
    tested = {camera for data in held_out for camera, _ in data.items} - cameras
    body = layout.meta.body
    centre = middles.median(0).values
    foreground, darkest = _foreground(dataset, samples)
    entries = {name: entry for name, entry in layout.cameras.items() if name in cameras}
    scales = [_scales(data, samples) for data in held_out if data.items]
    mesh, inside = _mesh(layout), None
    if mesh is not None:
        chosen = _evenly(range(len(dataset.items)), 2 * samples)
        shares = [body_inside(dataset[i], mesh) for i in chosen]
        inside = float(np.mean([share for share in shares if share is not None] or [0.0]))
    return SceneInfo(
        camera_names=layout.camera_names,
        n_train_cameras=len(cameras),
        has_distortion=any(entry.distorted for entry in entries.values()),
        has_labels=any(layout.label_path(*item) for item in splits.items["train"]),
        has_body_pose=layout.poses is not None,
        body=None if body is None else body.kind,
        skeleton=layout.meta.skeleton,
        n_labels=count_labels(layout, splits.items["train"]),
        label_names=layout.meta.label_names or (),
        foreground=foreground,
        body_height=body_height(p, valid),
        centre=(float(centre[0]), float(centre[1]), float(centre[2])),
        up_axis=layout.meta.up_axis,
        fps=layout.meta.fps,
        frames=len(frames),
        skeleton_source=layout.meta.skeleton_source,
        body_file=None if body is None else body.file,
        betas=() if body is None else body.betas,
        train_cameras=tuple(entries),
        held_out_distortion=any(layout.cameras[name].distorted for name in tested),
        has_rational_lens=any((layout.cameras[n].dist[5:] != 0).any() for n in cameras | tested),
        spread=_spread(list(entries.values()), centre.numpy()),
        scale_train=_scales(dataset, samples),
        scale_test=(min(s[0] for s in scales), max(s[1] for s in scales)) if scales else None,
        surface=_shared_surface(layout, dataset, tuple(entries), samples, mesh),
        darkest=darkest,
        body_inside=inside,
        proportions=measure_proportions(*whole.joints(frames), layout.meta.up_axis),
    )


def count_labels(layout: Layout, items: tuple[Item, ...]) -> int:
    """Part labels, background included: as many as have names, else up to the highest one.

    Without names every label image of the items is read once.
    """
    if not layout.labels:
        return 0
    if layout.meta.label_names is not None:
        return len(layout.meta.label_names)
    highest = 0
    for item in items:
        if path := layout.label_path(*item):
            labels = read_labels(path, layout.pixels, None)
            highest = max(highest, int(labels.max(where=labels != IGNORE_LABEL, initial=0)))
    return highest + 1


def _foreground(
    dataset: CaptureDataset, samples: int
) -> tuple[dict[str, tuple[float, float, float]], float]:
    """Mean RGB in [0, 1] by camera, mask-weighted, and the brightness of the darkest percent."""
    colours, brightness = {}, []
    for camera, indices in _by_camera(dataset).items():
        total, weight = torch.zeros(3, dtype=torch.float64), 0.0
        for index in _evenly(indices, samples):
            frame = dataset[index]
            total += frame.image.double().sum((0, 2, 3))
            weight += float(frame.mask.double().sum())
            brightness.append(frame.image.amax(1, keepdim=True)[frame.mask > SOLID])
        red, green, blue = (total / max(weight, 1.0)).tolist()
        colours[camera] = red, green, blue
    solid = torch.cat(brightness).numpy()
    return colours, float(np.percentile(solid, 1)) if solid.size else 0.0


def _by_camera(dataset: CaptureDataset) -> dict[str, list[int]]:
    """Indices of the items of each camera."""
    found: dict[str, list[int]] = {}
    for index, (camera, _) in enumerate(dataset.items):
        found.setdefault(camera, []).append(index)
    return found


def _evenly(values: Sequence[int], count: int) -> list[int]:
    """At most ``count`` of the values, evenly spaced, first and last included."""
    chosen = {round(i) for i in np.linspace(0, len(values) - 1, count)}
    return [values[i] for i in sorted(chosen)]


def _spread(cameras: Sequence[CameraEntry], centre: NDArray[np.float64]) -> float:
    """Degrees between the two viewing directions that are furthest apart."""
    ways = [camera.centre - centre for camera in cameras]
    ways = [way / max(float(np.linalg.norm(way)), 1e-9) for way in ways]
    cosines = [float(a @ b) for a, b in combinations(ways, 2)]
    return float(np.degrees(np.arccos(np.clip(min(cosines, default=1.0), -1, 1))))


def _scales(dataset: CaptureDataset, samples: int) -> tuple[float, float]:
    """Pixels per metre at the person: the smallest and the largest camera's median."""
    medians = []
    for indices in _by_camera(dataset).values():
        each = []
        for item in (dataset.items[i] for i in _evenly(indices, samples)):
            camera = dataset.camera(item)
            joints = torch.from_numpy(dataset.layout.landmarks.p[item[1]])[None].to(camera.K)
            depth = float(camera.to_camera(joints)[..., 2].median())
            each.append(float(camera.K[0, 0, 0]) / max(depth, 1e-2))
        medians.append(float(np.median(each)))
    return min(medians), max(medians)


def _mesh(layout: Layout) -> SkinnedBody | None:
    """The body that the capture's poses move; None if they or its model file are missing."""
    body = layout.meta.body
    if body is None or layout.poses is None:
        return None
    with suppress(DataError):
        return open_body(body.kind, body.file, body.betas)
    return None


def _shared_surface(
    layout: Layout,
    dataset: CaptureDataset,
    cameras: tuple[str, ...],
    samples: int,
    mesh: SkinnedBody | None,
) -> SurfaceColours | None:
    """Colours compared in frames of all training cameras; None with a single camera."""
    index = {item: i for i, item in enumerate(dataset.items)}
    shared = sorted({f for _, f in dataset.items if all((c, f) in index for c in cameras)})
    if len(cameras) < 2 or not shared:
        return None
    moments = [_Moment(dataset, [index[c, f] for c in cameras]) for f in _evenly(shared, samples)]
    return surface_colours(moments, mesh)


class _Moment(Sequence[Frame]):
    """Frames of one moment, each read on access: all of them at full size take GBs."""

    def __init__(self, dataset: CaptureDataset, indices: Sequence[int]) -> None:
        self.dataset, self.indices = dataset, indices

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, place: Any) -> Any:
        return self.dataset[self.indices[place]]
