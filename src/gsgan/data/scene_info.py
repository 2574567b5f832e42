"""What the training split tells about the scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from gsgan.data.capture import CaptureDataset
from gsgan.data.layout import Layout
from gsgan.data.pixels import IGNORE_LABEL, read_labels
from gsgan.data.splits import Item, Splits


@dataclass(frozen=True)
class SceneInfo:
    """What the training split tells about the scene; plain values, so a checkpoint can hold it.

    Args:
        camera_names: all cameras; `Frame.camera_index` counts in this order.
        n_train_cameras: cameras that train.
        has_distortion: a lens coefficient is not zero (pictures are undistorted on reading).
        has_labels: there are part labels.
        has_body_pose: there is a body pose for every frame.
        body: kind of the skinned body ("free", "smpl", "smplx"), or None.
        skeleton: name of the landmark set.
        n_labels: part labels, background included; 0 without labels.
        label_names: their names where the capture gives them.
        foreground: mean RGB in [0, 1] of the person, by train camera name.
        body_height: metres, median over frames of the summed limb lengths.
        centre: metres, median position of the person: the middle of the capture volume.
        up_axis: of the world, e.g. "z" or "-y".
        fps: frames a second, or None.
        frames: how many frames train.
        skeleton_source: where the landmarks come from, e.g. "smpl24 -> mediapipe33".
        body_file: the user's model file of the body, None for the free body.
        betas: shape of that body.
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


def scene_info(layout: Layout, splits: Splits, dataset: CaptureDataset, samples: int) -> SceneInfo:
    """What the training split tells about the scene.

    Args:
        layout: the capture.
        splits: of the capture.
        dataset: of the training items; its cache keeps what is decoded here.
        samples: pictures a camera from which the foreground colour is taken, evenly spaced.
    """
    frames = sorted({frame for _, frame in splits.items["train"]})
    p = torch.from_numpy(np.stack([layout.landmarks.p[f] for f in frames]))
    valid = torch.from_numpy(np.stack([layout.landmarks.visibility[f] for f in frames])) > 0
    middles = torch.stack([q[v].mean(0) for q, v in zip(p, valid, strict=True)])
    cameras = {camera for camera, _ in splits.items["train"]}
    body = layout.meta.body
    return SceneInfo(
        camera_names=layout.camera_names,
        n_train_cameras=len(cameras),
        has_distortion=any(layout.cameras[name].distorted for name in cameras),
        has_labels=bool(layout.labels),
        has_body_pose=layout.poses is not None,
        body=None if body is None else body.kind,
        skeleton=layout.meta.skeleton,
        n_labels=count_labels(layout, splits.items["train"]),
        label_names=layout.meta.label_names or (),
        foreground=foreground_colours(dataset, samples),
        body_height=_body_height(p, valid),
        centre=_triple(middles.median(0).values),
        up_axis=layout.meta.up_axis,
        fps=layout.meta.fps,
        frames=len(frames),
        skeleton_source=layout.meta.skeleton_source,
        body_file=None if body is None else body.file,
        betas=() if body is None else body.betas,
    )


def _body_height(p: torch.Tensor, valid: torch.Tensor) -> float:
    from gsgan.skeleton import limb_length_sum

    return float(limb_length_sum(p, valid).nanmedian())


def _triple(values: torch.Tensor) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def count_labels(layout: Layout, items: tuple[Item, ...]) -> int:
    """Part labels, background included: as the data names them, else the highest one found.

    Without names every label picture of the items is read once.
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


def foreground_colours(
    dataset: CaptureDataset, samples: int
) -> dict[str, tuple[float, float, float]]:
    """Mean RGB of the person in [0, 1], mask-weighted, by camera name.

    Args:
        dataset: whose cameras to look at.
        samples: pictures a camera, evenly spaced over its frames.
    """
    by_camera: dict[str, list[int]] = {}
    for index, (camera, _) in enumerate(dataset.items):
        by_camera.setdefault(camera, []).append(index)
    colours = {}
    for camera, indices in by_camera.items():
        chosen = {round(i) for i in np.linspace(0, len(indices) - 1, samples)}
        frames = [dataset[indices[i]] for i in sorted(chosen)]
        total = sum(f.image.double().sum((0, 2, 3)) for f in frames)
        weight = sum(float(f.mask.double().sum()) for f in frames)
        colours[camera] = _triple(torch.as_tensor(total) / max(weight, 1.0))
    return colours
