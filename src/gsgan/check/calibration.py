"""How well each camera's calibration fits its masks, whether another would fit better, and why."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from gsgan.check.report import Finding, listed
from gsgan.check.settings import Limits, Sampling
from gsgan.check.views import Subject, View, best_shift, body_silhouette, grouped, moved, overlap
from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import project
from gsgan.data.formats.consistency import Bool, spread

TOPIC = "calibration"
MIRRORED = "mirrored images"
EXTRINSICS = "R and t of"
WHOLE = "the whole calibration of"
ADVICE = {
    MIRRORED: "mirror its images and masks back",
    EXTRINSICS: "check its R, t and folder name",
    WHOLE: "check its calibration and folder name",
}
TRIED = 8  # images per camera on which calibrations are tried, at most
LEAST_VIEWS = 3  # at a lag in time, for it to count
LAG_METRES = 0.002  # that a lag must gain: less is noise
LAG_LEFT = 0.01  # metres that it may leave: good captures have 0.001
CREDIBLE_OVERLAP = 0.35  # the right calibration has 0.6 to 0.7, with slim masks 0.4
SHARE_OF_ANY_CAMERA = 0.5  # of a standing person's joints lie in the mask from any camera
OUTSIDE_RATIO = 3.0  # times the other cameras' distance: noisy landmarks are off in all of them


@dataclass(frozen=True)
class Rival:
    """Another calibration that a camera may have, and the mean overlap with it.

    ``kind`` is a key of `ADVICE`, ``other`` the camera whose calibration it takes, or empty.
    """

    kind: str
    other: str
    overlap: float


@dataclass(frozen=True)
class CameraScore:
    """How well one camera's calibration fits its masks.

    Args:
        name, inside: the camera; mean share of joints inside the mask.
        overlap: mean overlap of mask and estimated silhouette.
        fullness: median area of the mask over that of the estimated silhouette.
        rivals: other calibrations, best first.
        shift, shift_metres: ``(dx, dy)`` pixels of the whole image by which masks lie beside the
            skeleton; its length at the person.
        shift_overlap: mean overlap once the masks are moved back.
        lag: frames by which the skeleton must be moved to fit best; 0 when nothing is gained.
        outside, lag_outside: metres, mean distance of the joints from the mask, without and with
            the lag.
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
    def shift_text(self) -> str:
        """Pixels right, down."""
        return f"{self.shift[0]:+.0f}, {self.shift[1]:+.0f}"

    def beaten(self, limits: Limits) -> bool:
        """Whether another calibration fits the masks better, and well."""
        return self.rivals[0].overlap > max(self.overlap + limits.better_fit, CREDIBLE_OVERLAP)

    def shifted(self, limits: Limits) -> bool:
        """Whether the masks lie beside the skeleton, by more than bodies and skeletons differ."""
        gain = self.shift_overlap - self.overlap
        return self.shift_metres > limits.shift and gain > limits.better_fit

    def oversized(self, limits: Limits) -> bool:
        """Whether the masks are far larger than the body, and most of the body lies in them."""
        return self.fullness > limits.fullness and self.inside > SHARE_OF_ANY_CAMERA

    def wrong(self, limits: Limits) -> bool:
        """Whether calibration or masks are wrong as a whole."""
        outside = not self.inside >= limits.inside_error
        return outside or self.beaten(limits) or self.oversized(limits)

    def unfit(self, limits: Limits) -> bool:
        """Whether the masks do not fit the skeleton, for any reason."""
        return self.wrong(limits) or self.shifted(limits) or self.lag != 0


