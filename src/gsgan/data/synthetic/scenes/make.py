"""Writes a scene beside the default person's dataset: same person, same motion, other cameras.

Skeletons and body poses are the default dataset's files; pictures, masks, labels and cameras are
made anew. What a tint did is written down nowhere: who trains has to find out.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

# Private names of the generator: to make them public would change the key of its cache.
from gsgan.data.synthetic.make import _only_one, _write_json, ensure_synthetic
from gsgan.data.synthetic.scene_setup import Settings, Stage, build_stage
from gsgan.data.synthetic.scenes.lens import LensView, undistort
from gsgan.data.synthetic.scenes.options import SceneOptions
from gsgan.data.synthetic.scenes.photograph import Gloss, PhotographedPerson
from gsgan.data.synthetic.scenes.tint import Tint, make_tints
from gsgan.data.synthetic.trace import Array, Light, View
from gsgan.data.synthetic.worker import _bytes, write_png
from gsgan.utils.errors import ConfigError, DataError

KEPT = ("landmarks3d.npz", "hands3d.npz", "body_pose.npz")


def ensure_scene(
    *, cache: Path | None = None, workers: int = 2, progress: bool = True, **parameters: Any
) -> Path:
    """The default person, or a scene of it: found in the cache, or made there.

    Args:
        cache: cache folder, `gsgan.data.synthetic.cache_root` unless given.
        workers: processes that trace the default person; a scene is traced in this one.
        progress: whether to draw a progress bar.
        parameters: of :class:`gsgan.data.synthetic.scene_setup.Settings` and of
            :class:`SceneOptions`; without any of these it is the default person's own folder.

    Returns:
        The dataset's folder.

    Raises:
        ConfigError: on an unknown or senseless parameter.
        DataError: when the folder cannot be written.
    """
    options = SceneOptions.take_from(parameters)
    settings = Settings.from_parameters(parameters)
    if options.test_scale and not settings.test_cameras:
        raise ConfigError(
            "synthetic data: test_scale gives twins to the test cameras, of which there are none; "
            "set test_cameras"
        )
    plain = ensure_synthetic(cache=cache, workers=workers, progress=progress, **parameters)
    if not options.wanted:
        return plain
    root = plain.with_name(f"{plain.name}-{options_key(options)}")
    if _is_there(root):
        return root
    try:
        _make_whole(root, plain, settings, options, progress)
    except OSError as error:
        raise DataError(
            f"{root} cannot be written ({error}): make room, or set GSGAN_CACHE to a folder that "
            f"you may write to"
        ) from error
    return root


def options_key(options: SceneOptions) -> str:
    """The options' names, and a hash of their values and of this package."""
    digest = hashlib.sha256(repr(sorted(options.wanted.items())).encode())
    for path in sorted(Path(__file__).resolve().parent.glob("*.py")):
        digest.update(path.name.encode() + path.read_bytes())
    return "-".join([*options.wanted, digest.hexdigest()[:12]])


def _is_there(root: Path) -> bool:
    """Whether the scene is there; a folder gets its name when it is whole, this file last."""
    return (root / "meta.json").is_file()


def _make_whole(
    root: Path, plain: Path, settings: Settings, options: SceneOptions, progress: bool
) -> None:
    with _only_one(root.with_name(f".{root.name}.lock")) as alone:
        if _is_there(root):  # made while this process waited
            return
        prefix = f".{root.name}.part-"
        if alone:  # what a killed process could not tidy up
            for left in root.parent.glob(f"{prefix}*"):
                shutil.rmtree(left, ignore_errors=True)
        part = Path(tempfile.mkdtemp(prefix=prefix, dir=root.parent))
        try:
            _write(part, plain, settings, options, progress)
            part.chmod(0o755)  # mkdtemp's are private
            part.rename(root)
        finally:
            shutil.rmtree(part, ignore_errors=True)


