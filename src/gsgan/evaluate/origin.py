"""The origin of a set of scores, as in facts.json: method, data and code."""

from __future__ import annotations

import hashlib
import json
import subprocess
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from gsgan import __version__
from gsgan.run.stored import choices

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData

# The ending of a commit with local changes.
DIRTY = "+changes"


@dataclass(frozen=True)
class Method:
    """A method that is scored; a field is None if unknown.

    Args:
        name: of the method.
        model, data: choices of these config groups.
        seed, iterations: of the training.
        train_seconds: wall clock over all parts of a resumed run.
        trained_by: commits that trained it, one per part of a resumed run.
    """

    name: str
    model: str | None = None
    data: str | None = None
    seed: int | None = None
    iterations: int | None = None
    train_seconds: float | None = None
    trained_by: list[str] | None = None


def read_method(folder: Path, **training: Any) -> Method:
    """The method of a run folder, with the fields of ``training``."""
    # The names in the run's config.
    chosen = choices(folder)
    return Method(
        "gsgan",
        model=chosen.get("model"),
        data=chosen.get("data"),
        **training,
    )


def origin(
    method: Method, data: GsganData, device: torch.device
) -> dict[str, Any]:
    """The content of facts.json."""
    commit, dirty = _commit()
    # The method's name and data go elsewhere; its other fields follow the protocol.
    trained = asdict(method)
    return {
        "version": __version__,
        "commit": commit,
        "dirty": dirty,
        "date": datetime.now().astimezone().isoformat(timespec="seconds"),
        "method": trained.pop("name"),
        "data": {
            "name": trained.pop("data"),
            "root": Path(data.layout.root).resolve().name,
            "fingerprint": fingerprint(data),
        },
        "protocol": None if data.protocol is None else data.protocol.name,
        **trained,
        "device": str(device),
        "torch": torch.__version__,
    }


def fingerprint(data: GsganData) -> str:
    """A short hash of cameras, frames, splits, image size and fitted body poses. It does not depend
    on the contents of images, nor on the place of the files."""
    # All inputs that images depend on, without the images: reading them would take long.
    layout = data.layout
    cameras = {
        name: list(camera.size) for name, camera in layout.cameras.items()
    }
    splits = {
        name: list(map(list, items))
        for name, items in data.splits.items.items()
    }
    content: dict[str, Any] = {
        "cameras": cameras,
        "frames": list(layout.frames),
        "splits": splits,
        "size": data.size,
        "crop": None if data.crop is None else asdict(data.crop),
    }
    # Other fitted poses are other inputs.
    if layout.poses is not None and layout.poses.fitted:
        content["poses"] = layout.poses.digest(layout.frames)

    # Sorted keys: the hash must not depend on their order.
    plain = json.dumps(content, sort_keys=True).encode()
    return hashlib.sha256(plain).hexdigest()[:12]


def training_code() -> list[str]:
    """The commit that a checkpoint records; empty if unknown."""
    # Local changes are part of the code, though git cannot name them.
    commit, dirty = _commit()
    if commit is None:
        return []
    return [commit + DIRTY if dirty else commit]


def _commit() -> tuple[str | None, bool | None]:
    """``git describe`` of this checkout, and whether tracked files differ from it; (None, None)
    outside a checkout or without git."""
    # The root of the checkout, above src/gsgan/evaluate; an installed package has none.
    root = Path(__file__).resolve().parents[3]
    if not (root / ".git").exists():
        return None, None

    # Untracked files do not count as changes.
    options = ("--always", "--tags", "--abbrev=12", f"--dirty={DIRTY}")
    command = ["git", "-C", str(root), "describe", *options]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, check=True, timeout=30
        )
    except (OSError, subprocess.SubprocessError):
        return None, None

    # The description ends with the mark of local changes.
    commit = done.stdout.strip()
    return commit.removesuffix(DIRTY) or None, commit.endswith(DIRTY)


def caption(origin: dict[str, Any]) -> str:
    """One line under a table: method, protocol, data, number of seeds, commit."""
    # Runs of other tools have no seed, no commit or no name of the data.
    data = origin["data"]
    seed = origin["seed"]
    method = filter(None, (origin["method"], origin["model"]))
    commit = f"commit {origin['commit'] or 'unknown'}"
    if origin["dirty"]:
        commit += ", changed since"
    parts = [
        " ".join(method),
        f"protocol {origin['protocol'] or 'none'}",
        f"data {data['name'] or 'unknown'} ({data['root']}, {data['fingerprint']})",
        "seed unknown" if seed is None else f"seed {seed}",
        commit,
    ]
    return " · ".join(parts)
