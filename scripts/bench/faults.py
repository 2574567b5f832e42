"""Which faults of cameras.json `gsgan.check` finds, one at a time, in captures that are correct.

    python scripts/bench/faults.py /path/to/capture /path/to/another

Prints a row per fault and a column per capture: *refused* (the dataset cannot be opened), *error*
or *warning* (new findings, of which one names the changed camera), *unnamed* (none does), or *not
found*. A fault of one camera is put into the second; those of a pair into the first and third.
A capture needs three cameras.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gsgan.check.report import Finding
from gsgan.check.run import check_data
from gsgan.data.datamodule import GsganData
from gsgan.data.formats.capture import CaptureReader
from gsgan.utils.config import build, defaults_of

IMAGES = 80
LEVELS = ("error", "warning")
UPRIGHT, LEVEL, SIGHT = (
    np.array([0.0, 1, 0]),
    np.array([1.0, 0, 0]),
    np.array([0.0, 0, 1]),
)

Camera = dict[str, Any]  # an entry of cameras.json, its lists as arrays


def turned(
    axis: np.ndarray, degrees: float, *, about_centre: bool = True
) -> Callable:
    """Turned about its own axis; with t kept it moves along its circle about the world's origin."""
    turn = cv2.Rodrigues(np.radians(degrees) * axis)[0]
    return lambda c: {
        "R": turn @ c["R"],
        **({"t": turn @ c["t"]} if about_centre else {}),
    }


def moved(metres: float) -> Callable:
    """Moved sideways."""
    return lambda c: {"t": c["t"] + metres * LEVEL}


def scaled(factor: float) -> Callable:
    """Of t, as a camera's in another unit has."""
    return lambda c: {"t": factor * c["t"]}


def zoomed(factor: float, *, centre: bool = False) -> Callable:
    """Of the focal lengths; with ``centre`` also of the principal point, as of a resized image."""
    by = np.array([factor, factor, 1])
    return lambda c: {
        "K": c["K"] * (by[:, None] if centre else np.diag(by - 1) + 1)
    }


def inverse(c: Camera) -> Camera:
    """Camera to world."""
    return {"R": c["R"].T, "t": -c["R"].T @ c["t"]}


def position(c: Camera) -> Camera:
    """The camera's position as t."""
    return {"t": -c["R"].T @ c["t"]}


def opengl(c: Camera) -> Camera:
    """The y axis up, looking along −z."""
    flip = np.diag([1.0, -1, -1])
    return {"R": flip @ c["R"], "t": flip @ c["t"]}


def centre_exchanged(c: Camera) -> Camera:
    """Cx for cy."""
    K = c["K"].copy()
    K[:2, 2] = K[1::-1, 2]
    return {"K": K}


def size_exchanged(c: Camera) -> Camera:
    """Width for height."""
    return {"size": c["size"][::-1]}


def lens(c: Camera) -> Camera:
    """Distortion of a lens that has none."""
    return {"dist": np.array([-0.1, 0, 0, 0, 0])}


# Each row: what is wrong, the change, and of which cameras: one, all, or the keys of a pair.
FAULTS: list[tuple[str, Callable | None, str]] = [
    ("R and t of two cameras exchanged", None, "R t"),
    ("all of two cameras exchanged", None, "K R t dist size"),
    *(
        (
            f"turned by {degrees}° about its {name} axis",
            turned(axis, degrees),
            "one",
        )
        for degrees in (5, 2)
        for name, axis in (("upright", UPRIGHT), ("level", LEVEL))
    ),
    ("turned by 5° about its line of sight", turned(SIGHT, 5), "one"),
    ("turned by 2° about its line of sight", turned(SIGHT, 2), "one"),
    (
        "turned by 5° with `t` kept",
        turned(UPRIGHT, 5, about_centre=False),
        "one",
    ),
    *(
        (f"moved sideways by {100 * d:.0f} cm", moved(d), "one")
        for d in (0.2, 0.1, 0.05)
    ),
    *(
        (f"`t` in {unit}", scaled(factor), which)
        for unit, factor in (("mm", 1000), ("cm", 100), ("inches", 1 / 0.0254))
        for which in ("one", "all")
    ),
    *(("R and t camera to world", inverse, which) for which in ("one", "all")),
    *(("`t` holds the position", position, which) for which in ("one", "all")),
    ("axes of OpenGL", opengl, "all"),
    ("width and height exchanged in `size`", size_exchanged, "all"),
    *(
        ("cx and cy exchanged", centre_exchanged, which)
        for which in ("one", "all")
    ),
    *(
        (
            f"K of an image {factor} times as large",
            zoomed(factor, centre=True),
            which,
        )
        for factor in (2, 0.5)
        for which in ("one", "all")
    ),
    *(
        (
            f"focal lengths times {factor}, cx and cy right",
            zoomed(factor),
            which,
        )
        for factor in (0.5, 1.3, 1.1, 0.9, 1.05)
        for which in ("one", "all")
    ),
    ("distortion of a lens that has none, k1 = −0.1", lens, "one"),
]