def _write(
    root: Path, plain: Path, settings: Settings, options: SceneOptions, progress: bool
) -> None:
    stage = build_scene(settings, options)
    tints = scene_tints(stage, settings, options)
    gloss = Gloss(options.gloss) if options.gloss else None
    with _bar(settings, stage, progress) as frames:
        for frame in frames:
            moment = PhotographedPerson(
                stage.person, stage.vertices(frame), stage.flexion(frame), Light(), gloss
            )
            for name, view in stage.views.items():
                _write_pictures(root, name, frame, moment, view, settings, tints.get(name))
    for name in KEPT:
        shutil.copyfile(plain / name, root / name)
    _write_json(root / "cameras.json", {n: _calibration(v) for n, v in stage.views.items()})
    meta = json.loads((plain / "meta.json").read_text())
    meta["splits"]["test_cameras"] = stage.test_cameras
    meta["made_by"] |= {"generator": "gsgan.data.synthetic.scenes", **options.wanted}
    _write_json(root / "meta.json", meta)


def _write_pictures(
    root: Path,
    camera: str,
    frame: int,
    moment: PhotographedPerson,
    view: View,
    settings: Settings,
    tint: Tint | None,
) -> None:
    image, alpha, labels = moment.render(view, settings.rays_per_pixel)
    if tint is not None:
        image = tint(image, alpha)
    file = f"{frame:06d}.png"
    write_png(root / "images" / camera / file, _bytes(image[..., ::-1]))  # OpenCV wants BGR
    write_png(root / "masks" / camera / file, _bytes(alpha))
    write_png(root / "labels" / camera / file, labels.astype(np.uint8))


@contextmanager
def _bar(settings: Settings, stage: Stage, show: bool) -> Iterator[Any]:
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), disable=not show, transient=True) as bar:
        text = f"tracing the scene ({settings.frames} frames, {len(stage.views)} cameras)"
        yield bar.track(range(settings.frames), settings.frames, description=text)


def build_scene(settings: Settings, options: SceneOptions) -> Stage:
    """The default person's stage with the scene's cameras: lenses, and twins of test cameras."""
    stage = build_stage(settings)
    views = dict(stage.views)
    test = list(stage.test_cameras)
    for name in stage.test_cameras:
        for scale in options.test_scale or ():
            twin = f"{name}_x{scale:g}"
            views[twin] = zoomed(views[name], scale)
            test.append(twin)
    if options.lens is not None:
        views = {n: through_lens(v, np.array(options.lens)) for n, v in views.items()}
    return replace(stage, views=views, test_cameras=test)


def through_lens(view: View, dist: Array) -> LensView:
    """The same camera with a lens.

    Raises:
        ConfigError: when the lens cannot be undone up to the picture's corners.
    """
    H, W = view.size
    corners = np.array([[x, y, 1.0] for x in (0, W / 2, W) for y in (0, H / 2, H)])
    undistort((corners @ np.linalg.inv(view.K).T)[:, :2], dist)
    return LensView(view.K, view.R, view.t, view.size, dist)


def zoomed(view: View, scale: float) -> View:
    """The same camera with another focal length: the middle of the picture stays where it is."""
    H, W = view.size
    K = view.K.copy()
    K[:2, :2] *= scale
    K[:2, 2] = scale * (K[:2, 2] - [W / 2, H / 2]) + [W / 2, H / 2]
    return replace(view, K=K)


def scene_tints(stage: Stage, settings: Settings, options: SceneOptions) -> dict[str, Tint]:
    """Tints by training camera; held-out cameras stay neutral, as nothing could tell theirs."""
    if options.tint is None:
        return {}
    tints = make_tints(options.tint, len(stage.train_cameras), settings.seed)
    return dict(zip(stage.train_cameras, tints, strict=True))


def _calibration(view: View) -> dict[str, Any]:
    dist = view.dist if isinstance(view, LensView) else np.zeros(5)
    return {
        "K": view.K.tolist(),
        "R": view.R.tolist(),
        "t": view.t.tolist(),
        "dist": dist.tolist(),
        "size": [view.size[1], view.size[0]],
    }
