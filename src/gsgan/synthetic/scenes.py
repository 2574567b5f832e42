"""Writes the synthetic dataset, once, into a cache folder.

The layout is that of a capture: cameras.json, images/{cam}/%06d.png, masks/, labels/,
landmarks3d.npz, hands3d.npz, face3d.npz, meta.json. Every image is written atomically, and
meta.json last: a dataset that was interrupted is incomplete and is continued. Tints are not
written to any file: a model has to estimate them.

Workers are separate programs rather than children of multiprocessing, which would import the
user's main script again, and fail if it is a notebook or lacks a ``__main__`` guard.
"""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from filelock import FileLock
from numpy.typing import NDArray

import gsgan
from gsgan.body.free import free_body
from gsgan.skeleton.joints import BODY, FACE, HANDS
from gsgan.synthetic.camera import SceneCamera
from gsgan.synthetic.free_subject import free_pose
from gsgan.synthetic.scene_setup import (
    FREE_BODY,
    Scene,
    SceneSettings,
    dataset_key,
)
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.files import cache_root, write_atomically

# Folders of what is traced, in the order of `PosedCharacter.render`.
IMAGE_FOLDERS = ("images", "masks", "labels")
POLL_SECONDS = 0.05  # between looks at the workers
# The program of a worker.
WORKER = "from gsgan.synthetic.scenes import trace_share; trace_share()"


def ensure_scene(
    *,
    cache: Path | None = None,
    workers: int = 2,
    progress: bool = True,
    **parameters: Any,
) -> Path:
    """The synthetic dataset with these parameters: found in the cache, or made there.

    Two processes may request the same dataset at once: the second waits, then finds it.

    Args:
        cache: cache folder, :func:`gsgan.utils.files.cache_root` by default.
        workers: processes that trace; 1 traces in this one. Does not change the result.
        progress: whether to draw a progress bar.
        parameters: of :class:`gsgan.synthetic.scene_setup.SceneSettings`.

    Returns:
        The dataset's folder.

    Raises:
        ConfigError: on an unknown parameter or one out of range.
        DataError: when the folder cannot be written.
    """
    allowed = [field.name for field in fields(SceneSettings)]
    if unknown := sorted(set(parameters) - set(allowed)):
        raise ConfigError(
            f"synthetic data: unknown parameter {unknown[0]!r}; known are {', '.join(allowed)}"
        )

    # The name of the folder identifies the content.
    settings = SceneSettings(**parameters)
    root = (
        (cache or cache_root()) / "data" / "synthetic" / dataset_key(settings)
    )
    if not _is_complete(root):
        try:
            root.mkdir(parents=True, exist_ok=True)
            with FileLock(root.with_name(f".{root.name}.lock")):
                if not _is_complete(
                    root
                ):  # else made while this process waited
                    _write(root, settings, workers, progress)
        except OSError as error:
            raise DataError(
                f"{root} cannot be written ({error}): make room, or set GSGAN_CACHE to a folder "
                f"that you may write to"
            ) from error
    return root


def _is_complete(root: Path) -> bool:
    return (root / "meta.json").is_file()


def _write(
    root: Path, settings: SceneSettings, workers: int, progress: bool
) -> None:
    from rich.console import Console
    from rich.progress import Progress

    # The progress bar counts frames.
    scene = Scene(settings)
    count = f"{settings.frames} frames, {len(scene.views)} cameras"

    # The bar is on stderr, apart from results.
    bar = Progress(
        console=Console(stderr=True), disable=not progress, transient=True
    )
    with bar:
        task = bar.add_task(
            f"tracing the synthetic person ({count})", total=settings.frames
        )
        if workers <= 1 or settings.frames == 1:
            for frame in range(settings.frames):
                trace_frames(root, scene, [frame])
                bar.advance(task)
        else:
            # Progress is the number of images of the camera that is traced last.
            last = root / "labels" / list(scene.views)[-1]
            for _ in _trace_in_processes(
                root, settings, min(workers, settings.frames)
            ):
                bar.update(task, completed=len(list(last.glob("*.png"))))

    # meta.json is written last: it marks the dataset as complete.
    _write_skeletons(root, scene)
    cameras = {name: _calibration(view) for name, view in scene.views.items()}
    write_atomically(
        root / "cameras.json", json.dumps(cameras, indent=1) + "\n"
    )
    write_atomically(
        root / "meta.json", json.dumps(_meta(scene), indent=1) + "\n"
    )


