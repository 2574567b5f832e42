"""Writes the synthetic dataset, once, into a cache folder.

The layout is that of a capture: cameras.json, images/{cam}/%06d.png, masks/, labels/,
landmarks3d.npz, hands3d.npz, body_pose.npz, meta.json. A dataset is made under a temporary name and
renamed when complete, so that a killed run leaves nothing that looks like one. Tints are written
nowhere: a model has to estimate them.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

import gsgan
from gsgan.body.free import free_body
from gsgan.data.synthetic.choreography import DURATION
from gsgan.data.synthetic.lens import LensView
from gsgan.data.synthetic.scene_setup import Scene, Settings, build_scene, dataset_key
from gsgan.data.synthetic.trace import View
from gsgan.data.synthetic.worker import trace_frames
from gsgan.scene import BodyPose
from gsgan.utils.errors import DataError
from gsgan.utils.files import cache_root

POLL_SECONDS = 0.05


def ensure_synthetic(
    *, cache: Path | None = None, workers: int = 2, progress: bool = True, **parameters: Any
) -> Path:
    """The synthetic dataset with these parameters: found in the cache, or made there.

    Two processes may request the same dataset at once: the second waits, then finds it.

    Args:
        cache: cache folder, :func:`gsgan.utils.files.cache_root` by default.
        workers: processes that trace; 1 traces in this one. Does not change the result.
        progress: whether to draw a progress bar.
        parameters: of :class:`gsgan.data.synthetic.scene_setup.Settings`.

    Returns:
        The dataset's folder.

    Raises:
        ConfigError: on an unknown parameter or one out of range.
        DataError: when the folder cannot be written.
    """
    settings = Settings.from_parameters(parameters)
    root = (cache or cache_root()) / "data" / "synthetic" / dataset_key(settings)
    if not _is_complete(root):
        try:
            root.parent.mkdir(parents=True, exist_ok=True)
            _make(root, settings, workers, progress)
        except OSError as error:
            raise DataError(
                f"{root} cannot be written ({error}): make room, or set GSGAN_CACHE to a folder "
                f"that you may write to"
            ) from error
    return root


def _is_complete(root: Path) -> bool:
    """Whether the dataset exists: meta.json is written last."""
    return (root / "meta.json").is_file()


def _make(root: Path, settings: Settings, workers: int, progress: bool) -> None:
    with _exclusive(root.with_name(f".{root.name}.lock")) as alone:
        if _is_complete(root):  # made while this process waited
            return
        prefix = f".{root.name}.part-"
        if alone:  # remove what killed processes left
            for left in root.parent.glob(f"{prefix}*"):
                shutil.rmtree(left, ignore_errors=True)
        part = Path(tempfile.mkdtemp(prefix=prefix, dir=root.parent))
        try:
            _write(part, settings, workers, progress)
            part.chmod(0o755)  # mkdtemp's are private
            part.rename(root)
        finally:
            shutil.rmtree(part, ignore_errors=True)


@contextlib.contextmanager
def _exclusive(lock: Path) -> Iterator[bool]:
    """Holds a lock that the system releases when the process dies; False where it has no locks."""
    try:
        import fcntl
    except ImportError:  # Windows: two processes both work, and one result is kept
        yield False
        return
    with lock.open("w") as file:
        alone = True
        try:
            fcntl.flock(file, fcntl.LOCK_EX)
        except OSError:  # some network file systems refuse
            alone = False
        yield alone


def _write(root: Path, settings: Settings, workers: int, progress: bool) -> None:
    from rich.console import Console
    from rich.progress import Progress

    scene = build_scene(settings)
    with Progress(console=Console(stderr=True), disable=not progress, transient=True) as bar:
        count = f"{settings.frames} frames, {len(scene.views)} cameras"
        task = bar.add_task(f"tracing the synthetic person ({count})", total=settings.frames)
        if workers <= 1 or settings.frames == 1:
            for frame in range(settings.frames):
                trace_frames(root, scene, settings.rays_per_pixel, [frame])
                bar.advance(task)
        else:
            last = root / "labels" / list(scene.views)[-1]
            for _ in _trace_in_processes(root, settings, min(workers, settings.frames)):
                bar.update(task, completed=len(list(last.glob("*.png"))))
    _write_skeletons(root, settings, scene)
    cameras = {name: _calibration(view) for name, view in scene.views.items()}
    _write_json(root / "cameras.json", cameras)
    _write_json(root / "meta.json", _meta(settings, scene))


def _trace_in_processes(root: Path, settings: Settings, workers: int) -> Iterator[None]:
    """Divides the frames among processes; yields from time to time until all are done.

    Raises:
        DataError: with a failed worker's last line of output.
    """
    environment = dict(os.environ, OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    environment["PYTHONPATH"] = os.pathsep.join(p or os.getcwd() for p in sys.path)
    command = [sys.executable, "-m", "gsgan.data.synthetic.worker", str(root)]
    command += [json.dumps(asdict(settings))]
    with tempfile.TemporaryFile("w+") as errors, contextlib.ExitStack() as stack:
        running = []
        for first in range(workers):
            process = subprocess.Popen(
                [*command, str(first), str(workers)], stderr=errors, env=environment
            )
            stack.callback(process.wait)
            stack.callback(process.kill)
            running.append(process)
        while None in (codes := [process.poll() for process in running]):
            if any(codes):
                break
            yield
            time.sleep(POLL_SECONDS)
        if any(codes):
            errors.seek(0)
            lines = [line.strip() for line in errors if line.strip()]
            raise DataError(
                f"a process tracing the synthetic person failed: "
                f"{lines[-1] if lines else 'it was killed'}; workers=1 traces in this process"
            )


# ---------------------------------------------------------------- the small files


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n")


def _calibration(view: View) -> dict[str, Any]:
    return {
        "K": view.K.tolist(),
        "R": view.R.tolist(),
        "t": view.t.tolist(),
        "dist": view.dist.tolist() if isinstance(view, LensView) else [0.0] * 5,
        "size": [view.size[1], view.size[0]],
    }


def _write_skeletons(root: Path, settings: Settings, scene: Scene) -> None:
    body = free_body()
    pose, ids = BodyPose(scene.theta, scene.transl), np.arange(settings.frames, dtype=np.int64)
    p = body.posed_landmarks(pose).float().numpy()
    np.savez(
        root / "landmarks3d.npz",
        p=p,
        conf=np.ones(p.shape[:2], dtype=np.float32),
        reproj_px=np.zeros(p.shape[:2], dtype=np.float32),
        n_views=np.full(
            p.shape[:2], settings.train_cameras + settings.test_cameras, dtype=np.int64
        ),
        frame_id=ids,
        names=np.array(body.landmark_names),
    )
    np.savez(
        root / "hands3d.npz",
        p=body.posed_hands(pose).float().numpy(),
        frame_id=ids,
        names=np.array(body.hand_names),
    )
    np.savez(
        root / "body_pose.npz",
        theta=scene.theta.numpy(),
        transl=scene.transl.numpy(),
        frame_id=ids,
        joint_names=np.array(body.joint_names),
        passage=np.array(scene.passages),
    )


def _meta(settings: Settings, scene: Scene) -> dict[str, Any]:
    chosen = {name: value for name, value in asdict(settings).items() if value is not None}
    return {
        "fps": settings.frames / DURATION,
        "unit": "m",
        "up_axis": "z",
        "skeleton": "mediapipe33",
        "pixel_centre": 0.5,
        "background": "black",  # images are premultiplied: blending them again darkens edges
        "body": "free",
        "label_names": list(free_body().label_names),
        "splits": {
            "train_cameras": scene.train_cameras,
            "test_cameras": scene.test_cameras,
            "train_frames": scene.train_frames,
            "test_frames": scene.test_frames,
        },
        "made_by": {
            "generator": "gsgan.data.synthetic",
            "version": gsgan.__version__,
            "key": dataset_key(settings),
            **chosen,
        },
    }
