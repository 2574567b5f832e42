"""An avatar of one video against the truth: the default person, or a rigged character.

    python scripts/bench/one_camera.py --avatar blouse --landmarks noise --folder build/one
    python scripts/bench/one_camera.py --video cam01.mp4 --rig /path/to/capture --folder build/real

Traces the person from four sides. The first is the video: its image is padded until the
principal point is its centre, as a phone's is, and set before a wall; focal length and height are
not given to `gsgan.prepare`. Landmarks are ``exact`` or ``noise`` (0.5 % of the person's size, 5 %
of landmarks and 3 % of frames missing) with a detector's depth, both with true masks, or
``mediapipe``'s with its masks. The other cameras are moved into the estimated world by a similarity
and join the capture, on which an avatar is trained from the video alone. With ``--video`` the
truth is a capture of several real cameras instead, one of which, of the video's name, took the
video; landmarks and masks are MediaPipe's. Scores are given three times: with the skeletons that
were estimated from the video as they are; with the same, each frame aligned with the truth by a
rigid motion; and with the true ones, moved into the estimated world. Further words
are overrides of `gsgan.train`. Finished steps are kept: the same command continues.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np

sys.path.insert(
    0, str(Path(__file__).resolve().parents[2] / "tests" / "prepare")
)
from one_person import world_landmarks

from gsgan.synthetic.scenes import ensure_scene

LARGER = 3  # the video's pixels per pixel of the traced image
NOISE, LOST, EMPTY = (
    0.005,
    0.05,
    0.03,
)  # shares of the person's size, landmarks, frames
NAME = "me"


def project(camera, p):
    """Pixels ``[…, 2]`` and camera axes ``[…, 3]`` of points in the world."""
    own = p @ camera.R.T + camera.t
    return own[..., :2] / own[..., 2:] @ camera.K[:2, :2].T + camera.K[
        :2, 2
    ], own


def read_cameras(folder: Path) -> dict[str, SimpleNamespace]:
    """K, R, t of every camera of a capture."""
    raw = json.loads((folder / "cameras.json").read_text())
    return {
        name: SimpleNamespace(
            **{k: np.array(entry[k]) for k in ("K", "R", "t")}
        )
        for name, entry in raw.items()
    }


def film(scene: Path, folder: Path, landmarks: str) -> SimpleNamespace:
    """The video with landmarks and masks, and its camera."""
    name, camera = next(iter(read_cameras(scene).items()))
    images = sorted((scene / "images" / name).iterdir())
    size = np.array(cv2.imread(str(images[0])).shape[1::-1])
    half = np.ceil(np.maximum(camera.K[:2, 2], size - camera.K[:2, 2])).astype(
        int
    )
    corner = np.round(half - camera.K[:2, 2]).astype(int)
    camera.K[:2, 2] += corner
    camera.K[:2] *= LARGER
    whole = tuple((2 * half * LARGER).tolist())
    (folder / "masks" / NAME).mkdir(parents=True, exist_ok=True)
    fps = json.loads((scene / "meta.json").read_text())["fps"]
    video = cv2.VideoWriter(
        str(folder / f"{NAME}.avi"), cv2.VideoWriter_fourcc(*"MJPG"), fps, whole
    )
    video.set(cv2.VIDEOWRITER_PROP_QUALITY, 98)
    wall = np.random.default_rng(0).integers(150, 190, (96, 96, 3), np.uint8)
    wall = cv2.resize(wall, whole, interpolation=cv2.INTER_CUBIC)
    for path in images:
        pair = []
        for kind in ("images", "masks"):
            small = cv2.imread(str(scene / kind / name / path.name))
            padded = np.zeros((2 * half[1], 2 * half[0], 3), np.uint8)
            padded[corner[1] :, corner[0] :][: size[1], : size[0]] = small
            pair.append(
                cv2.resize(padded, whole, interpolation=cv2.INTER_CUBIC)
            )
        image, mask = pair
        video.write(
            np.clip(image + wall * (1 - mask / 255.0), 0, 255).astype(np.uint8)
        )
        cv2.imwrite(str(folder / "masks" / NAME / path.name), mask[..., 0])
    video.release()
    if landmarks != "mediapipe":
        px, own = project(camera, np.load(scene / "landmarks3d.npz")["p"])
        rng, conf = np.random.default_rng(1), np.ones(px.shape[:2])
        if landmarks == "noise":
            tall = np.ptp(px[..., 1], axis=1)[:, None, None]
            px = px + rng.normal(0, NOISE, px.shape) * tall
            conf[rng.random(conf.shape) < LOST] = 0
            conf[rng.random(len(conf)) < EMPTY] = 0
        (folder / "landmarks").mkdir(exist_ok=True)
        number, world = np.arange(len(px)), world_landmarks(own)
        faces = np.ones(len(px), int)
        arrays = {
            "px": px,
            "conf": conf,
            "frame_id": number,
            "world": world,
            "faces": faces,
        }
        np.savez(folder / "landmarks" / f"{NAME}.npz", **arrays)
    return camera


def similarity(p, truth, scaled: bool):
    """``s, A, b``: s A p + b is nearest to the truth."""
    a, b = p - p.mean(0), truth - truth.mean(0)
    U, S, V = np.linalg.svd(b.T @ a)
    sign = np.array([1, 1, np.linalg.det(U @ V)])
    A, s = U * sign @ V, (S * sign).sum() / (a**2).sum() if scaled else 1.0
    return s, A, truth.mean(0) - s * A @ p.mean(0)


def join(
    scene: Path, capture: Path, folder: Path, own: str, camera: SimpleNamespace
) -> list[int]:
    """The capture with the scene's cameras but the video's in its world; returns its frames.

    Beside it, ``aligned`` has its landmarks after a rigid motion of each frame towards the truth,
    and ``true`` has the scene's.
    """
    found = dict(np.load(capture / "landmarks3d.npz"))
    frames = found["frame_id"]
    p, truth = (
        found["p"][:, :33],
        np.load(scene / "landmarks3d.npz")["p"][frames, :33],
    )
    seen = np.isfinite(p + truth).all(-1)
    for scaled in (False, True):
        s, A, b = similarity(p[seen], truth[seen], scaled)
        error = 1000 * np.linalg.norm(
            s * p[seen] @ A.T + b - truth[seen], axis=-1
        )
        print(
            f"landmarks, {'with scale' if scaled else 'rigid'}: {np.median(error):.1f} mm"
        )
    focal = read_cameras(capture)[NAME].K[0, 0] / camera.K[0, 0]
    print(
        f"focal length: {100 * (focal - 1):+.1f} %; {len(frames)} frames; scale {s:.3f}"
    )
    aligned, true = folder.with_name("aligned"), folder.with_name("true")
    for old in (folder, aligned, true):
        shutil.rmtree(old, ignore_errors=True)
    shutil.copytree(capture, folder)
    cameras = json.loads((folder / "cameras.json").read_text())
    raw = json.loads((scene / "cameras.json").read_text())
    for name in [other for other in raw if other != own]:
        R, t = np.array(raw[name]["R"]), np.array(raw[name]["t"])
        raw[name] |= {"R": (R @ A).tolist(), "t": ((R @ b + t) / s).tolist()}
        cameras[name] = raw[name]
        for kind in ("images", "masks"):
            (folder / kind / name).mkdir()
            for path in sorted((scene / kind / name).iterdir()):
                if int(path.stem) in frames:
                    shutil.copy(path, folder / kind / name)
    (folder / "cameras.json").write_text(json.dumps(cameras))
    moved = (truth - b) @ A / s
    for own_p, known, goal in zip(found["p"], seen, moved, strict=True):
        if known.sum() > 2:
            _, turn, shift = similarity(own_p[:33][known], goal[known], False)
            own_p[:] = own_p @ turn.T + shift
    shutil.copytree(folder, aligned)
    np.savez(aligned / "landmarks3d.npz", **found)
    shutil.copytree(folder, true)
    found["p"][:, :33] = moved
    np.savez(true / "landmarks3d.npz", **found)
    return frames.tolist()


def show(metrics: Path, how: str) -> None:
    """Prints a run's dB, in images and in the box."""
    for split, variants in json.loads(metrics.read_text()).items():
        for variant, scores in (
            variants.items() if isinstance(variants, dict) else ()
        ):
            if isinstance(scores, dict) and scores.get("psnr_person"):
                dB = f"{scores['psnr']:.2f} dB, box {scores['psnr_person']:.2f}"
                print(f"{split} {variant}, {how}: {dB}")


