"""How well each camera's calibration explains its masks, and whether another would do better."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsgan.check.looking import Look
from gsgan.check.settings import Limits, Sampling
from gsgan.check.silhouette import Bool, best_shift, body_silhouette, moved, overlap
from gsgan.check.subject import Subject, evenly
from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import project

OWN = "its own calibration"
INVERSE = "R and t the other way round"
MIRRORED = "mirrored pictures"
EXTRINSICS = "R and t of"
WHOLE = "the whole calibration of"
LEAST_LOOKS = 3  # at a lag in time, for it to be judged


@dataclass(frozen=True)
class Rival:
    """A calibration that a camera may really have.

    Args:
        kind: one of `INVERSE`, `MIRRORED`, `EXTRINSICS`, `WHOLE`.
        other: the camera whose calibration it takes, or empty.
        overlap: mean overlap of mask and the body that it foretells.
    """

    kind: str
    other: str
    overlap: float


@dataclass(frozen=True)
class CameraScore:
    """How well one camera's calibration explains its masks.

    Args:
        name: the camera.
        inside: mean share of joints inside the mask.
        overlap: mean overlap of mask and foretold body.
        fullness: median area of the mask over that of the foretold body.
        rivals: what else might explain the masks, best first.
        shift: ``(dx, dy)`` pixels of the whole picture by which masks lie beside the skeleton.
        shift_metres: its length at the person.
        shift_overlap: mean overlap once the masks are moved back.
        lag: frames by which the skeleton must be moved to fit best; 0 when nothing is gained.
        outside: metres, joints' mean distance from the mask as it is.
        lag_outside: the same after the lag.
    """

    name: str
    inside: float
    overlap: float
    fullness: float
    rivals: tuple[Rival, ...]
    shift: tuple[float, float]
    shift_metres: float
    shift_overlap: float
    lag: int
    outside: float
    lag_outside: float

    @property
    def rival_overlap(self) -> float:
        """Of the best rival."""
        return self.rivals[0].overlap


def score_cameras(
    subject: Subject, looks: Sequence[Look], limits: Limits, sampling: Sampling
) -> list[CameraScore]:
    """Scores every camera of which a picture could be read."""
    by_camera = grouped(looks)
    rivals = max(1, 2 * len(by_camera))
    share = max(1, sampling.trials // (rivals * max(1, len(by_camera))))
    count = min(sampling.trial_frames, share)
    return [_score(subject, name, own, limits, count) for name, own in by_camera.items()]


def grouped(looks: Sequence[Look]) -> dict[str, list[Look]]:
    """The looks by camera."""
    found: dict[str, list[Look]] = {}
    for look in looks:
        found.setdefault(look.camera, []).append(look)
    return found


def _score(
    subject: Subject, name: str, looks: Sequence[Look], limits: Limits, count: int
) -> CameraScore:
    chosen = [looks[i] for i in evenly(tuple(range(len(looks))), count)]
    own = subject.cameras[name]
    fits = {
        what: float(np.mean([_fit(subject, look, entry, limits) for look in chosen]))
        for what, entry in calibrations(own, subject.cameras).items()
    }
    here = fits.pop((OWN, ""))
    rivals = sorted((Rival(*what, fit) for what, fit in fits.items()), key=lambda r: -r.overlap)
    shift, metres, shifted = _shift(subject, own, chosen, limits)
    lag, outside, lagged = _lag(looks, limits)
    return CameraScore(
        name=name,
        inside=known_mean([look.inside(limits) for look in looks if look.mask.any()]),
        overlap=here,
        fullness=float(np.median([look.fullness for look in looks])),
        rivals=tuple(rivals),
        shift=shift,
        shift_metres=metres,
        shift_overlap=shifted,
        lag=lag,
        outside=outside,
        lag_outside=lagged,
    )


def calibrations(
    own: CameraEntry, cameras: Mapping[str, CameraEntry]
) -> dict[tuple[str, str], CameraEntry]:
    """Calibrations that a camera may really have, its own first, by (kind, other camera)."""
    mirror = own.K.copy()
    mirror[0] = -mirror[0]
    mirror[0, 2] += own.size[1]
    found = {
        (OWN, ""): own,
        (INVERSE, ""): replace(own, R=own.R.T, t=-own.R.T @ own.t),
        (MIRRORED, ""): replace(own, K=mirror),
    }
    for name, camera in cameras.items():
        if name != own.name:
            found[(EXTRINSICS, name)] = replace(own, R=camera.R, t=camera.t)
            found[(WHOLE, name)] = camera
    return found


def _fit(subject: Subject, look: Look, camera: CameraEntry, limits: Limits) -> float:
    return overlap(look.mask, _body(subject, look, camera, limits))


def _body(subject: Subject, look: Look, camera: CameraEntry, limits: Limits) -> Bool:
    row = subject.rows[look.frame]
    pixels, depth = project(camera, subject.p[row])
    focal = abs(float(camera.K[0, 0] * look.place.scale[0]))
    return body_silhouette(
        look.place(pixels), depth, subject.visible[row], focal, look.mask.shape,
        subject.template, limits.flesh,
    )  # fmt: skip


def _shift(
    subject: Subject, camera: CameraEntry, looks: Sequence[Look], limits: Limits
) -> tuple[tuple[float, float], float, float]:
    """The median shift in whole-picture pixels, its length in metres, the overlap without it."""
    bodies = [_body(subject, look, camera, limits) for look in looks]
    shifts = np.array([best_shift(l.mask, b) for l, b in zip(looks, bodies, strict=True)])
    dx, dy = np.median(shifts, axis=0).round().astype(int)
    after = [overlap(l.mask, moved(b, dx, dy)) for l, b in zip(looks, bodies, strict=True)]
    pixels = np.array([dx, dy]) / looks[0].place.scale
    depth = float(project(camera, subject.p[subject.visible])[1].mean())
    metres = float(np.linalg.norm(pixels / np.diag(camera.K)[:2])) * depth
    return (float(pixels[0]), float(pixels[1])), metres, float(np.mean(after))


def _lag(looks: Sequence[Look], limits: Limits) -> tuple[int, float, float]:
    """The best lag, and the mean metres outside without and with it.

    A lag is held against none on the looks that know both: the first frames have none before them.
    Empty masks say nothing.
    """
    table = np.array([look.lagged for look in looks if look.mask.any()])
    if len(table) == 0:
        return 0, np.nan, np.nan
    reach = table.shape[1] // 2
    best, left = 0, known_mean(table[:, reach].tolist())
    outside, most = left, 0.0
    for column in range(table.shape[1]):
        known = ~np.isnan(table[:, [reach, column]]).any(1)
        if np.count_nonzero(known) < max(LEAST_LOOKS, len(looks) / 2):
            continue
        before, after = table[known, reach].mean(), table[known, column].mean()
        enough = before - after >= max(limits.lag_metres, limits.lag_gain * before)
        if enough and after <= limits.lag_left and before - after > most:
            best, left, most = column - reach, float(after), before - after
    return best, outside, left


def known_mean(values: Iterable[float]) -> float:
    """Mean without the NaN; NaN when nothing is left."""
    kept = [v for v in values if not np.isnan(v)]
    return float(np.mean(kept)) if kept else np.nan
