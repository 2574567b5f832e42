"""The rules by which an interrupted run is resumed, and an old one replaced."""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsgan.data.datamodule import GsganData
from gsgan.evaluate.files import NAMES
from gsgan.evaluate.kept import FOLDER as SCORING
from gsgan.run.stored import CHECKPOINT, read_checkpoint, renew
from gsgan.utils.errors import ConfigError

PAGE = "avatar.html"


def training_record(
    settings: Mapping[str, Any], data: GsganData
) -> dict[str, Any]:
    """Settings that must not change when a run is resumed, and the poses that `gsgan.fit`
    made, whose file may be overwritten under the same name."""
    kept = dict(settings)

    # Fitted poses are compared by their content.
    poses = data.layout.poses
    if poses is not None and poses.fitted:
        kept["fitted poses"] = poses.digest(data.layout.frames)
    return kept


def checkpoint_to_resume(
    folder: Path, now: Mapping[str, Any], marks: list[str]
) -> Path | None:
    """The checkpoint of an earlier part of this run, or None, given its `training_record` now.

    Raises:
        ConfigError: when the folder holds a run with other settings.
    """
    # A folder without a checkpoint starts a new run.
    path = folder / CHECKPOINT
    if not path.is_file():
        return None

    # Scores with a stand-in must not be mixed with others.
    state = read_checkpoint(path)["gsgan"]
    if state["marks"] != marks:
        raise ConfigError(
            f"{folder} holds a run with other stand-ins: {state['marks'] or 'none'}, now "
            f"{marks or 'none'}; set training.perceptual.weights as it was, or resume=false to "
            "start over there"
        )

    # The settings must be the same; the message names the first five that differ.
    renew(state["record"])
    changed = sorted(set(_differences(state["record"], now)))
    if changed:
        shown = ", ".join(changed[:5]) + (" …" if len(changed) > 5 else "")
        raise ConfigError(
            f"{folder} holds a run with other settings ({shown}); choose another hydra.run.dir, "
            "or resume=false to start over there"
        )
    return path


def _differences(before: Any, now: Any, at: str = "") -> list[str]:
    # Nested settings are compared key by key; the dotted names of those that differ are returned.
    if isinstance(before, dict) and isinstance(now, dict):
        keys = sorted(before.keys() | now.keys(), key=str)
        pairs = [(k, before.get(k), now.get(k)) for k in keys]
        return [
            d
            for k, a, b in pairs
            for d in _differences(a, b, f"{at}.{k}" if at else str(k))
        ]
    return [] if before == now else [at]


def is_written(path: Path, checkpoint: Path) -> bool:
    """Whether a result is newer than the checkpoint."""
    return path.is_file() and path.stat().st_mtime >= checkpoint.stat().st_mtime


def remove_old_results(folder: Path) -> None:
    """Removes the results of an earlier run from a folder that starts over."""
    # Scores, the checkpoint, the page and what was kept while scoring.
    for name in (*NAMES, CHECKPOINT, PAGE):
        (folder / name).unlink(missing_ok=True)
    shutil.rmtree(folder / SCORING, ignore_errors=True)
    for scores in folder.glob("on_*/*"):  # on another background
        if scores.name in NAMES:
            scores.unlink()
    # else their curves would be shown as the new run's
    for logs in ("logs", "logs_[0-9]*"):
        for log in folder.glob(f"{logs}/metrics.csv"):
            log.unlink()