def _trace_in_processes(
    root: Path, settings: SceneSettings, workers: int
) -> Iterator[None]:
    """Divides the frames among processes; yields from time to time until all are done.

    Raises:
        DataError: with a failed worker's last line of output.
    """
    # One thread per worker; the modules come from where this process has them.
    environment = dict(
        os.environ, OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1"
    )
    environment["PYTHONPATH"] = os.pathsep.join(
        p or os.getcwd() for p in sys.path
    )
    command = [
        sys.executable,
        "-c",
        WORKER,
        str(root),
        json.dumps(asdict(settings)),
    ]

    # Workers are killed if this process is interrupted or one of them fails.
    with (
        tempfile.TemporaryFile("w+") as errors,
        contextlib.ExitStack() as stack,
    ):
        running = []
        for first in range(workers):
            process = subprocess.Popen(
                [*command, str(first), str(workers)],
                stderr=errors,
                env=environment,
            )
            stack.callback(process.wait)
            stack.callback(process.kill)
            running.append(process)

        # A code is None while its process runs, and 0 once it has succeeded.
        codes = [process.poll() for process in running]
        while None in codes and not any(codes):
            yield
            time.sleep(POLL_SECONDS)
            codes = [process.poll() for process in running]

        # The last line of the output tells why a worker failed.
        if any(codes):
            errors.seek(0)
            lines = [line.strip() for line in errors if line.strip()]
            raise DataError(
                f"a process tracing the synthetic person failed: "
                f"{lines[-1] if lines else 'it was killed'}; workers=1 traces in this process"
            )


def trace_share() -> None:
    """A worker's program: frames ``first, first + step, …``; argv: root, settings, first, step."""
    import torch

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    root, parameters, first, step = sys.argv[1:]
    settings = SceneSettings(**json.loads(parameters))
    frames = range(int(first), settings.frames, int(step))
    trace_frames(Path(root), Scene(settings), frames)


def trace_frames(root: Path, scene: Scene, frames: Iterable[int]) -> None:
    """Writes images, masks and labels of the frames for all cameras, unless they exist."""
    for frame in frames:
        person = None  # posed for the first image that does not exist
        for name, view in scene.views.items():
            # Only images that do not exist are traced, so that a run that was killed can go on.
            paths = [
                root / kind / name / f"{frame:06d}.png"
                for kind in IMAGE_FOLDERS
            ]
            if all(path.is_file() for path in paths):
                continue

            # The image in the colours of its camera.
            person = person or scene.pose(frame)
            image, alpha, labels = person.render(
                view, scene.settings.rays_per_pixel
            )
            if name in scene.tints:
                image = scene.tints[name](image, alpha)
            # OpenCV writes blue, green, red.
            bgr = np.ascontiguousarray(image[..., ::-1])
            pixels = (_bytes(bgr), _bytes(alpha), labels.astype(np.uint8))
            for path, content in zip(paths, pixels, strict=True):
                _, encoded = cv2.imencode(".png", content)
                write_atomically(path, encoded.tobytes())


def _bytes(x: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.floor(255 * np.clip(x, 0, 1) + 0.5).astype(np.uint8)


def _calibration(view: SceneCamera) -> dict[str, Any]:
    """A camera's entry of cameras.json."""
    H, W = view.size
    return {
        "K": view.K.tolist(),
        "R": view.R.tolist(),
        "t": view.t.tolist(),
        "dist": [0.0] * 5 if view.dist is None else view.dist.tolist(),
        "size": [W, H],
    }


def _write_skeletons(root: Path, scene: Scene) -> None:
    """Writes landmarks of body, hands and face, and the free body's exact pose."""
    # Landmarks of all frames, which are numbered from 0.
    names, points = scene.landmarks()
    p = points.astype(np.float32)
    ids = np.arange(len(p))

    # The body's landmarks, with the fields of triangulated ones.
    shape = (len(p), BODY)
    np.savez(
        root / "landmarks3d.npz",
        p=p[:, :BODY],
        conf=np.ones(shape, dtype=np.float32),
        reproj_px=np.zeros(shape, dtype=np.float32),
        n_views=np.full(shape, len(scene.views)),
        frame_id=ids,
        names=np.array(names[:BODY]),
        passage=np.array(scene.motion.passages),
    )

    # The free body has no landmarks of the face.
    for name, part in (("hands3d", HANDS), ("face3d", FACE)):
        if names[part]:
            np.savez(
                root / f"{name}.npz",
                p=p[:, part],
                frame_id=ids,
                names=np.array(names[part]),
            )

    # The free body's pose is known exactly, in the format of a fitted one.
    if scene.settings.avatar == FREE_BODY:
        pose = free_pose(scene.motion)
        np.savez(
            root / "body_pose.npz",
            theta=pose.theta.numpy(),
            transl=pose.transl.numpy(),
            frame_id=ids,
            joint_names=np.array(free_body().joint_names),
        )


def _meta(scene: Scene) -> dict[str, Any]:
    """The content of meta.json."""
    settings = scene.settings
    meta: dict[str, Any] = {
        "fps": settings.frames / scene.source.duration,
        "unit": "m",
        "up_axis": "z",
        "skeleton": "mediapipe33",
        "pixel_centre": 0.5,
        # Images are premultiplied: blending them again darkens edges.
        "background": "black",
    }
    if settings.avatar == FREE_BODY:
        meta["body"] = "free"
    meta["label_names"] = list(scene.character.label_names)
    meta["splits"] = {
        "train_cameras": scene.train_cameras,
        "test_cameras": scene.test_cameras,
        "train_frames": scene.train_frames,
        "test_frames": scene.test_frames,
    }

    # Settings of disabled effects are left out.
    made_by = {
        "generator": "gsgan.synthetic",
        "version": gsgan.__version__,
        "key": dataset_key(settings),
    }
    for name, value in asdict(settings).items():
        if value is not None:
            made_by[name] = value
    meta["made_by"] = made_by
    return meta