def run(*words: str) -> None:
    """A command of gsgan."""
    subprocess.run([sys.executable, "-m", *words], check=True)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--avatar", default="polo")
    parser.add_argument("--motion", default="choreography")
    parser.add_argument(
        "--landmarks", default="exact", choices=("exact", "noise", "mediapipe")
    )
    parser.add_argument("--frames", type=int, default=168)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--rays", type=int, default=4)
    parser.add_argument("--video", type=Path)
    parser.add_argument("--rig", type=Path)
    parser.add_argument("--folder", type=Path, required=True)
    given, overrides = parser.parse_known_args()
    folder, began = given.folder.resolve(), time.monotonic()
    folder.mkdir(parents=True, exist_ok=True)
    if given.video:
        scene, name, given.landmarks = given.rig, given.video.stem, "mediapipe"
        camera = read_cameras(scene)[name]
        width = cv2.VideoCapture(str(given.video)).get(cv2.CAP_PROP_FRAME_WIDTH)
        camera.K[:2] *= (
            width
            / json.loads((scene / "cameras.json").read_text())[name]["size"][0]
        )
        video = folder / f"{NAME}{given.video.suffix}"
        shutil.copyfile(given.video, video)
    else:
        scene = ensure_scene(
            avatar=given.avatar,
            motion=given.motion,
            size=given.size,
            frames=given.frames,
            test_frames=given.frames // 4,
            train_cameras=2,
            test_cameras=2,
            rays_per_pixel=given.rays,
        )
        name = next(iter(read_cameras(scene)))
        video, camera = (
            folder / f"{NAME}.avi",
            film(scene, folder, given.landmarks),
        )
    capture = folder / "capture"
    if not (capture / "prepare.json").is_file():
        own = [
            f"landmarks={folder}/landmarks",
            f"masks={folder}/masks",
            "hands=false",
        ]
        noise = (
            f"landmark_noise={0.001 if given.landmarks == 'exact' else NOISE}"
        )
        detector = (
            [*own, noise] if given.landmarks != "mediapipe" else ["setup=true"]
        )
        run("gsgan.prepare", f"source={video}", f"out={capture}", *detector)
    prepared = time.monotonic()
    frames = join(scene, capture, folder / "joined", name, camera)
    held = (
        json.loads((scene / "meta.json").read_text())
        .get("splits", {})
        .get("test_frames")
    )
    held = [f for f in held if f in frames] if held else frames[2::4]
    others = list(read_cameras(folder / "joined"))[1:]
    splits = [
        f"data.train_cameras=[{NAME}]",
        f"data.test_cameras=[{','.join(others)}]",
    ]
    splits.append(f"data.test_frames=[{','.join(map(str, held))}]")
    where = [f"data.root={folder}/joined", f"hydra.run.dir={folder}/run"]
    run("gsgan.train", "experiment=one_camera", *where, *splits, *overrides)
    same = [word.replace("data.", "+other_capture.") for word in splits]
    show(folder / "run" / "metrics.json", "estimated skeletons, as they are")
    for kind in ("aligned", "true"):
        other = f"+other_capture.root={folder}/{kind}"
        run("gsgan.evaluate", f"run={folder}/run", other, *same)
        metrics = folder / "run" / "on" / kind / "metrics.json"
        show(metrics, f"{kind} skeletons")
    print(
        f"prepare {(prepared - began) / 60:.1f} min, train and score "
        f"{(time.monotonic() - prepared) / 60:.1f} min"
    )


if __name__ == "__main__":
    main()
