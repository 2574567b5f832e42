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
SMPL_VERTICES_TO_BODY_25 = {0: 332, 15: 6260, 16: 2800, 17: 4071, 18: 583, 21: 3387, 24: 6787}


def body_25(subject: Subject, frame: int) -> np.ndarray:
    """``[25, 4]``: the small toes were not seen, so they are zeros with confidence 0."""
    joints = np.zeros((25, 4))
    for number, joint in SMPL_TO_BODY_25.items():
        joints[number] = [*subject.joints[frame][joint], 0.9]
    for number, vertex in SMPL_VERTICES_TO_BODY_25.items():
        joints[number] = [*subject.vertices[frame][vertex], 0.6]
    return joints


def write_calibration(
    root: Path, subject: Subject, sizes: bool = True, lens: str = "dist", both: bool = True
) -> None:
    """intri.yml and extri.yml by OpenCV, names in another order and with a "none" among them."""
    root.mkdir(parents=True, exist_ok=True)
    cameras = dict(zip(NAMES, subject.cameras, strict=True))
    intri = cv2.FileStorage(str(root / "intri.yml"), cv2.FILE_STORAGE_WRITE)
    extri = cv2.FileStorage(str(root / "extri.yml"), cv2.FILE_STORAGE_WRITE)
    _names(intri, [*NAMES, "none"])
    _names(extri, ["none", *reversed(NAMES)])
    for name, camera in cameras.items():
        intri.write(f"K_{name}", camera.K)
        intri.write(f"{lens}_{name}", camera.dist[None])
        if sizes:
            intri.write(f"W_{name}", camera.size[0])
            intri.write(f"H_{name}", camera.size[1])
    for name, camera in reversed(cameras.items()):
        extri.write(f"R_{name}", cv2.Rodrigues(camera.R)[0])
        if both:
            extri.write(f"Rot_{name}", camera.R)
        extri.write(f"T_{name}", camera.t[:, None])
    intri.release()
    extri.release()


def _names(storage: Any, names: list[str]) -> None:
    storage.startWriteStruct("names", cv2.FILE_NODE_SEQ)
    for name in names:
        storage.write("", name)
    storage.endWriteStruct()


def write_easymocap(
    root: Path,
    subject: Subject,
    *,
    kinds: tuple[str, ...] = ("keypoints3d", "smpl"),
    output: str = "",
    person: int = 0,
    pid: bool = False,
    hands: bool = False,
) -> Path:
    """A recording and its results in ``output``; with ``pid`` masks are named by person too."""
    write_calibration(root, subject)
    for i, frame in enumerate(subject.frames):
        for c, name in enumerate(NAMES):
            person_mask = np.where(subject.labels[i][c] > 0, 255, 0).astype(np.uint8)
            tail = f"_{person}" if pid else ""
            write_picture(root / f"images/{name}/{frame:06d}.jpg", subject.images[i][c])
            write_picture(root / f"mask/{name}/{frame:06d}{tail}.png", person_mask)
        if "keypoints3d" in kinds:
            joints = body_25(subject, i)
            if hands:
                joints = np.concatenate([joints, hand_joints(subject, i)])
            entry = {"id": person, "keypoints3d": joints.tolist()}
            write_people(root / f"{output}keypoints3d/{frame:06d}.json", [entry])
        if "smpl" in kinds:
            entry = {
                "id": person,
                "Rh": subject.Rh[i][None].tolist(),
                "Th": subject.Th[i][None].tolist(),
                "poses": subject.poses[i][None].tolist(),
                "shapes": subject.shapes[None].tolist(),
            }
            write_people(root / f"{output}smpl/{frame:06d}.json", [entry])
    return root


def hand_joints(subject: Subject, frame: int) -> np.ndarray:
    """``[42, 4]`` left hand, right hand: points in a row from the wrist."""
    wrists = subject.joints[frame][[20, 21]]
    steps = 0.005 * np.arange(21)[:, None] * [1, 0, 0]
    points = (wrists[:, None] + steps).reshape(42, 3)
    return np.concatenate([points, np.full((42, 1), 0.8)], axis=1)


def write_people(path: Path, people: list[dict[str, Any]]) -> None:
    """One frame's people as EasyMocap writes them: a list."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(people))
