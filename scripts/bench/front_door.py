"""What `gsgan.prepare` costs: rendered people whose truth is known, filmed as cameras film people.

    python scripts/bench/front_door.py film=jog_cut folder=build/door
    python scripts/bench/front_door.py film=jog_cut folder=build/door rungs=[exact,both]

A film has a person, clips and cameras (scripts/bench/front_door.yaml). Each camera stands in a room
of its own, with a floor on which the person casts a shadow, has its own exposure and white balance,
and writes H.264 with noise and motion blur. Then follow `gsgan.prepare` on the videos, the errors
of its sides, landmarks, cameras and masks, and the ladder: an avatar trained on exact inputs, with
prepared landmarks, with prepared images and masks, and with both. All are scored on true images
with true masks, in held-out frames of the cameras, and in a camera that was not filmed. Steps that
are finished are kept: the same command continues, and prints the table.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pandas as pd
from contourpy import contour_generator
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from scipy.optimize import least_squares
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from gsgan.skeleton import MEDIAPIPE33
from gsgan.skeleton.joints import (
    ARM_PAIRS,
    BODY,
    FACE,
    HAND_PAIRS,
    HANDS,
    HEAD_PAIRS,
    LEG_PAIRS,
    joint_names,
)
from gsgan.synthetic.camera import SceneCamera
from gsgan.synthetic.scene_setup import Scene, SceneSettings, front, ring
from gsgan.synthetic.scenes import _calibration as calibration
from gsgan.utils.files import write_json, write_npz

SETTINGS = Path(__file__).with_suffix(".yaml")
RUNGS = ("exact", "landmarks", "masks", "both")
TEST_CAMERA = "test"
# Frames that are held out: the last of every twelve.
PERIOD = 12
HELD_OUT = 3
SHUTTER = 1 / 120  # seconds
BLUR_RAYS = 4  # per pixel, before and after the middle of the shutter
WALL_DISTANCE = 4.5  # metres from the middle of the room
SHADOW_RAYS = 4
SKY_LIGHT = 0.45  # of the floor in the person's shadow
NOISE = 2.0  # standard deviation of the sensor's noise, of 255
QUALITY = "21"  # x264's constant rate factor: as phones and webcams write


@dataclass(frozen=True)
class Clip:
    """Consecutive frames of a motion."""

    motion: str
    start: float  # seconds
    frames: int


class Film:
    """A person in clips that are cut together.

    Args:
        settings: of one film in front_door.yaml.
    """

    def __init__(self, settings: DictConfig) -> None:
        self.fps = float(settings.fps)
        self.scenes: list[tuple[Scene, int]] = []
        points = []
        scene_settings = SceneSettings(
            size=settings.size,
            train_cameras=settings.cameras,
            test_cameras=1,
            frames=1,
            test_frames=0,
            avatar=settings.avatar,
        )
        for values in settings.clips:
            clip = Clip(*values)
            scene = Scene(
                SceneSettings(**{**vars(scene_settings), "motion": clip.motion})
            )

            # The moments before, in the middle of and after the shutter's opening.
            middle = clip.start + np.arange(clip.frames) / self.fps
            around = np.array([-0.5, 0, 0.5]) * SHUTTER
            scene.times = (middle[:, None] + around).ravel()
            scene.motion = scene.source.at(scene.times)
            for frame in range(clip.frames):
                self.scenes.append((scene, 3 * frame + 1))
            for frame in range(1, len(scene.times), 15):
                points.append(scene.mesh(frame)[0][::24])

        # Cameras that see the person in all clips. Two stand before the person: opposite ones
        # would not show where a point is between them.
        stand = front if settings.cameras == 2 else ring
        views = stand(scene_settings, np.concatenate(points))
        names = [f"cam{k + 1:02d}" for k in range(settings.cameras)]
        self.views = dict(zip([*names, TEST_CAMERA], views, strict=True))
        self.names = names

    def __len__(self) -> int:
        return len(self.scenes)

    def landmarks(self) -> np.ndarray:
        """``[F, 105, 3]`` metres."""
        points = []
        for scene, frame in self.scenes:
            motion = scene.motion
            vertices, _ = scene._skin(frame)
            points.append(
                scene.character.landmarks(vertices, motion.joints[frame])
            )
        return np.stack(points)


class Room:
    """The image ``[H, W, 3]`` of an empty room in one camera, and the light on its floor."""

    def __init__(self, view: SceneCamera, seed: int) -> None:
        rng = np.random.default_rng(seed)
        H, W = view.size

        # Where the ray of each pixel meets the floor, or a wall.
        y, x = np.mgrid[:H, :W] + 0.5
        rays = np.stack([x, y, np.ones_like(x)], axis=-1)
        rays = rays @ np.linalg.inv(view.K).T @ view.R
        depth = view.centre[2] / np.maximum(-rays[..., 2], 1e-3)
        floor = view.centre + depth[..., None] * rays
        self.on_floor = np.linalg.norm(floor[..., :2], axis=-1) < WALL_DISTANCE
        self.points = floor

        # A wall with furniture, and boards or a carpet on the floor.
        image = np.linspace(165, 120, H)[:, None, None] * rng.uniform(
            0.9, 1.05, 3
        )
        image = np.broadcast_to(image, (H, W, 3)).copy()
        for _ in range(16):
            left, top = rng.integers(0, W), rng.integers(0, H)
            width, height = rng.integers(W // 25, W // 4, 2)
            colour = rng.uniform(25, 225) * rng.uniform(0.85, 1.15, 3)
            thickness = -1 if rng.random() < 0.6 else 3
            corner = (int(left + width), int(top + height))
            cv2.rectangle(
                image, (int(left), int(top)), corner, colour.tolist(), thickness
            )
        boards = 14 * np.sign(np.sin(floor[..., 0] * rng.uniform(20, 60)))
        grain = cv2.resize(rng.normal(0, 8, (H // 4, W // 4)), (W, H))
        carpet = rng.uniform(70, 150) * rng.uniform(0.8, 1.2, 3)
        ground = carpet + (boards + grain)[..., None]
        image = np.where(self.on_floor[..., None], ground, image)
        self.image = cv2.GaussianBlur(np.clip(image, 5, 250), (0, 0), 0.9)

    def shaded(self, person) -> np.ndarray:
        """The room with the person's shadow on the floor."""
        # The pixels of the floor near the person, a quarter of them.
        part = self.points[::2, ::2]
        near = np.linalg.norm(
            part[..., :2] - person.vertices[:, :2].mean(0), axis=-1
        )
        y, x = np.nonzero(self.on_floor[::2, ::2] & (near < 3.0))
        start = part[y, x].repeat(SHADOW_RAYS, axis=0).astype(np.float32)
        start[:, 2] += 0.002
        disc = np.random.default_rng(0).uniform(-1, 1, (SHADOW_RAYS, 2))
        disc = np.tile(disc, (len(y), 1)) * person.light.spread
        towards = person._sun_directions(disc.astype(np.float32))
        lit = ~person.tracer.is_blocked(start, towards)
        light = np.ones(part.shape[:2], np.float32)
        share = lit.reshape(-1, SHADOW_RAYS).mean(1)
        light[y, x] = SKY_LIGHT + (1 - SKY_LIGHT) * share
        light = cv2.resize(light, self.image.shape[1::-1])
        return self.image * light[..., None]


