"""Writes the synthetic dataset, once, into a cache folder.

The layout is the bring-your-own one: cameras.json, images/{cam}/%06d.png, masks/, labels/,
landmarks3d.npz, hands3d.npz, body_pose.npz, meta.json. A dataset is made under a temporary name and
renamed when it is whole, so that a killed run leaves nothing that looks like one.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

import numpy as np

import gsgan
from gsgan.body.free import free_body
from gsgan.data.synthetic.scene_setup import Settings, Stage, build_stage, dataset_key
from gsgan.data.synthetic.worker import trace_frames
from gsgan.scene import BodyPose
from gsgan.utils.errors import DataError


def cache_root() -> Path:
    """Where gsgan keeps what it can make again: GSGAN_CACHE, else the user's cache folder."""
    if os.environ.get("GSGAN_CACHE"):
        return Path(os.environ["GSGAN_CACHE"]).expanduser()
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(base).expanduser() / "gsgan"


def ensure_synthetic(
    *, cache: Path | None = None, workers: int = 2, progress: bool = True, **parameters: Any
) -> Path:
    """The synthetic dataset with these parameters: found in the cache, or made there.

    Args:
        cache: cache folder, :func:`cache_root` unless given.
        workers: processes that trace; does not change the result.
        progress: whether to draw a progress bar.
        parameters: of :class:`gsgan.data.synthetic.scene_setup.Settings`.

    Returns:
        The dataset's folder.

    Raises:
        ConfigError: on an unknown or senseless parameter.
        DataError: when the folder cannot be written.
    """
    settings = Settings.from_parameters(parameters)
    root = (cache or cache_root()) / "data" / "synthetic" / dataset_key(settings)
    return make_synthetic(root, workers=workers, progress=progress, **asdict(settings))


def make_synthetic(
    root: Path, *, workers: int = 2, progress: bool = True, **parameters: Any
) -> Path:
    """Makes a synthetic dataset at ``root``, or leaves the same one that is already there alone.

    Two processes may ask for the same folder at once: the second waits, then finds it.

    Args:
        root: the dataset's folder; its parent is made.
        workers: processes that trace; 1 traces in this one.
        progress: whether to draw a progress bar.
        parameters: of :class:`gsgan.data.synthetic.scene_setup.Settings`.

    Returns:
        ``root``.

    Raises:
        ConfigError: on an unknown or senseless parameter.
        DataError: when ``root`` holds something else, or cannot be written.
    """
    root, settings = Path(root), Settings.from_parameters(parameters)
    if _is_there(root, settings):
        return root
    try:
        root.parent.mkdir(parents=True, exist_ok=True)
        _make_whole(root, settings, workers, progress)
    except OSError as error:
        raise DataError(
            f"{root} cannot be written ({error}): make room, or set GSGAN_CACHE to a folder that "
            f"you may write to"
        ) from error
    return root


def _make_whole(root: Path, settings: Settings, workers: int, progress: bool) -> None:
    with _only_one(root.with_name(f".{root.name}.lock")) as alone:
        if _is_there(root, settings):  # made while this process waited
            return
        prefix = f".{root.name}.part-"
        if alone:  # what a killed process could not tidy up
            for left in root.parent.glob(f"{prefix}*"):
                shutil.rmtree(left, ignore_errors=True)
        part = Path(tempfile.mkdtemp(prefix=prefix, dir=root.parent))
        try:
            _write(part, settings, workers, progress)
            part.chmod(0o755)  # mkdtemp's are private
            if root.is_dir():  # empty, or _is_there would have refused it
                root.rmdir()
            part.rename(root)
        finally:
            shutil.rmtree(part, ignore_errors=True)


def _is_there(root: Path, settings: Settings) -> bool:
    """Whether the folder holds this very dataset; False where there is nothing."""
    if not root.exists() or (root.is_dir() and not any(root.iterdir())):
        return False
    wanted = made_by(settings)
    try:
        found = json.loads((root / "meta.json").read_text()).get("made_by")
    except (OSError, ValueError, AttributeError):
        found = None
    if found != wanted:
        raise DataError(
            f"{root} holds something other than the synthetic dataset asked for: "
            f"choose another folder, or remove this one"
        )
    return True


@contextlib.contextmanager
def _only_one(lock: Path) -> Iterator[bool]:
    """Holds a lock that the system releases when the process dies; False where there is none."""
    try:
        import fcntl
    except ImportError:  # no such locks on Windows: two processes both work, one result is kept
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
    stage = build_stage(settings)
    with _bar(settings, progress) as advance:
        if workers <= 1 or settings.frames == 1:
            for _ in trace_frames(root, stage, settings.rays_per_pixel, range(settings.frames)):
                advance()
        else:
            _trace_in_processes(root, settings, min(workers, settings.frames), advance)
    _write_cameras(root, stage)
    _write_skeletons(root, settings, stage)
    _write_json(root / "meta.json", _meta(settings, stage))