def damaged(
    cameras: dict[str, Camera], change: Callable | None, which: str
) -> set[str]:
    """Introduces a fault in place and returns the names of the cameras that have it."""
    names = sorted(cameras)
    if change is None:
        first, second = names[0], names[2]
        held = {key: cameras[first][key] for key in which.split()}
        cameras[first] |= {key: cameras[second][key] for key in held}
        cameras[second] |= held
        return {first, second}
    names = names if which == "all" else names[1:2]
    for name in names:
        cameras[name] |= change(cameras[name])
    return set(names)


def findings(root: Path) -> tuple[Finding, ...] | None:
    """What the check finds; None when the dataset cannot be read."""
    data = GsganData(root=str(root), reader=CaptureReader())
    defaults = defaults_of("check")
    report = check_data(
        data,
        build(defaults.sampling, images=IMAGES),
        build(defaults.limits),
        build(defaults_of("effects/auto")),
    )
    return report.findings if report.numbers.get("readable", True) else None


def verdict(
    root: Path, known: set[Finding], names: set[str], *, every: bool
) -> str:
    """What is found beyond ``known``."""
    found = findings(root)
    if found is None:
        return "refused"
    new = [f for f in found if f not in known]
    level = next((x for x in LEVELS if any(f.level == x for f in new)), None)
    if level is None:
        return "**not found**"
    named = every or any(
        name in f.sentence for f in new if f.level == level for name in names
    )
    return level if named else f"{level}, unnamed"


def column(capture: Path) -> list[str]:
    """The verdict on every fault, in a copy of the capture."""
    rig = {
        name: {key: np.array(value) for key, value in camera.items()}
        for name, camera in json.loads(
            (capture / "cameras.json").read_text()
        ).items()
    }
    with tempfile.TemporaryDirectory() as folder:
        root = Path(shutil.copytree(capture, Path(folder) / capture.name))

        def write(cameras: dict[str, Camera]) -> None:
            entries = {
                n: {k: v.tolist() for k, v in c.items()}
                for n, c in cameras.items()
            }
            (root / "cameras.json").write_text(json.dumps(entries))

        write(rig)
        correct = findings(root)
        assert correct is not None, f"{capture} cannot be read"
        verdicts = []
        for _, change, which in FAULTS:
            cameras = {name: dict(camera) for name, camera in rig.items()}
            names = damaged(cameras, change, which)
            write(cameras)
            verdicts.append(
                verdict(root, set(correct), names, every=which == "all")
            )
    return verdicts


def main(captures: list[Path]) -> None:
    print("| fault | of | " + " | ".join(path.name for path in captures) + " |")
    print("|---" * (2 + len(captures)) + "|")
    columns = [column(path) for path in captures]
    for (fault, change, which), *cells in zip(FAULTS, *columns, strict=True):
        print(
            f"| {fault} | {'a pair' if change is None else which} | {' | '.join(cells)} |"
        )


if __name__ == "__main__":
    main([Path(path) for path in sys.argv[1:]] or sys.exit(__doc__))
