"""An EasyMocap folder on disk: calibration, pictures, masks, 3D keypoints and SMPL fits."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from writers.common import Subject, write_picture

NAMES = ("1", "2", "10")
SMPL_TO_BODY_25 = {  # joints that are the same point in both, or near enough
    1: 12, 2: 17, 3: 19, 4: 21, 5: 16, 6: 18, 7: 20, 8: 0, 9: 2, 10: 5, 11: 8, 12: 1, 13: 4, 14: 7,
    19: 10, 22: 11,
}  # fmt: skip
SMPL_VERTICES_TO_BODY_25 = {
    0: 332,
    15: 6260,
    16: 2800,
    17: 4071,
    18: 583,
    21: 3387,
    24: 6787,
}


def body_25(subject: Subject, frame: int) -> np.ndarray:
    """``[25, 4]``: the small toes were not seen, so they are zeros with confidence 0."""
    joints = np.zeros((25, 4))
    for number, joint in SMPL_TO_BODY_25.items():
        joints[number] = [*subject.joints[frame][joint], 0.9]
    for number, vertex in SMPL_VERTICES_TO_BODY_25.items():
        joints[number] = [*subject.vertices[frame][vertex], 0.6]
    return joints


def write_calibration(
    root: Path,
    subject: Subject,
    sizes: bool = True,
    lens: str = "dist",
    both: bool = True,
) -> None:
    """intri.yml and extri.yml by OpenCV, names in another order and with a "none" among them."""
    root.mkdir(parents=True, exist_ok=True)
    intri: dict[str, Any] = {}
    extri: dict[str, Any] = {}
    for name, camera in zip(NAMES, subject.cameras, strict=True):
        intri |= {f"K_{name}": camera.K, f"{lens}_{name}": camera.dist[None]}
        if sizes:
            intri |= {f"W_{name}": camera.size[0], f"H_{name}": camera.size[1]}
        places = {
            f"R_{name}": cv2.Rodrigues(camera.R)[0],
            f"T_{name}": camera.t[:, None],
        }
        extri = places | ({f"Rot_{name}": camera.R} if both else {}) | extri
    write_opencv(root / "intri.yml", [*NAMES, "none"], intri)
    write_opencv(root / "extri.yml", ["none", *reversed(NAMES)], extri)


def write_opencv(path: Path, names: list[str], values: dict[str, Any]) -> None:
    """A YAML file by OpenCV's own writer: a list of names, then numbers and matrices by key."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.startWriteStruct("names", cv2.FILE_NODE_SEQ)
    for name in names:
        storage.write("", name)
    storage.endWriteStruct()
    for key, value in values.items():
        storage.write(key, value)
    storage.release()


def write_easymocap(
    root: Path,
    subject: Subject,
    *,
    output: str = "",
    person: int = 0,
    pid: bool = False,
    hands: bool = False,
) -> Path:
    """A recording and its results in ``output``; with ``pid`` masks are named by person too."""
    write_calibration(root, subject)
    for i, frame in enumerate(subject.frames):
        for c, name in enumerate(NAMES):
            person_mask = np.where(subject.labels[i][c] > 0, 255, 0).astype(
                np.uint8
            )
            tail = f"_{person}" if pid else ""
            write_picture(
                root / f"images/{name}/{frame:06d}.jpg", subject.images[i][c]
            )
            write_picture(
                root / f"mask/{name}/{frame:06d}{tail}.png", person_mask
            )
        joints = body_25(subject, i)
        if hands:
            joints = np.concatenate([joints, hand_joints(subject, i)])
        rows = {
            "Rh": subject.Rh[i],
            "Th": subject.Th[i],
            "poses": subject.poses[i],
        }
        rows |= {"shapes": subject.shapes}
        entries = {
            "keypoints3d": {"keypoints3d": joints.tolist()},
            "smpl": {key: row[None].tolist() for key, row in rows.items()},
        }
        for kind, entry in entries.items():  # each a list of people
            path = root / f"{output}{kind}/{frame:06d}.json"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps([{"id": person, **entry}]))
    return root


def hand_joints(subject: Subject, frame: int) -> np.ndarray:
    """``[42, 4]`` left hand, right hand: points in a row from the wrist."""
    wrists = subject.joints[frame][[20, 21]]
    steps = 0.005 * np.arange(21)[:, None] * [1, 0, 0]
    points = (wrists[:, None] + steps).reshape(42, 3)
    return np.concatenate([points, np.full((42, 1), 0.8)], axis=1)