def trace(film: Film, truth: Path, source: Path, part: int, parts: int) -> None:
    """Traces every ``parts``-th frame: the true images, and lossless ones of the film."""
    rooms = {
        name: Room(view, k) for k, (name, view) in enumerate(film.views.items())
    }
    for f in range(part, len(film), parts):
        scene, middle = film.scenes[f]
        last = source / film.names[-1] / f"{f:06d}.png"
        if last.is_file():
            continue
        people = [scene.pose(middle + k) for k in (-1, 0, 1)]
        for name, view in [*film.views.items()][::-1]:
            # The truth is sharp.
            image, alpha, _ = people[1].render(view, 16)
            bgr = np.round(255 * image[..., ::-1]).astype(np.uint8)
            mask = np.round(255 * alpha).astype(np.uint8)
            write_png(truth / "images" / name / f"{f:06d}.png", bgr)
            write_png(truth / "masks" / name / f"{f:06d}.png", mask)
            if name == TEST_CAMERA:
                continue

            # The film has the mean of the shutter's opening.
            images = [255 * image]
            alphas = [alpha]
            for person in (people[0], people[2]):
                blurred, covered, _ = person.render(view, BLUR_RAYS)
                images.append(255 * blurred)
                alphas.append(covered)
            mean = np.mean(images, axis=0)
            free = 1 - np.mean(alphas, axis=0)[..., None]
            shown = mean + free * rooms[name].shaded(people[1])
            bgr = np.clip(shown + 0.5, 0, 255).astype(np.uint8)[..., ::-1]
            write_png(source / name / f"{f:06d}.png", bgr)


def write_png(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.ascontiguousarray(image))