def score_cameras(
    subject: Subject, views: Sequence[View], limits: Limits, sampling: Sampling
) -> list[CameraScore]:
    """Scores every camera of which an image could be read."""
    by_camera = grouped(views)
    count = min(TRIED, max(1, sampling.trials // (2 * len(by_camera) ** 2 or 1)))
    scores = []
    for name, own in by_camera.items():
        chosen, camera = spread(own, count), subject.cameras[name]
        rivals = [
            Rival(*what, _fit(subject, chosen, other))
            for what, other in calibrations(camera, subject.cameras).items()
        ]
        scores.append(
            CameraScore(
                name,
                known_mean([view.inside for view in own if view.mask.any()]),
                _fit(subject, chosen, camera),
                float(np.median([view.fullness for view in own])),
                tuple(sorted(rivals, key=lambda rival: -rival.overlap)),
                *_shift(subject, camera, chosen),
                *_lag(own, limits),
            )
        )
    return scores


def calibrations(
    own: CameraEntry, cameras: Mapping[str, CameraEntry]
) -> dict[tuple[str, str], CameraEntry]:
    """Other calibrations that a camera may have, by (kind, other camera)."""
    mirror = own.K.copy()
    mirror[0] = -mirror[0]
    mirror[0, 2] += own.size[1]
    found = {(MIRRORED, ""): replace(own, K=mirror)}
    for name, other in cameras.items():
        if name != own.name:
            found[EXTRINSICS, name] = replace(own, R=other.R, t=other.t)
            found[WHOLE, name] = other
    return found


def _body(subject: Subject, view: View, camera: CameraEntry) -> Bool:
    row = subject.rows[view.frame]
    small = view.small(camera)
    return body_silhouette(small, subject.p[row], subject.visible[row], subject.template)


def _fit(subject: Subject, views: Sequence[View], camera: CameraEntry) -> float:
    return float(np.mean([overlap(v.mask, _body(subject, v, camera)) for v in views]))


def _shift(
    subject: Subject, camera: CameraEntry, views: Sequence[View]
) -> tuple[tuple[float, float], float, float]:
    """The median shift in whole-image pixels, its length in metres, the overlap without it."""
    pairs = [(view.mask, _body(subject, view, camera)) for view in views]
    dx, dy = np.median([best_shift(*pair) for pair in pairs], axis=0).round().astype(int)
    after = float(np.mean([overlap(mask, moved(body, dx, dy)) for mask, body in pairs]))
    pixels = np.array([dx, dy]) / np.diag(views[0].to_small)[:2]
    depth = float(project(camera, subject.p[subject.visible])[1].mean())
    metres = float(np.linalg.norm(pixels / np.diag(camera.K)[:2])) * depth
    return (float(pixels[0]), float(pixels[1])), metres, after


def _lag(views: Sequence[View], limits: Limits) -> tuple[int, float, float]:
    """The best lag, and the mean metres outside without and with it.

    Each lag is compared with none on the views that know both, as the first frames have none
    before them. Empty masks are left out.
    """
    table = np.array([view.lagged for view in views if view.mask.any()])
    if len(table) == 0:
        return 0, np.nan, np.nan
    reach = table.shape[1] // 2
    best, left = 0, known_mean(table[:, reach].tolist())
    outside, most = left, 0.0
    for column in range(table.shape[1]):
        known = ~np.isnan(table[:, [reach, column]]).any(1)
        if np.count_nonzero(known) < max(LEAST_VIEWS, len(views) / 2):
            continue
        before, after = table[known, reach].mean(), table[known, column].mean()
        enough = before - after >= max(LAG_METRES, limits.lag_gain * before)
        if enough and after <= LAG_LEFT and before - after > most:
            best, left, most = column - reach, float(after), before - after
    return best, outside, left


def known_mean(values: Iterable[float]) -> float:
    """Mean without the NaN; NaN when nothing is left."""
    kept = [v for v in values if not np.isnan(v)]
    return float(np.mean(kept)) if kept else np.nan


def calibration_findings(
    scores: Sequence[CameraScore], limits: Limits, min_inside: float, named: Iterable[str] = ()
) -> list[Finding]:
    """Which camera is wrong, and the usual causes; other findings name ``named`` already."""
    found, named = list[Finding](), set(named)
    if big := [s for s in scores if s.oversized(limits) and s.name not in named]:
        sizes = listed(f"{s.name} {s.fullness:.1f}" for s in big)
        text = (
            f"masks are far larger than the body (times its area: {sizes}): a focal length that is "
            "too short, K of smaller images, a skeleton in another unit, or masks of more"
        )
        found.append(Finding("error", TOPIC, text))
        named |= {s.name for s in big}
        scores = [s for s in scores if s not in big]
    beaten = [s for s in scores if s.beaten(limits)]
    for one, other in combinations(beaten, 2):
        ours, theirs = _rival_of(one, other, limits), _rival_of(other, one, limits)
        if ours and theirs and not {one.name, other.name} & named:
            what = "R and t" if ours.kind == EXTRINSICS else "calibration"
            text = (
                f"cameras {one.name} and {other.name} look exchanged: the {what} of the other "
                f"would fit the masks better (overlap {ours.overlap:.2f} and {theirs.overlap:.2f}, "
                f"its own {one.overlap:.2f} and {other.overlap:.2f}); exchange them in the "
                "calibration, or rename the folders"
            )
            found.append(Finding("error", TOPIC, text))
            named |= {one.name, other.name}
    if len(scores) > 1 and not big and (finding := _of_all(scores, limits)):
        return [finding]
    for score in scores:
        if score.lag and (score not in beaten or score.name in named):
            when = "later" if score.lag > 0 else "earlier"
            text = (
                f"camera {score.name}: its images fit the skeleton {abs(score.lag)} frame(s) "
                f"{when} better (joints {100 * score.lag_outside:.1f} cm outside the masks instead "
                f"of {100 * score.outside:.1f}); its clock or numbering is off: add {score.lag:+d}"
            )
            found.append(Finding("error", "synchronisation", text))
        elif score.name not in named:
            found += _of_one(score, scores, limits, min_inside)
    named |= {s.name for s in scores if s.unfit(limits)}
    return found + small_errors([s for s in scores if s.name not in named], limits)


def _rival_of(score: CameraScore, other: CameraScore, limits: Limits) -> Rival | None:
    """The other camera's calibration, where it fits the masks about as well as the best."""
    least = score.rivals[0].overlap - limits.better_fit
    return next((r for r in score.rivals if r.other == other.name and r.overlap > least), None)


def _of_all(scores: Sequence[CameraScore], limits: Limits) -> Finding | None:
    """One finding when every camera is wrong."""
    wrong = [s for s in scores if s.wrong(limits)]
    if all(s.shifted(limits) for s in scores):
        shifts = listed(f"{s.name} {s.shift_text}" for s in scores)
        text = (
            f"in every camera the masks lie beside the skeleton, by pixels right, down: {shifts}; "
            "the skeleton is moved or of another size, or K does not follow a crop"
        )
        return Finding("error" if wrong else "warning", TOPIC, text)
    if len(wrong) == len(scores) and not any(s.beaten(limits) for s in scores):
        shares = listed(f"{s.name} {s.inside:.0%}" for s in scores)
        text = (
            f"in every camera joints lie outside the masks (inside: {shares}): axes, unit or frame "
            "numbers of the skeleton are wrong, or the masks belong to other images"
        )
        return Finding("error", TOPIC, text)
    return None


def _of_one(
    score: CameraScore, scores: Sequence[CameraScore], limits: Limits, min_inside: float
) -> list[Finding]:
    """What is wrong with one camera, if anything."""
    seen = f"{score.inside:.0%} of the joints lie inside its masks"
    if len(scores) > 1:
        others = known_mean([s.inside for s in scores if s is not score])
        seen += f", {others:.0%} in the other cameras"
    error = not score.inside >= limits.inside_error
    if score.beaten(limits):
        error, best = True, score.rivals[0]
        close = [r for r in score.rivals if r.overlap > best.overlap - limits.better_fit]
        what = dict.fromkeys(f"{r.kind} {r.other}".strip() for r in close)
        advice = [ADVICE[kind] for kind in ADVICE if kind in {rival.kind for rival in close}]
        text = (
            f"{' or '.join(what)} would fit its masks better (overlap {best.overlap:.2f}) than "
            f"its own calibration ({score.overlap:.2f}); {seen}; {', or '.join(advice)}"
        )
    elif np.isnan(score.inside):
        text = "its masks are empty, or no joint lies in its images; check both folders and K"
    elif score.shifted(limits):
        text = (
            f"its masks lie {score.shift_text} pixels (right, down) beside the skeleton; {seen}. "
            "A crop or resize that K does not follow, or masks of other images, do this"
        )
    elif not score.inside >= min_inside:
        text = (
            f"only {seen}. One camera alone points to its extrinsics, to exchanged folder names, "
            "to lens distortion left out, or to masks of other images; see its overlays"
        )
    else:
        return []
    return [Finding("error" if error else "warning", TOPIC, f"camera {score.name}: {text}")]


def small_errors(scores: Sequence[CameraScore], limits: Limits) -> list[Finding]:
    """Cameras, of those without other findings, whose joints lie just outside the masks."""
    metres = {s.name: s.outside for s in scores if np.isfinite(s.outside)}
    middle = float(np.median(list(metres.values()) or [0]))
    if middle > limits.outside_all:
        text = (
            f"in most cameras joints lie {100 * middle:.1f} cm outside the masks on average (good "
            "captures: 0.1): focal lengths or unit slightly off, tight masks, or noisy landmarks"
        )
        return [Finding("warning", TOPIC, text)]
    found = []
    for name, own in metres.items():
        rest = [value for other, value in metres.items() if other != name]
        others = float(np.median(rest)) if rest else np.inf
        if own > max(limits.outside, OUTSIDE_RATIO * others):
            text = (
                f"camera {name}: joints lie {100 * own:.1f} cm outside its masks on average, "
                f"{100 * others:.1f} in the other cameras; its R, t or focal length is slightly off"
            )
            found.append(Finding("warning", TOPIC, text))
    return found
