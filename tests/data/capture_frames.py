"""Reads whole captures, and writes PNGs of any kind, for the tests of the reader."""

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from writers.smpl import posed

from gsgan.body.smpl_names import CIHP
from gsgan.data.dataset import CaptureDataset
from gsgan.data.formats.capture import SKELETON_LIMITS, read_capture
from gsgan.data.formats.consistency import Consistency
from gsgan.data.formats.smpl_motion import SmplMotion
from gsgan.data.layout import Layout
from gsgan.data.pixels import read_labels, read_mask
from gsgan.scene import Frame
from gsgan.skeleton.smpl_landmarks import to_mediapipe33
from gsgan.utils.image_files import read_colour


def items(layout: Layout) -> list[tuple[str, int]]:
    return [(c, f) for c in layout.cameras for f in sorted(layout.images[c])]


def every_frame(
    root: Path, consistency: Consistency = SKELETON_LIMITS, **kwargs: object
) -> list[Frame]:
    layout = read_capture(root, consistency=consistency)
    dataset = CaptureDataset(layout, items(layout), **kwargs)
    return [dataset[i] for i in range(len(dataset))]


def png(width: int, height: int, depth: int, kind: int, row: bytes) -> bytes:
    def chunk(name: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data))
            + name
            + data
            + struct.pack(">I", crc(name + data))
        )

    crc = zlib.crc32
    head = struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)
    palette = chunk(b"PLTE", bytes(range(6))) if kind == 3 else b""
    data = zlib.compress((b"\0" + row) * height)
    start = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + palette
    return start + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def check_cameras(layout: Layout, cameras: list) -> None:
    """Cameras are read as they were written, but for pixel centres, which are ours at +0.5."""
    for entry, camera in zip(layout.cameras.values(), cameras, strict=True):
        assert np.allclose(
            entry.K - camera.K, [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], atol=1e-6
        )
        assert np.allclose(entry.R, camera.R, atol=1e-6)
        assert np.allclose(entry.t, camera.t, atol=1e-6)
        assert np.allclose(entry.dist[:5], camera.dist, atol=1e-6)
        assert entry.size == camera.size[::-1]


def check_poses(layout: Layout, subject: Any, blend: bool = True) -> None:
    """theta and transl, in the model's own convention, give the vertices that were written."""
    held = (layout.poses.theta, layout.poses.transl)
    theta, transl = (np.stack([of[f] for f in subject.frames]) for of in held)
    betas = np.repeat(subject.shapes[None], len(theta), 0)
    motion = SmplMotion(np.array(subject.frames), theta, transl, betas)
    assert np.allclose(
        posed(subject.model, motion, blend)[0], subject.vertices, atol=1e-6
    )


def check_skeletons(layout: Layout, subject: Any, kind: str = "smpl") -> None:
    for i, frame in enumerate(subject.frames):
        p, conf = to_mediapipe33(subject.joints[i], subject.vertices[i], kind)
        assert np.allclose(
            layout.landmarks.p[frame][conf > 0], p[conf > 0], atol=1e-5
        )
        assert np.array_equal(layout.landmarks.visibility[frame], conf)
        assert np.isfinite(layout.landmarks.p[frame]).all()


def check_images(layout: Layout, subject: Any) -> None:
    """Colours, masks and labels, but for what a JPEG turns."""
    soft = hasattr(subject, "alphas")
    for i, frame in enumerate(subject.frames):
        for c, name in enumerate(layout.camera_names):
            cover = (
                subject.alphas[i][c]
                if soft
                else 255 * (subject.labels[i][c] > 0)
            )
            mask = read_mask(layout.mask_files(name, frame), layout.pixels)
            clear = np.abs(cover.astype(int) - 127.5) > 12
            assert np.array_equal(
                mask[clear], np.where(cover > 127, 255, 0)[clear]
            )
            assert set(np.unique(mask)) <= {0, 255}
            image = read_colour(layout.image_path(name, frame)).astype(int)
            # chroma of a small JPEG
            assert np.abs(image - subject.images[i][c]).mean() < 12
            if layout.labels:
                found = read_labels(
                    layout.label_path(name, frame), layout.pixels, CIHP
                )
                assert np.array_equal(found, subject.labels[i][c])