def write_truth(film: Film, truth: Path) -> None:
    """Landmarks, cameras and metadata of the truth."""
    p = film.landmarks().astype(np.float32)
    ids = np.arange(len(p))
    names = np.array(joint_names())
    for name, joints in (
        ("landmarks3d", slice(BODY)),
        ("hands3d", HANDS),
        ("face3d", FACE),
    ):
        write_npz(
            truth / f"{name}.npz",
            p=p[:, joints],
            conf=np.ones(p[:, joints].shape[:2], np.float32),
            frame_id=ids,
            names=names[joints],
        )
    cameras = {name: calibration(view) for name, view in film.views.items()}
    write_json(truth / "cameras.json", cameras)
    meta = {
        "fps": film.fps,
        "unit": "m",
        "up_axis": "z",
        "skeleton": "mediapipe33",
        "pixel_centre": 0.5,
        "background": "black",
        "splits": {
            "train_cameras": film.names,
            "test_cameras": [TEST_CAMERA],
            "train_frames": [f for f in ids.tolist() if not is_test(f)],
            "test_frames": [f for f in ids.tolist() if is_test(f)],
        },
    }
    write_json(truth / "meta.json", meta)


def is_test(frame: int) -> bool:
    return frame % PERIOD >= PERIOD - HELD_OUT


def write_videos(film: Film, frames: Path, source: Path) -> None:
    """The films as H.264 in 4:2:0, and their exact calibration."""
    # Exposure and white balance of each camera; their means change nothing, as no method could
    # know a change that all cameras share.
    source.mkdir(parents=True)
    rng = np.random.default_rng(0)
    gains = rng.normal(0, 0.05, (len(film.names), 1))
    gains = gains + rng.normal(0, 0.02, (len(film.names), 3))
    gains = np.exp(gains - gains.mean(0))
    gammas = rng.normal(0, 0.03, len(film.names))
    gammas = np.exp(gammas - gammas.mean())
    for name, gain, gamma in zip(film.names, gains, gammas, strict=True):
        with av.open(str(source / f"{name}.mp4"), "w") as container:
            stream = container.add_stream("libx264", rate=Fraction(film.fps))
            stream.height, stream.width = film.views[name].size
            stream.pix_fmt = "yuv420p"
            stream.options = {"crf": QUALITY}
            for f in range(len(film)):
                image = cv2.imread(str(frames / name / f"{f:06d}.png"))
                image = 255 * (image / 255) ** gamma * gain
                image = image + rng.normal(0, NOISE, image.shape)
                image = np.clip(image + 0.5, 0, 255).astype(np.uint8)
                container.mux(
                    stream.encode(av.VideoFrame.from_ndarray(image, "bgr24"))
                )
            container.mux(stream.encode())
    cameras = {name: calibration(film.views[name]) for name in film.names}
    write_json(source / "cameras.json", cameras)


# -- errors