@contextlib.contextmanager
def _bar(settings: Settings, show: bool) -> Iterator[Callable[[], None]]:
    from rich.console import Console
    from rich.progress import Progress

    cameras = settings.train_cameras + settings.test_cameras
    with Progress(console=Console(stderr=True), disable=not show, transient=True) as bar:
        text = f"tracing the synthetic person ({settings.frames} frames, {cameras} cameras)"
        task = bar.add_task(text, total=settings.frames)
        yield lambda: bar.advance(task)


def _trace_in_processes(
    root: Path, settings: Settings, workers: int, advance: Callable[[], None]
) -> None:
    """Shares the frames out over processes; a failure of one ends all.

    Raises:
        DataError: with the last line a failed worker said.
    """
    environment = dict(os.environ, OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    environment["PYTHONPATH"] = os.pathsep.join(p or os.getcwd() for p in sys.path)
    command = [sys.executable, "-m", "gsgan.data.synthetic.worker"]
    with tempfile.TemporaryFile("w+") as complaints, contextlib.ExitStack() as stack:
        running: list[subprocess.Popen[str]] = []
        stack.callback(_stop, running)
        for first in range(workers):
            process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=complaints,
                text=True,
                env=environment,
            )
            running.append(process)
            job = {
                "root": str(root),
                "settings": asdict(settings),
                "frames": list(range(first, settings.frames, workers)),
            }
            assert process.stdin is not None
            with contextlib.suppress(BrokenPipeError):  # its exit status says why
                process.stdin.write(json.dumps(job) + "\n")
                process.stdin.close()
        threads = [
            threading.Thread(target=_count, args=(p.stdout, advance), daemon=True) for p in running
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        if any(process.wait() != 0 for process in running):
            complaints.seek(0)
            said = [line.strip() for line in complaints if line.strip()]
            raise DataError(
                f"a process tracing the synthetic person failed: "
                f"{said[-1] if said else 'it was killed'}; workers=1 traces in this process"
            )


def _count(lines: IO[str] | None, advance: Callable[[], None]) -> None:
    for _ in lines or ():
        advance()


def _stop(processes: list[subprocess.Popen[str]]) -> None:
    for process in processes:
        if process.poll() is None:
            process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


# ---------------------------------------------------------------- the small files


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n")


def _write_cameras(root: Path, stage: Stage) -> None:
    cameras = {
        name: {
            "K": view.K.tolist(),
            "R": view.R.tolist(),
            "t": view.t.tolist(),
            "dist": [0.0] * 5,
            "size": [view.size[1], view.size[0]],
        }
        for name, view in stage.views.items()
    }
    _write_json(root / "cameras.json", cameras)


def _write_skeletons(root: Path, settings: Settings, stage: Stage) -> None:
    body, F = free_body(), settings.frames
    pose, ids = BodyPose(stage.theta, stage.transl), np.arange(F, dtype=np.int64)
    p = body.posed_landmarks(pose).float().numpy()
    np.savez(
        root / "landmarks3d.npz",
        p=p,
        conf=np.ones(p.shape[:2], dtype=np.float32),
        reproj_px=np.zeros(p.shape[:2], dtype=np.float32),
        n_views=np.full(p.shape[:2], len(stage.views), dtype=np.int64),
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
        theta=stage.theta.numpy(),
        transl=stage.transl.numpy(),
        frame_id=ids,
        joint_names=np.array(body.joint_names),
        passage=np.array(stage.passages),
    )


def made_by(settings: Settings) -> dict[str, Any]:
    """What a dataset was made by: all that its bytes depend on."""
    return {
        "generator": "gsgan.data.synthetic",
        "version": gsgan.__version__,
        "key": dataset_key(settings),
        **asdict(settings),
    }


def _meta(settings: Settings, stage: Stage) -> dict[str, Any]:
    from gsgan.data.synthetic.motion import DURATION

    return {
        "fps": settings.frames / DURATION,
        "unit": "m",
        "up_axis": "z",
        "skeleton": "mediapipe33",
        "pixel_centre": 0.5,
        "background": "black",  # pictures come premultiplied: mixing them again darkens edges
        "body": "free",
        "label_names": list(free_body().label_names),
        "splits": {
            "train_cameras": stage.train_cameras,
            "test_cameras": stage.test_cameras,
            "train_frames": stage.train_frames,
            "test_frames": stage.test_frames,
        },
        "made_by": made_by(settings),
    }
