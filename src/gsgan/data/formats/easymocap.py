"""Reader of EasyMocap's folders.

::

    intri.yml  extri.yml         OpenCV YAML, metres, paired by camera name
    images/{camera}/%06d.jpg     mask/{camera}/%06d.png or %06d_{person}.png
    keypoints3d/%06d.json        BODY_25, with hands, with face: also output/keypoints3d
    smpl/%06d.json               SMPL fits: also output/smpl
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from gsgan.data.calibration import read_calibration
from gsgan.data.cameras import CameraEntry
from gsgan.data.checks import Checks
from gsgan.data.files import frame_files, natural_order
from gsgan.data.formats.common import (
    body_model,
    no_joints,
    picture_size,
    up_axis,
    without_frames,
)
from gsgan.data.formats.easymocap_skeleton import read_fits, read_keypoints, read_people
from gsgan.data.formats.smpl_motion import landmarks_of
from gsgan.data.formats.trust import Trust, check_meeting, watch_masks
from gsgan.data.layout import BodyModel, Found, Layout, Meta, assemble, dataset_folder
from gsgan.data.pixels import MASK_RULES, MaskFile, PixelRules, mask_file
from gsgan.data.skeletons import make_landmarks
from gsgan.utils.errors import ConfigError, DataError

CONTENTS = "intri.yml, extri.yml, images/, mask/, and keypoints3d/ or smpl/"
SKELETONS = {"smpl": "smpl24 -> mediapipe33", "keypoints3d": "body25 -> mediapipe33"}
RESULTS = ("{kind}", "output/{kind}", "output-{kind}/{kind}")
PICTURES = (".jpg", ".jpeg", ".png")
MASKS = (".png", ".jpg")
PEOPLE = 1000  # bound on the person's number in a mask's name


@dataclass(frozen=True)
class EasymocapReader:
    """Reads a folder of EasyMocap; every threshold is a setting.

    Args:
        skeleton: "smpl" (fits), "keypoints3d", or "auto" for the first that is there and can be
            used: fits need ``data.smpl``.
        person: whose skeleton, by EasyMocap's id, and whose masks where their names say it.
        masks: folder of the masks, relative to the root.
        mask_rule: what their numbers mean, one of `gsgan.data.pixels.MASK_RULES`.
        threshold: for the rule of that name, and for "nonzero" where masks are JPEGs.
        drop_frames: frames to leave out, e.g. "360-370", or None.
        distance: metres, see `Checks`.
        max_missing_masks: share of pictures without a mask that may be left out.
        header_stride: see `Checks`.
        pixel_centre: where K puts the centre of the first pixel: 0 as OpenCV calibrates.
        fps: pictures a second, or None.
        trust: which pictures are looked at.
    """

    skeleton: str = "auto"
    person: int = 0
    masks: str = "mask"
    mask_rule: str = "nonzero"
    threshold: int = 128
    drop_frames: Any = None
    distance: tuple[float, float] = (0.3, 30.0)
    max_missing_masks: float = 0.05
    header_stride: int = 20
    pixel_centre: float = 0.0
    fps: float | None = None
    trust: Trust = field(default_factory=Trust)

    def __post_init__(self) -> None:
        for key, allowed in (("skeleton", ("auto", *SKELETONS)), ("mask_rule", MASK_RULES)):
            if getattr(self, key) not in allowed:
                raise ConfigError(
                    f"data.reader.{key} must be one of {', '.join(allowed)}, "
                    f"got {getattr(self, key)!r}"
                )

    def __call__(self, root: str | Path, checks: Checks, smpl: str | None = None) -> Layout:
        """Reads and checks everything but most pictures' pixels.

        Args:
            root: the folder that holds intri.yml and images/.
            checks: thresholds of all formats.
            smpl: the user's SMPL model file, for fits.

        Raises:
            DataError: for whatever is missing, damaged or contradictory, naming the file.
        """
        folder = dataset_folder(root, CONTENTS)
        checks = replace(
            checks,
            distance=(self.distance[0], self.distance[1]),
            max_missing_masks=self.max_missing_masks,
            header_stride=self.header_stride,
        )
        found = self._find(folder, checks, smpl)
        layout = assemble(without_frames(found, self.drop_frames), checks)
        doubts = check_meeting(
            layout,
            layout.landmarks.seen,
            self.trust,
            "check that calibration, skeleton and masks are of one recording and one person "
            "(data.reader.person)",
        )
        return replace(layout, notes=(*layout.notes, *doubts, *watch_masks(layout, self.trust)))

    def _find(self, root: Path, checks: Checks, smpl: str | None) -> Found:
        notes: list[str] = []
        names = camera_folders(root)
        images = {name: frame_files(root, f"images/{name}", PICTURES) for name in names}
        if empty := [name for name, files in images.items() if not files]:
            raise DataError(f"{root / 'images' / empty[0]} holds no pictures; expected 000000.jpg")
        cameras = self._cameras(root, images, notes)
        frames = {f for files in images.values() for f in files}
        kind, place = self._source(root, smpl)
        people = read_people(root, place, frames, self.person, notes)
        motion = body = None
        if kind == "smpl":
            given = body_model(smpl, "smpl")
            if given is None:
                raise no_joints(root, f"SMPL parameters ({place}/)", "SMPL (SMPL_NEUTRAL.pkl)")
            motion = read_fits(people, given[1], notes)
            body = BodyModel("smpl", str(given[0]), tuple(motion.betas[0].tolist()))
            ids, (p, conf) = motion.ids, landmarks_of(given[1], motion)
        else:
            ids, p, conf = read_keypoints(people)
        return Found(
            root=root,
            meta=Meta(
                fps=self.fps,
                up_axis=up_axis(cameras.values()),
                skeleton_source=SKELETONS[kind],
                body=body,
                layout="EasyMocap",
            ),
            cameras=cameras,
            images=images,
            masks=self._masks(root, names),
            mask_folders={name: root / self.masks / name for name in names},
            labels={},
            landmarks=make_landmarks(ids, p, conf, checks.max_reach, notes, source=f"{place}/"),
            poses=None if motion is None else motion.poses(f"{place}/"),
            pixels=PixelRules(threshold=self.threshold),
            calibration=root / "intri.yml and extri.yml",
            unit_hint=f"T in {root / 'extri.yml'} and {root / place} must be in metres",
            notes=tuple(notes),
        )

    def _source(self, root: Path, smpl: str | None) -> tuple[str, str]:
        """Which skeletons to use, and the folder that holds them."""
        places = {}
        for kind in SKELETONS if self.skeleton == "auto" else (self.skeleton,):
            folders = [pattern.format(kind=kind) for pattern in RESULTS]
            if there := [folder for folder in folders if (root / folder).is_dir()]:
                places[kind] = there[0]
        if not places:
            wanted = "keypoints3d/ or smpl/" if self.skeleton == "auto" else f"{self.skeleton}/"
            raise DataError(
                f"{root} has no skeletons; expected {wanted} in it, or in output/: run EasyMocap's "
                "reconstruction first"
            )
        usable = [kind for kind in places if kind != "smpl" or smpl is not None]
        kind = (usable or list(places))[0]
        return kind, places[kind]

    def _cameras(
        self, root: Path, images: Mapping[str, Mapping[int, str]], notes: list[str]
    ) -> dict[str, CameraEntry]:
        """The cameras that took pictures, by name, in natural order."""
        path = root / "intri.yml"
        calibration = read_calibration(path, pixel_centre=self.pixel_centre)
        notes += calibration.notes
        known = calibration.cameras
        if lacking := [name for name in images if name not in known]:
            raise DataError(
                f"{root / 'images' / lacking[0]} is no camera of {path}, which lists "
                f"{', '.join(known)}; cameras are paired by name: rename the folder or calibrate it"
            )
        if idle := [name for name in known if name not in images]:
            notes.append(f"{path} lists cameras without pictures, left out: {', '.join(idle)}")
        return {
            name: known[name]
            if min(known[name].size) > 0
            else replace(known[name], size=picture_size(root, images[name]))
            for name in images
        }

    def _masks(self, root: Path, names: list[str]) -> dict[str, dict[int, tuple[MaskFile, ...]]]:
        """By camera and frame; the person's own where names say whose they are."""
        if not (root / self.masks).is_dir():
            raise DataError(
                f"{root / self.masks} does not exist; every picture needs a mask, expected "
                f"{self.masks}/<camera>/000000.png (data.reader.masks names the folder)"
            )
        found = {}
        for name in names:
            files = frame_files(root, f"{self.masks}/{name}", MASKS, _frame_and_person)
            own: dict[int, tuple[MaskFile, ...]] = {}
            for key, path in sorted(files.items()):  # a mask of nobody in particular comes first
                frame, whose = divmod(key, PEOPLE)
                if whose in (0, self.person + 1):
                    own[frame] = (mask_file(self.mask_rule, path),)
            found[name] = own
        return found


def camera_folders(root: Path) -> list[str]:
    """Names of the cameras that have a folder of pictures, in natural order.

    Raises:
        DataError: when there is none.
    """
    for name in ("intri.yml", "extri.yml"):
        if not (root / name).is_file():
            raise DataError(f"{root / name} does not exist; a folder of EasyMocap holds {CONTENTS}")
    place = root / "images"
    names = [p.name for p in place.glob("*") if p.is_dir() and not p.name.startswith(".")]
    if not names:
        hint = "extract the frames of videos/" if (root / "videos").is_dir() else "copy it whole"
        raise DataError(
            f"{place} holds no camera's folder; a folder of EasyMocap holds {CONTENTS}: {hint}"
        )
    return sorted(names, key=natural_order)


def _frame_and_person(stem: str) -> int | None:
    """One number of both: "000012_1" is frame 12 of person 1, "000012" is nobody's."""
    match = re.fullmatch(r"(\d+)(?:_(\d{1,2}))?", stem)
    if match is None:
        return None
    return int(match[1]) * PEOPLE + (int(match[2]) + 1 if match[2] else 0)
