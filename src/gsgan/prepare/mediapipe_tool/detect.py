"""Finds body, hand and face landmarks, and the person's mask, in one video or folder of images.

Runs in its own environment (requirements.txt beside it). `gsgan.prepare.mediapipe` starts it with a
JSON object: source, out, masks (a folder, or empty), hands, face, rotate, person (left, top, right,
bottom of the person in the first image, shares of width and height; null: whoever is seen best),
threads (processors; 0 is all), slot (number among those that run at once). Prints a line
``<images done> <images in total>`` per image. Writes an npz:

    px (F,33,2), conf (F,33)     pixels of the image as stored, first pixel's centre at (0.5, 0.5)
    left, right (F,21,2)         the person's hands; NaN = not found
    face (F,468,2)               MediaPipe's face mesh; NaN = not found
    world (F,33,3)               metres from the middle of the hips, x right, y down, z away
    left_z, right_z (F,21)       depth of the hands' landmarks from their wrist, pixels
    faces (F,)                   number of faces, of any person
    frame_id (F,)

and masks/%06d.png, 0..255. Depths are guesses: they start the solution from one camera.
"""

import json
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

os.environ.setdefault("GLOG_minloglevel", "2")

import cv2
import mediapipe as mp
import numpy as np

SUFFIXES = (".jpg", ".jpeg", ".png")
JOINTS = 33
HAND = 21
FACE = 468
# of the mask's crop beyond the joints, share of the person's height
MARGIN = 0.15
# Around a chosen person: how far the next image is searched beyond the joints, share of the
# person's height, and how many joints of this confidence show where the person is.
SEARCHED = 0.15
CERTAIN = 0.5
MIN_CERTAIN = 12
PAINTED_GREY = 127


def main() -> None:
    options = SimpleNamespace(**json.loads(sys.argv[1]))
    if options.threads and hasattr(os, "sched_setaffinity"):
        # MediaPipe has no option for the number of threads; the allowed processors bound it.
        allowed = sorted(os.sched_getaffinity(0))
        first = options.slot * options.threads
        chosen = {
            allowed[(first + i) % len(allowed)] for i in range(options.threads)
        }
        os.sched_setaffinity(0, chosen)
    cv2.setNumThreads(options.threads or -1)

    # The images, one at a time: a video does not fit into the memory.
    count, images = open_source(Path(options.source), options.rotate)
    folder = Path(options.masks) if options.masks else None
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)

    # The landmarks of each image, and its mask as a file.
    results: dict[str, list[Any]] = {}
    detector = Detector(options)
    follower = Follower(options.person) if options.person else None
    for done, (frame, image) in enumerate(images, start=1):
        if follower is not None:
            image = follower.alone(image)
        landmarks = detector.landmarks(image)
        if follower is not None:
            follower.follow(landmarks["px"], landmarks["conf"])
        for name, value in (*landmarks.items(), ("frame_id", frame)):
            results.setdefault(name, []).append(value)
        if (
            folder
            and (mask := detector.mask(image, landmarks["px"])) is not None
        ):
            cv2.imwrite(str(folder / f"{frame:06d}.png"), mask)
        print(done, max(done, count), flush=True)
    if not results:
        raise SystemExit(f"{options.source} holds no image that can be decoded")

    # The results appear at once, when they are complete.
    out = Path(options.out)
    part = out.with_name(f".{out.name}")
    with part.open("wb") as stream:
        arrays: dict[str, Any] = {
            name: np.array(values) for name, values in results.items()
        }
        np.savez(stream, **arrays)
    part.replace(out)


def open_source(
    path: Path, rotate: int
) -> tuple[int, Iterator[tuple[int, Any]]]:
    """Number of images (0: unknown), and an iterator of (frame number, BGR image)."""
    if path.is_dir():
        paths = [
            p
            for p in path.iterdir()
            if p.suffix.lower() in SUFFIXES and not p.name.startswith(".")
        ]
        # The last group of digits that differs, as in gsgan.utils.frame_files.
        groups = [re.findall(r"[0-9]+", p.stem) for p in paths]
        place = -1
        if len({len(group) for group in groups}) == 1:
            for i, values in enumerate(zip(*groups, strict=True)):
                if len(set(values)) > 1:
                    place = i
        files = {int(g[place]): p for g, p in zip(groups, paths, strict=True)}
        return len(files), (
            (frame, read_image(files[frame])) for frame in sorted(files)
        )

    # The length that a video's header gives may be wrong or 0.
    video = cv2.VideoCapture(str(path))
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, int(rotate))
    return int(video.get(cv2.CAP_PROP_FRAME_COUNT)), enumerate(
        read_video(video)
    )


def read_image(path: Path) -> Any:
    """The image as stored: calibrations ignore EXIF rotation."""
    image = cv2.imread(
        str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    )
    if image is None:
        raise SystemExit(f"{path} is damaged")
    return image


def read_video(video: cv2.VideoCapture) -> Iterator[Any]:
    while (read := video.read())[0]:
        yield read[1]


