"""Reader of ZJU-MoCap in each of the layouts it is found in, told apart by their files.

::

    original   annots.npy  Camera_B1/000000.jpg  mask/ mask_cihp/  new_params/ or params/
    refined    annots.npy  images/00/000000.jpg  mask/00/          smpl_params/
    HumanNeRF  cameras.pkl  mesh_infos.pkl  images/frame_000000.png  masks/
    ARAH       cam_params.json  1/000000.{jpg,png}  models/000000.npz

Subjects 313 and 315 of the original release have 21 cameras (``Camera (1)``, no 20 and 21), long
file names, frames that count from 1 and nested lists in annots.npy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsgan.body.smpl import SkinnedModel
from gsgan.body.smpl_names import CIHP
from gsgan.data.checks import Checks
from gsgan.data.files import frame_files
from gsgan.data.formats import zju_annots, zju_caches, zju_params
from gsgan.data.formats.common import body_model, no_joints, up_axis, without_frames
from gsgan.data.formats.smpl_motion import Motion, landmarks_of, posed
from gsgan.data.formats.trust import Trust, check_meeting, highest_label, spread, watch_masks
from gsgan.data.layout import (
    BodyModel,
    Found,
    Layout,
    Meta,
    assemble,
    dataset_folder,
)
from gsgan.data.pixels import MaskFile, PixelRules, mask_file
from gsgan.data.skeletons import make_landmarks
from gsgan.utils.errors import ConfigError, DataError

Float = NDArray[np.float64]

EXPECTED = "a ZJU-MoCap subject (annots.npy and camera folders, or a HumanNeRF or ARAH cache of it)"
MASKS = {"mask_cihp": "label", "mask": "nonzero"}
MASK_SUFFIXES = (".png", ".jpg")
MIXED = (
    "check that cameras, SMPL parameters and masks come from one release (the refined my_* ones "
    "do not fit CoreView pictures)"
)


@dataclass(frozen=True)
class ZjuReader:
    """Reads a ZJU-MoCap subject; every threshold is a setting.

    Args:
        masks: "both" joins mask_cihp and mask where both are there, or only one of them by name.
        fit: "refit" (new_params), "refined" (smpl_params), "first" (params), or "auto" for the
            first of these that is there.
        ignore_band: pixels, side of the square that widens the mask's outline into a band of
            labels to ignore; 0 leaves it out.
        drop_frames: frames to leave out, e.g. "360-370", or None.
        distance: metres, see `Checks`.
        translation: metres, least and greatest median length of the cameras' T.
        max_missing_masks: share of pictures without a mask that may be left out.
        header_stride: see `Checks`.
        pixel_centre: where K puts the centre of the first pixel: 0 as OpenCV calibrates.
        max_vertex_error: metres, mean distance allowed between stored and posed vertices.
        trust: which pictures are looked at.
    """

    masks: str = "both"
    fit: str = "auto"
    ignore_band: int = 5
    drop_frames: Any = None
    distance: tuple[float, float] = (0.5, 20.0)
    translation: tuple[float, float] = (0.05, 20.0)
    max_missing_masks: float = 0.5
    header_stride: int = 20
    pixel_centre: float = 0.0
    max_vertex_error: float = 0.01
    trust: Trust = field(default_factory=Trust)

    def __post_init__(self) -> None:
        if self.masks not in ("both", *MASKS):
            raise ConfigError(
                f"data.reader.masks must be both, mask or mask_cihp, got {self.masks!r}"
            )

    def __call__(self, root: str | Path, checks: Checks, smpl: str | None = None) -> Layout:
        """Reads and checks everything but most pictures' pixels.

        Args:
            root: the subject's folder.
            checks: thresholds of all formats.
            smpl: the user's SMPL model file; caches that hold joints do without.

        Raises:
            DataError: for whatever is missing, damaged or contradictory, naming the file.
        """
        folder = dataset_folder(root, EXPECTED)
        checks = replace(
            checks,
            distance=(self.distance[0], self.distance[1]),
            max_missing_masks=self.max_missing_masks,
            header_stride=self.header_stride,
        )
        path, model = body_model(smpl, "smpl") or (None, None)
        kind, body = layout_of(folder), None
        if kind == "annots":
            found, body = self._annots(folder, checks, model, path)
        else:
            cache = zju_caches.humannerf if kind == "humannerf" else zju_caches.arah
            found = cache(folder, checks, model, path, self.pixel_centre)
            found = replace(found, pixels=replace(found.pixels, ignore_band=self.ignore_band))
        layout = assemble(without_frames(found, self.drop_frames), checks)
        # the joints of a cache lie inside the body: their box says little about the mask's
        trust = self.trust if body is not None else replace(self.trust, min_box_iou=0.0)
        doubts = check_meeting(layout, body or layout.landmarks.seen, trust, MIXED)
        return self._looked_at(replace(layout, notes=(*layout.notes, *doubts)))

    def _annots(
        self, root: Path, checks: Checks, model: SkinnedModel | None, smpl: Path | None
    ) -> tuple[Found, Callable[[int], Float]]:
        """What is there, and points on the body ``[V, 3]`` by frame."""
        if model is None:
            raise no_joints(
                root,
                "SMPL parameters and vertices",
                "SMPL (SMPL_NEUTRAL.pkl)",
                ", or use a HumanNeRF or ARAH cache of the subject, which has joints",
            )
        notes = ["lengths of the cameras converted from mm to metres"]
        annots = zju_annots.read_annots(root)
        folders = zju_annots.camera_folders(root, annots, notes)
        images = zju_annots.index_images(root, folders, notes)
        cameras = zju_annots.annots_cameras(
            root,
            annots,
            images,
            self.pixel_centre,
            checks.rotation_tolerance,
            (self.translation[0], self.translation[1]),
        )
        frames = sorted({f for files in images.values() for f in files})
        fit = zju_params.choose_fit(root, self.fit)
        motion = zju_params.read_motion(root, fit, frames, model, notes)
        blend = zju_params.check_vertices(
            root, fit, motion, model, self.trust.frames, self.max_vertex_error
        )
        masks, labels = self._masks(root, folders, notes)
        p, conf = landmarks_of(model, motion, blend)
        row = {int(f): i for i, f in enumerate(motion.ids)}

        def body(frame: int) -> Float:
            return posed(model, motion.rows([row[frame]]), blend)[0][0]

        found = Found(
            root=root,
            meta=_meta(cameras, motion, smpl, bool(labels)),
            cameras=cameras,
            images=images,
            masks=masks,
            mask_folders={name: root / "mask" / name for name in folders},
            labels=labels,
            landmarks=make_landmarks(
                motion.ids, p, conf, checks.max_reach, notes, source=f"{fit.params}/"
            ),
            poses=motion.poses(f"{fit.params}/"),
            pixels=PixelRules(
                mask_sampling="nearest",
                label_table=zju_caches.CIHP_TABLE,
                ignore_band=self.ignore_band,
            ),
            calibration=annots.path,
            unit_hint=(
                f"T in {annots.path} must be in millimetres, Th in {root / fit.params} in metres"
            ),
            notes=tuple(notes),
        )
        return found, body

    def _masks(
        self, root: Path, folders: Mapping[str, str], notes: list[str]
    ) -> tuple[dict[str, dict[int, tuple[MaskFile, ...]]], dict[str, dict[int, str]]]:
        """Masks and part labels by camera and frame."""
        found: dict[str, dict[int, list[MaskFile]]] = {name: {} for name in folders}
        labels: dict[str, dict[int, str]] = {name: {} for name in folders}
        for kind, rule in MASKS.items():
            for name, folder in folders.items():
                place = _mask_folder(root, kind, name, folder)
                files = frame_files(root, place, MASK_SUFFIXES, zju_annots.frame_number)
                if kind == "mask_cihp":
                    labels[name] = {f: path for f, path in files.items() if path.endswith(".png")}
                if self.masks in ("both", kind):
                    for frame, path in files.items():
                        found[name].setdefault(frame, []).append(mask_file(rule, path))
        if (root / "schp").is_dir():
            notes.append("schp/ holds colours in place of part numbers and is not used")
        masks = {
            name: {f: tuple(entries) for f, entries in files.items()}
            for name, files in found.items()
        }
        return masks, labels if any(labels.values()) else {}

    def _looked_at(self, layout: Layout) -> Layout:
        """What a few masks and labels tell: odd areas, and labels that are none."""
        notes = [*layout.notes, *watch_masks(layout, self.trust)]
        if not layout.labels:
            return replace(layout, notes=tuple(notes))
        camera, files = next((c, files) for c, files in layout.labels.items() if files)
        some = [files[f] for f in spread(sorted(files), self.trust.watched_masks)]
        highest = highest_label(layout.root, some)
        if highest < len(CIHP):
            return replace(layout, notes=tuple(notes))
        notes.append(
            f"mask_cihp of camera {camera} holds the label {highest}, but CIHP has 0 to "
            f"{len(CIHP) - 1}: these files are used as masks only"
        )
        meta = replace(layout.meta, label_names=None)
        return replace(layout, notes=tuple(notes), labels={}, meta=meta)


def layout_of(root: Path) -> str:
    """Which layout a folder is in: "annots" (original or refined), "humannerf" or "arah".

    Raises:
        DataError: when it is none of them, saying what was looked for.
    """
    if any((root / name).is_file() for name in zju_annots.ANNOTS):
        return "annots"
    if (root / "cameras.pkl").is_file() and (root / "mesh_infos.pkl").is_file():
        return "humannerf"
    if (root / "cam_params.json").is_file() and (root / "models").is_dir():
        return "arah"
    raise DataError(
        f"{root} is not a ZJU-MoCap subject: it has neither annots.npy (original and refined "
        "release) nor cameras.pkl and mesh_infos.pkl (HumanNeRF) nor cam_params.json and models/ "
        "(ARAH)"
    )


def _mask_folder(root: Path, kind: str, name: str, folder: str) -> str:
    """``mask/Camera_B1``, or ``mask/images/00`` as some copies have it."""
    return next(
        (p for p in (f"{kind}/{name}", f"{kind}/{folder}") if (root / p).is_dir()), f"{kind}/{name}"
    )


def _meta(cameras: Mapping[str, Any], motion: Motion, smpl: Path | None, labels: bool) -> Meta:
    betas: Float = motion.betas[0]
    return Meta(
        unit="mm",
        up_axis=up_axis(cameras.values()),
        skeleton_source="smpl24 -> mediapipe33",
        body=BodyModel("smpl", str(smpl), tuple(betas.tolist())),
        label_names=CIHP if labels else None,
        labels_named_by="CIHP",
        layout="ZJU-MoCap",
    )
