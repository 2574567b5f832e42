"""Reader of ZJU-MoCap in each of its layouts, recognised by their files.

::

    original   annots.npy  Camera_B1/000000.jpg  mask/ mask_cihp/  new_params/ or params/
    refined    annots.npy  images/00/000000.jpg  mask/00/          smpl_params/
    HumanNeRF  cameras.pkl  mesh_infos.pkl  images/frame_000000.png  masks/
    ARAH       cam_params.json  1/000000.{jpg,png}  models/000000.npz

Subjects 313 and 315 of the original release have 21 cameras (``Camera (1)``, no 20 and 21), long
file names, frames that count from 1 and nested lists in annots.npy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from gsgan.body.smpl import SkinnedModel
from gsgan.body.smpl_names import CIHP
from gsgan.data.checks import Checks
from gsgan.data.files import frame_files, read_grey
from gsgan.data.formats import zju_annots, zju_caches
from gsgan.data.formats.common import FolderReader, body_model, no_joints, up_axis
from gsgan.data.formats.smpl_motion import landmarks_of, posed
from gsgan.data.formats.trust import Trust, spread
from gsgan.data.layout import BodyModel, Found, Layout, Meta
from gsgan.data.pixels import MaskFile, PixelRules, mask_file
from gsgan.data.skeletons import make_landmarks
from gsgan.utils.checks import one_of
from gsgan.utils.errors import DataError

Float = NDArray[np.float64]

MASKS = {"mask_cihp": "label", "mask": "nonzero"}


@dataclass(frozen=True, kw_only=True)
class ZjuReader(FolderReader):
    """Reads a ZJU-MoCap subject.

    Args:
        masks: "both" joins mask_cihp and mask where both exist, or only one of them by name.
        fit: "refit" (new_params), "refined" (smpl_params), "first" (params), or "auto" for the
            first of these that exists.
        ignore_band: pixels, side of the square that widens the mask's outline into a band of
            ignored labels; 0 ignores none.
        translation: metres, least and greatest median length of the cameras' T.
        max_vertex_error: metres, mean distance allowed between stored and posed vertices.
    """

    masks: str = "both"
    fit: str = "auto"
    ignore_band: int = 5
    translation: tuple[float, float] = (0.05, 20.0)
    max_missing_masks: float = 0.5
    max_vertex_error: float = 0.01

    contents: ClassVar[str] = (
        "a ZJU-MoCap subject (annots.npy and camera folders, or a HumanNeRF or ARAH cache of it)"
    )
    hint: ClassVar[str] = (
        "check that cameras, SMPL parameters and masks come from one release (the refined my_* "
        "ones do not fit CoreView images)"
    )

    def __post_init__(self) -> None:
        one_of("data.reader.masks", self.masks, ("both", *MASKS))
        one_of("data.reader.fit", self.fit, ("auto", *zju_annots.FITS))

    def __call__(self, root: str | Path, checks: Checks, smpl: str | None = None) -> Layout:
        """Reads and checks everything except most images' pixels; see `FolderReader`.

        Raises:
            DataError: for whatever is missing, damaged or contradictory, naming the file.
        """
        return self._without_wrong_labels(super().__call__(root, checks, smpl))

    def find(self, root: Path, checks: Checks, smpl: str | None) -> Found:
        """The subject's files, each checked by itself; caches that hold joints need no model.

        Raises:
            DataError: for whatever is missing or damaged, naming the file.
        """
        path, model = body_model(smpl, "smpl") or (None, None)
        kind = layout_of(root)
        if kind == "annots":
            return self._annots(root, checks, model, path)
        cache = zju_caches.humannerf if kind == "humannerf" else zju_caches.arah
        found = cache(root, checks, model, path, self.pixel_centre)
        return replace(found, pixels=replace(found.pixels, ignore_band=self.ignore_band))

    def trust_of(self, found: Found) -> Trust:
        """For joints, which lie inside the body, without the overlap of body and mask boxes."""
        return self.trust if found.points is not None else replace(self.trust, min_box_iou=0.0)

    def _annots(
        self, root: Path, checks: Checks, model: SkinnedModel | None, smpl: Path | None
    ) -> Found:
        """The original or the refined release."""
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
        fit = zju_annots.choose_fit(root, self.fit)
        motion = zju_annots.read_motion(root, fit, frames, model, notes)
        blend = zju_annots.check_vertices(
            root, fit, motion, model, self.trust.frames, self.max_vertex_error
        )
        masks, labels = self._masks(root, folders, notes)
        p, conf = landmarks_of(model, motion, blend)
        row = {int(f): i for i, f in enumerate(motion.ids)}
        return Found(
            root=root,
            meta=Meta(
                unit="mm",
                up_axis=up_axis(cameras.values()),
                skeleton_source="smpl24 -> mediapipe33",
                body=BodyModel("smpl", str(smpl), tuple(motion.betas[0].tolist())),
                label_names=CIHP if labels else None,
                labels_named_by="CIHP",
                layout="ZJU-MoCap",
            ),
            cameras=cameras,
            images=images,
            masks=masks,
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
            points=lambda frame: posed(model, motion.rows([row[frame]]), blend)[0][0],
            notes=tuple(notes),
        )

    def _masks(
        self, root: Path, folders: Mapping[str, str], notes: list[str]
    ) -> tuple[dict[str, dict[int, tuple[MaskFile, ...]]], dict[str, dict[int, str]]]:
        """Masks and part labels by camera and frame."""
        masks: dict[str, dict[int, tuple[MaskFile, ...]]] = {name: {} for name in folders}
        labels: dict[str, dict[int, str]] = {name: {} for name in folders}
        for kind, rule in MASKS.items():
            for name, folder in folders.items():
                # mask/Camera_B1, or mask/images/00 as some copies have it
                places = (f"{kind}/{name}", f"{kind}/{folder}")
                place = next((p for p in places if (root / p).is_dir()), places[0])
                files = frame_files(root, place, (".png", ".jpg"), zju_annots.frame_number)
                if kind == "mask_cihp":
                    labels[name] = {f: path for f, path in files.items() if path.endswith(".png")}
                if self.masks in ("both", kind):
                    for frame, path in files.items():
                        masks[name][frame] = (*masks[name].get(frame, ()), mask_file(rule, path))
        if (root / "schp").is_dir():
            notes.append("schp/ holds colours in place of part numbers and is not used")
        return masks, labels if any(labels.values()) else {}

    def _without_wrong_labels(self, layout: Layout) -> Layout:
        """The same without labels if a few of them hold more parts than CIHP names."""
        if not layout.labels:
            return layout
        camera, files = next((c, files) for c, files in layout.labels.items() if files)
        some = [files[f] for f in spread(sorted(files), self.trust.watched_masks)]
        highest = max((int(read_grey(layout.root / path).max()) for path in some), default=0)
        if highest < len(CIHP):
            return layout
        note = (
            f"mask_cihp of camera {camera} holds the label {highest}, but CIHP has 0 to "
            f"{len(CIHP) - 1}: these files are used as masks only"
        )
        meta = replace(layout.meta, label_names=None)
        return replace(layout, notes=(*layout.notes, note), labels={}, meta=meta)


def layout_of(root: Path) -> str:
    """The layout of a folder: "annots" (original or refined), "humannerf" or "arah".

    Raises:
        DataError: when it is none of them, naming the expected files.
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