class Follower:
    """One person among several: the others are painted over, as far as they are beside it.

    Args:
        box: left, top, right, bottom in the first image, shares of width and height.
    """

    def __init__(self, box: list[float]) -> None:
        self.shares = np.array(box)
        self.box: Any = None  # pixels: low and high corner, [2, 2]

    def alone(self, image: Any) -> Any:
        """The image, grey outside the box."""
        size = np.array([image.shape[1], image.shape[0]])
        if self.box is None:
            self.box = self.shares.reshape(2, 2) * size
        reach = SEARCHED * np.ptp(self.box, axis=0).max()
        low = self.box[0] - reach
        high = self.box[1] + reach
        left, top = np.clip(low, 0, size).astype(int)
        right, bottom = np.clip(high, 0, size).astype(int)
        shown = np.full_like(image, PAINTED_GREY)
        shown[top:bottom, left:right] = image[top:bottom, left:right]
        return shown

    def follow(self, px: Any, conf: Any) -> None:
        """Moves the box to landmarks ``[33, 2]``, if they show a person."""
        sure = (conf > CERTAIN) & np.isfinite(px).all(-1)
        if sure.sum() >= MIN_CERTAIN:
            self.box = np.stack([px[sure].min(0), px[sure].max(0)])


class Detector:
    """The detectors of one video: they track the person from image to image."""

    def __init__(self, options: SimpleNamespace) -> None:
        solutions = mp.solutions
        # Smoothing here would lag; gsgan smooths in 3D.
        holistic = options.hands or options.face
        kind = solutions.holistic.Holistic if holistic else solutions.pose.Pose
        self.body = kind(smooth_landmarks=False)
        self.faces = solutions.face_detection.FaceDetection(model_selection=1)
        self.segmenter = solutions.pose.Pose(
            static_image_mode=True, enable_segmentation=True
        )

    def landmarks(self, image: Any) -> dict[str, Any]:
        # MediaPipe reads RGB; parts that it did not find are None.
        rgb = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        result = self.body.process(rgb)
        size = image.shape[1], image.shape[0]
        pose = result.pose_landmarks
        visibility = (
            [p.visibility for p in pose.landmark] if pose else [0.0] * JOINTS
        )
        hands = {
            side: getattr(result, f"{side}_hand_landmarks", None)
            for side in ("left", "right")
        }

        # Absent parts become NaN, so that every image has the same arrays.
        return {
            "px": pixels(pose, size, JOINTS),
            "conf": np.array(visibility, np.float32),
            "world": space(result.pose_world_landmarks),
            "faces": len(self.faces.process(rgb).detections or ()),
            **{side: pixels(hand, size, HAND) for side, hand in hands.items()},
            **{
                f"{side}_z": depth(hand, size, HAND)
                for side, hand in hands.items()
            },
            "face": pixels(getattr(result, "face_landmarks", None), size, FACE),
        }

    def mask(self, image: Any, px: Any) -> Any:
        """0..255 of the whole image, found in a crop around the person; None: nobody there."""
        if not np.isfinite(px).all():
            return None

        # The box of the landmarks with a margin, inside the image.
        height, width = image.shape[:2]
        low = px.min(0)
        high = px.max(0)
        reach = MARGIN * (high - low).max()
        left, top = np.clip(low - reach, 0, [width - 1, height - 1]).astype(int)
        right, bottom = np.clip(high + reach, 1, [width, height]).astype(int)

        # A person at the border may leave no pixels.
        if right - left < 2 or bottom - top < 2:
            return None

        # The segmenter works at a fixed size: a crop gives the person more
        # pixels.
        crop = cv2.cvtColor(image[top:bottom, left:right], cv2.COLOR_BGR2RGB)
        alpha = self.segmenter.process(crop).segmentation_mask
        if alpha is None:
            return None
        mask = np.zeros((height, width), np.uint8)
        mask[top:bottom, left:right] = np.round(255 * np.clip(alpha, 0, 1))
        return mask


def pixels(landmarks: Any, size: tuple[int, int], count: int) -> Any:
    """``[count, 2]``; MediaPipe's numbers are shares of the image's width and height."""
    if landmarks is None:
        return np.full((count, 2), np.nan, np.float32)
    return np.array(
        [(p.x * size[0], p.y * size[1]) for p in landmarks.landmark], np.float32
    )


def depth(landmarks: Any, size: tuple[int, int], count: int) -> Any:
    """``[count]``; MediaPipe's numbers are shares of the image's width."""
    if landmarks is None:
        return np.full(count, np.nan, np.float32)
    return np.array([p.z * size[0] for p in landmarks.landmark], np.float32)


def space(landmarks: Any) -> Any:
    """``[33, 3]`` metres."""
    if landmarks is None:
        return np.full((JOINTS, 3), np.nan, np.float32)
    return np.array([(p.x, p.y, p.z) for p in landmarks.landmark], np.float32)


if __name__ == "__main__":
    main()