def read_points(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Frame numbers ``[F]`` and joints ``[F, 105, 3]`` of a capture; NaN = missing."""
    parts = []
    for name in ("landmarks3d", "hands3d", "face3d"):
        with np.load(folder / f"{name}.npz") as arrays:
            parts.append(arrays["p"].astype(np.float64))
            frames = arrays["frame_id"]
    return frames, np.concatenate(parts, axis=1)


def landmark_errors(truth: Path, prepared: Path) -> dict[str, object]:
    """Errors of the prepared joints, millimetres, and frames with exchanged sides."""
    _, true = read_points(truth)
    frames, found = read_points(prepared)
    true = true[frames]

    # A group is exchanged where its pairs fit better the other way.
    exchanged = {}
    groups = {
        "head": HEAD_PAIRS,
        "arms": ARM_PAIRS,
        "legs": LEG_PAIRS,
        "hands": HAND_PAIRS,
    }
    for name, pairs in groups.items():
        left, right = np.array(pairs).T
        joints = np.r_[left, right]
        opposite = np.r_[right, left]
        kept = np.linalg.norm(true[:, joints] - found[:, joints], axis=-1)
        other = np.linalg.norm(true[:, joints] - found[:, opposite], axis=-1)
        wrong = np.nanmedian(other, axis=1) < np.nanmedian(kept, axis=1)
        exchanged[name] = int(wrong.sum())

    # The offset of each joint is in the axes of the trunk, which turns.
    numbers: dict[str, object] = {"exchanged": exchanged}
    parts = {"body": slice(BODY), "hands": HANDS, "face": FACE}
    axes = trunk_axes(true)
    for name, joints in parts.items():
        error = found[:, joints] - true[:, joints]
        local = np.einsum("fij,fkj->fki", axes, error)
        noise = local - np.nanmean(local, axis=0)
        distance = 1000 * np.linalg.norm(error, axis=-1)
        about = 1000 * np.linalg.norm(noise, axis=-1)
        world = error - np.nanmean(error, axis=0)
        numbers[name] = {
            "median": np.nanmedian(distance),
            "90 %": np.nanpercentile(distance, 90),
            "offset": np.nanmedian(
                1000 * np.linalg.norm(np.nanmean(local, axis=0), axis=-1)
            ),
            "noise": np.nanmedian(about),
            "noise 90 %": np.nanpercentile(about, 90),
            "noise in the world": np.nanmedian(
                1000 * np.linalg.norm(world, axis=-1)
            ),
            "missing": np.isnan(distance).mean(),
        }
        if name == "body":
            by_joint = np.nanmedian(distance, axis=0)
            numbers["joints"] = dict(
                zip(MEDIAPIPE33.names, by_joint.round(1).tolist(), strict=True)
            )
    return numbers


def trunk_axes(p: np.ndarray) -> np.ndarray:
    """Axes ``[F, 3, 3]`` by rows of the trunk: to the left, up and ahead."""
    left = p[:, 11] + p[:, 23] - p[:, 12] - p[:, 24]
    up = p[:, 11] + p[:, 12] - p[:, 23] - p[:, 24]
    left = left / np.linalg.norm(left, axis=-1, keepdims=True)
    ahead = np.cross(left, up)
    ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
    return np.stack([left, np.cross(ahead, left), ahead], axis=1)


def camera_errors(truth: Path, prepared: Path) -> float:
    """Pixels RMS between true and prepared cameras, after the best similarity of the world."""
    true = json.loads((truth / "cameras.json").read_text())
    found = json.loads((prepared / "cameras.json").read_text())
    _, p = read_points(truth)
    p = p[::6, :BODY].reshape(-1, 3)
    middle = p.mean(0)

    def project(camera: dict, points: np.ndarray) -> np.ndarray:
        K, R, t = (np.array(camera[key]) for key in ("K", "R", "t"))
        x = (points @ R.T + t) @ K.T
        return x[:, :2] / x[:, 2:]

    def residuals(w: np.ndarray) -> np.ndarray:
        turn = Rotation.from_rotvec(w[:3]).as_matrix()
        moved = np.exp(w[6]) * (p - middle) @ turn.T + middle + w[3:6]
        parts = []
        for name, camera in found.items():
            parts.append(project(camera, moved) - project(true[name], p))
        return np.concatenate(parts).ravel()

    rest = least_squares(residuals, np.zeros(7)).fun.reshape(-1, 2)
    return float(np.sqrt((rest**2).sum(-1).mean()))


def mask_errors(truth: Path, prepared: Path) -> dict[str, float]:
    """IoU of the masks, pixels by which their outlines are off, and mean error of alpha there."""
    ious = []
    away = []
    alphas = []
    for path in sorted((prepared / "masks").glob("*/*.png")):
        mask = cv2.imread(str(path), 0) / 255
        true = cv2.imread(str(truth / path.relative_to(prepared)), 0) / 255
        inside = mask > 0.5
        solid = true > 0.5
        ious.append((inside & solid).sum() / max((inside | solid).sum(), 1))

        # Distances between the outlines, where alpha is a half.
        expected = outline(true)
        distance, _ = KDTree(expected).query(outline(mask))
        away.append(distance)
        near = cv2.dilate(solid.astype(np.uint8), np.ones((9, 9))) > 0
        near &= cv2.erode(solid.astype(np.uint8), np.ones((9, 9))) == 0
        alphas.append(np.abs(mask - true)[near].mean())
    distances = np.concatenate(away)
    return {
        "IoU": float(np.mean(ious)),
        "outline": float(np.median(distances)),
        "outline 90 %": float(np.percentile(distances, 90)),
        "alpha in the band": float(np.mean(alphas)),
    }


def outline(alpha: np.ndarray) -> np.ndarray:
    """Points ``[N, 2]`` along the line where alpha is a half, dense."""
    points = [np.zeros((0, 2))]
    for line in contour_generator(z=alpha).lines(0.5):
        for share in np.arange(0, 1, 0.2):
            points.append(line[:-1] + share * np.diff(line, axis=0))
    return np.concatenate(points)


# -- the ladder


def mix(truth: Path, prepared: Path, out: Path, rung: str) -> None:
    """A capture with what the rung names from ``prepared``; test images are always true."""
    if (out / "meta.json").is_file():
        return
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    joints = rung in ("landmarks", "both")
    pixels = rung in ("masks", "both")

    # Joints and cameras; the test camera is always the true one.
    given = prepared if joints else truth
    for name in ("landmarks3d.npz", "hands3d.npz", "face3d.npz"):
        shutil.copy(given / name, out / name)
    cameras = json.loads((given / "cameras.json").read_text())
    true = json.loads((truth / "cameras.json").read_text())
    write_json(out / "cameras.json", true | cameras)

    # Images and masks.
    for kind in ("images", "masks"):
        for path in sorted((truth / kind).glob("*/*.png")):
            frame = int(path.stem)
            target = out / kind / path.parent.name / path.name
            target.parent.mkdir(parents=True, exist_ok=True)
            tested = path.parent.name == TEST_CAMERA or is_test(frame)
            if tested or not pixels:
                os.link(path, target)
                continue
            found = prepared / kind / path.parent.name
            matches = list(found.glob(f"{path.stem}.*"))
            if not matches:
                continue
            image = cv2.imread(str(matches[0]), cv2.IMREAD_UNCHANGED)
            if kind == "images":
                # Premultiplied, as the true ones.
                mask = found.parents[1] / "masks" / found.name / path.name
                alpha = cv2.imread(str(mask), 0)[..., None] / 255
                image = np.round(image * alpha).astype(np.uint8)
            cv2.imwrite(str(target), image)
    shutil.copy(truth / "meta.json", out / "meta.json")


def train(data: Path, run: Path, overrides: list[str]) -> dict[str, float]:
    """Trains an avatar and returns its scores."""
    done = run / "metrics.json"
    if not done.is_file():
        command = [
            sys.executable,
            "-m",
            "gsgan.train",
            "data=capture",
            f"data.root={data}",
            f"hydra.run.dir={run}",
            *overrides,
        ]
        with run.with_suffix(".log").open("w") as log:
            subprocess.run(command, check=True, stdout=log, stderr=log)
    scores = json.loads(done.read_text())
    row = {}
    for split in ("novel_pose", "novel_view"):
        variants = scores[split]
        for key in ("psnr", "lpips_alex", "psnr_hands", "energy"):
            for values in variants.values():
                if isinstance(values, dict) and key in values:
                    row[f"{split} {key}"] = values[key]
                    break
    return row


def run(config: DictConfig, console: Console) -> None:
    """All steps of a film."""
    root = Path(config.folder).absolute() / config.film
    truth = root / "truth"
    frames = root / "frames"
    source = root / "source"
    prepared = Path(config.prepared or root / "prepared").absolute()
    film_settings = config.films[config.film]

    # The film, traced by several processes.
    if not (source / "cameras.json").is_file():
        if config.part is None:
            command = [sys.executable, __file__, *sys.argv[1:]]
            workers = []
            for k in range(config.workers):
                environment = {**os.environ, "OMP_NUM_THREADS": "1"}
                workers.append(
                    subprocess.Popen([*command, f"part={k}"], env=environment)
                )
            if any(worker.wait() for worker in workers):
                raise SystemExit("a process that traces the film has failed")
        film = Film(film_settings)
        if config.part is not None:
            cv2.setNumThreads(1)
            trace(film, truth, frames, config.part, config.workers)
            return
        write_truth(film, truth)
        shutil.rmtree(source, ignore_errors=True)
        write_videos(film, frames, source)

    # The front door.
    if not (prepared / "meta.json").is_file():
        begun = time.monotonic()
        command = [
            sys.executable,
            "-m",
            "gsgan.prepare",
            f"source={source}",
            f"out={prepared}",
            "setup=true",
            *config.prepare,
        ]
        subprocess.run(command, check=True)
        write_json(
            prepared.with_suffix(".seconds.json"), time.monotonic() - begun
        )

    # Errors.
    numbers = landmark_errors(truth, prepared)
    numbers["cameras, pixels"] = camera_errors(truth, prepared)
    numbers["masks"] = mask_errors(truth, prepared)
    write_json(prepared.with_suffix(".errors.json"), numbers)
    console.print_json(data=json.loads(json.dumps(numbers, default=float)))

    # The ladder.
    rows = {}
    for rung in config.rungs:
        data = root / "ladder" / rung
        folder = root / "runs" / rung
        folder.parent.mkdir(parents=True, exist_ok=True)
        mix(truth, prepared, data, rung)
        rows[rung] = train(data, folder, list(config.train))
        console.print(pd.DataFrame(rows).T.round(4).to_string())


def main() -> None:
    config = OmegaConf.merge(
        OmegaConf.load(SETTINGS), OmegaConf.from_cli(sys.argv[1:])
    )
    run(config, Console(soft_wrap=True))


if __name__ == "__main__":
    main()
