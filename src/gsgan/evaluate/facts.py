"""facts.json: by what, of what, and with what code scores were made."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import subprocess
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from omegaconf import OmegaConf

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData

FINGERPRINT = 12  # hexadecimal digits
SAME = ("method", "model", "protocol", "seed", "iterations", "version", "commit", "dirty")


@dataclass(frozen=True)
class Method:
    """What is scored.

    Args:
        name: of the method.
        model: choice of the model group, or None.
        data: choice of the data group, or None.
        seed: of the training, or None.
        iterations: of the training, or None.
        train_seconds: of wall clock, all parts of a resumed run together, or None.
        trained_by: commits that trained it, those of a resumed run's parts; None: not known.
    """

    name: str
    model: str | None = None
    data: str | None = None
    seed: int | None = None
    iterations: int | None = None
    train_seconds: float | None = None
    trained_by: tuple[str, ...] | None = None


def facts(method: Method, data: GsganData, device: torch.device) -> dict[str, Any]:
    """What facts.json holds.

    Args:
        method: what is scored.
        data: on what.
        device: that scored.
    """
    try:
        version = importlib.metadata.version("gsgan")
    except importlib.metadata.PackageNotFoundError:
        version = None
    commit, dirty = commit_of()
    return {
        "version": version,
        "commit": commit,
        "dirty": dirty,
        "date": datetime.now().astimezone().isoformat(timespec="seconds"),
        "method": method.name,
        "model": method.model,
        "data": {
            "name": method.data,
            "root": Path(data.layout.root).resolve().name,
            "fingerprint": fingerprint(data),
        },
        "protocol": None if data.protocol is None else data.protocol.name,
        "seed": method.seed,
        "iterations": method.iterations,
        "train_seconds": method.train_seconds,
        "trained_by": None if method.trained_by is None else list(method.trained_by),
        "device": str(device),
        "torch": torch.__version__,
    }


def training_code() -> list[str]:
    """What a checkpoint says of the code that trained it; empty where that is not known."""
    commit, dirty = commit_of()
    return [] if commit is None else [commit + ("+changes" if dirty else "")]


def commit_of(folder: Path | None = None) -> tuple[str | None, bool | None]:
    """``git describe`` of the checkout that holds the code, and whether it was changed since.

    (None, None) where the code is installed, or git is not at hand.

    Args:
        folder: of the code; None: of this very package.
    """
    folder = folder or Path(__file__).resolve().parent
    root = next((f for f in folder.parents if (f / ".git").exists()), None)
    if root is None or not (root / "src" / "gsgan").is_dir():
        return None, None
    try:
        said = [
            subprocess.run(
                ["git", "-C", str(root), *arguments],
                capture_output=True, text=True, check=True, timeout=30,
            ).stdout.strip()
            for arguments in (
                ("describe", "--always", "--tags", "--abbrev=12"),
                ("status", "--porcelain", "--untracked-files=no"),
            )
        ]  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return None, None
    return said[0] or None, bool(said[1])


def fingerprint(data: GsganData) -> str:
    """A short hash of what is trained on and scored: cameras, frames, splits, picture size.

    Contents of pictures are not in it, nor where they lie; of landmarks only fitted ones are.
    """
    layout, splits = data.layout, data.splits
    said: dict[str, Any] = {
        "cameras": {name: list(camera.size) for name, camera in layout.cameras.items()},
        "frames": list(layout.frames),
        "splits": {name: [list(item) for item in items] for name, items in splits.items.items()},
        "size": data.size,
        "crop": None if data.crop is None else asdict(data.crop),
    }
    if layout.landmarks.fitted_to:  # other skeletons are other inputs, and cut other windows
        said["landmarks"] = layout.landmarks.digest(layout.frames)
    plain = json.dumps(said, sort_keys=True).encode()
    return hashlib.sha256(plain).hexdigest()[:FINGERPRINT]


def choices(folder: Path) -> dict[str, Any]:
    """The config groups' choices of a run folder, as Hydra wrote them; empty where it did not."""
    path = folder / ".hydra" / "hydra.yaml"
    if not path.is_file():
        return {}
    found = OmegaConf.select(OmegaConf.load(path), "hydra.runtime.choices")
    return {} if found is None else {str(key): value for key, value in found.items()}


def same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    """Whether two scorings may stand in one table: of one method and training on the same data,
    wherever that lies, by the same code."""
    prints = (a["data"]["fingerprint"], b["data"]["fingerprint"])
    return prints[0] == prints[1] and all(a[key] == b[key] for key in SAME)


def provenance(held: dict[str, Any]) -> dict[str, str]:
    """What every row of a table carries: protocol, data, number of seeds, commit."""
    data = held["data"]
    return {
        "protocol": held["protocol"] or "none",
        "data": f"{data['name'] or 'unknown'} ({data['root']}, {data['fingerprint']})",
        "seeds": "none said" if held["seed"] is None else f"1 ({held['seed']})",
        "commit": (held["commit"] or "unknown") + (", changed since" if held["dirty"] else ""),
    }


def caption(held: dict[str, Any]) -> str:
    """One line for people at a table: what its rows are of."""
    method = held["method"] if held["model"] is None else f"{held['method']} {held['model']}"
    return " · ".join([method, *(f"{what} {said}" for what, said in provenance(held).items())])
