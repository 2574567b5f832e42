"""How well each camera's calibration fits its masks, and whether another would fit better."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from gsgan.check.report import Finding, listed
from gsgan.check.settings import Limits
from gsgan.check.views import CheckedData, MaskView, body_silhouette, grouped, overlap
from gsgan.data.cameras import CameraEntry
from gsgan.data.formats.consistency import spread

TOPIC = "calibration"
MIRRORED = "mirrored images"
TRIED = 8  # images per camera on which calibrations are tried, at most
CREDIBLE_OVERLAP = 0.35  # the right calibration has 0.6 to 0.7, with slim masks 0.4
# of a standing person's joints lie in the mask from any camera
SHARE_OF_ANY_CAMERA = 0.5
# times the other cameras' distance: noisy landmarks are off in all of them
OUTSIDE_RATIO = 3.0
OUTSIDE_ALL = 2.0  # times the limit of one camera, where all are off


@dataclass(frozen=True)
class CameraScore:
    """How well one camera's calibration fits its masks.

    Args:
        name, inside: the camera; mean share of joints inside the mask.
        overlap: mean overlap of mask and estimated silhouette.
        fullness: median area of the mask over that of the estimated silhouette.
        rivals: the mean overlap with other calibrations, best first; by the name of their camera,
            or `MIRRORED`.
        outside: metres, mean distance of the joints from the mask.
    """

    name: str
    inside: float
    overlap: float
    fullness: float
    rivals: dict[str, float]
    outside: float

    @property
    def best_rival(self) -> float:
        """The overlap with the best other calibration."""
        return max(self.rivals.values())

    def beaten(self, limits: Limits) -> bool:
        """Whether another calibration fits the masks better, and well."""
        return self.best_rival > max(self.overlap + limits.better_fit, CREDIBLE_OVERLAP)

    def oversized(self, limits: Limits) -> bool:
        """Whether the masks are far larger than the body, and most of the body lies in them."""
        return self.fullness > limits.fullness and self.inside > SHARE_OF_ANY_CAMERA

    def wrong(self, limits: Limits) -> bool:
        """Whether calibration or masks are wrong as a whole."""
        outside = not self.inside >= limits.inside_error
        return outside or self.beaten(limits) or self.oversized(limits)

    def close_rivals(self, limits: Limits) -> list[str]:
        """The other calibrations that fit about as well as the best."""
        least = self.best_rival - limits.better_fit
        return [name for name, overlap in self.rivals.items() if overlap > least]


def score_cameras(subject: CheckedData, views: Sequence[MaskView]) -> list[CameraScore]:
    """Scores every camera of which an image could be read."""
    scores = []
    for name, own in grouped(views).items():
        chosen = spread(own, TRIED)
        camera = subject.cameras[name]
        rivals = dict[str, float]()
        for rival, other in calibrations(camera, subject.cameras):
            rivals[rival] = max(rivals.get(rival, 0.0), _fit(subject, chosen, other))
        scores.append(
            CameraScore(
                name,
                known_mean(view.inside for view in own if view.mask.any()),
                _fit(subject, chosen, camera),
                float(np.median([view.fullness for view in own])),
                dict(sorted(rivals.items(), key=lambda rival: -rival[1])),
                known_mean(view.distance for view in own if view.mask.any()),
            )
        )
    return scores


def calibrations(
    own: CameraEntry, cameras: Mapping[str, CameraEntry]
) -> Iterator[tuple[str, CameraEntry]]:
    """Other calibrations that a camera may have: mirrored, and those of other cameras.

    Of another camera either R and t are exchanged, or the whole calibration.
    """
    mirror = own.K.copy()
    mirror[0] = -mirror[0]
    mirror[0, 2] += own.size[1]
    yield MIRRORED, replace(own, K=mirror)
    for name, other in cameras.items():
        if name != own.name:
            yield name, replace(own, R=other.R, t=other.t)
            yield name, other


def _fit(subject: CheckedData, views: Sequence[MaskView], camera: CameraEntry) -> float:
    """Mean overlap of the masks with the silhouettes estimated for a camera."""
    overlaps = []
    for view in views:
        row = subject.rows[view.frame]
        skeleton = subject.p[row], subject.visible[row], subject.template
        overlaps.append(
            overlap(view.mask, body_silhouette(view.small(camera), *skeleton))
        )
    return float(np.mean(overlaps))


def known_mean(values: Iterable[float]) -> float:
    """Mean without NaN; NaN when nothing is left."""
    kept = [v for v in values if not np.isnan(v)]
    return float(np.mean(kept)) if kept else np.nan


def calibration_findings(
    scores: Sequence[CameraScore],
    limits: Limits,
    min_inside: float,
    named: Iterable[str] = (),
) -> list[Finding]:
    """Which camera is wrong, and the usual causes; other findings name ``named`` already."""
    found = list[Finding]()
    named = set(named)
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
        close = other.name in one.close_rivals(
            limits
        ) and one.name in other.close_rivals(limits)
        if close and not {one.name, other.name} & named:
            text = (
                f"cameras {one.name} and {other.name} look exchanged: the R and t of the other "
                f"would fit the masks better (overlap {one.rivals[other.name]:.2f} and "
                f"{other.rivals[one.name]:.2f}, its own {one.overlap:.2f} and {other.overlap:.2f});"
                " exchange them in the calibration, or rename the folders"
            )
            found.append(Finding("error", TOPIC, text))
            named |= {one.name, other.name}
    off = [s for s in scores if not s.inside >= min_inside]
    if len(scores) > 1 and not beaten and not big and off == scores:
        shares = listed(f"{s.name} {s.inside:.0%}" for s in scores)
        text = (
            f"in every camera joints lie outside the masks (inside: {shares}): axes, unit, size or "
            "frame numbers of the skeleton are wrong, K does not follow a crop, or the masks "
            "belong to other images"
        )
        wrong = any(s.wrong(limits) for s in scores)
        return [Finding("error" if wrong else "warning", TOPIC, text)]
    for score in scores:
        if score.name not in named and (
            finding := _of_one(score, scores, limits, min_inside)
        ):
            found.append(finding)
            named.add(score.name)
    return found + small_errors([s for s in scores if s.name not in named], limits)


def _of_one(
    score: CameraScore, scores: Sequence[CameraScore], limits: Limits, min_inside: float
) -> Finding | None:
    """What is wrong with one camera, if anything."""
    seen = f"{score.inside:.0%} of the joints lie inside its masks"
    if len(scores) > 1:
        others = known_mean(s.inside for s in scores if s is not score)
        seen += f", {others:.0%} in the other cameras"
    error = not score.inside >= limits.inside_error
    if score.beaten(limits):
        error = True
        rivals = score.close_rivals(limits)
        names = " or ".join(
            n if n == MIRRORED else f"the calibration of {n}" for n in rivals
        )
        advice = "check its R, t and folder name"
        if MIRRORED in rivals:
            advice = "mirror its images and masks back" + (
                f", or {advice}" if rivals[1:] else ""
            )
        text = (
            f"{names} would fit its masks better (overlap {score.best_rival:.2f}) than its own "
            f"calibration ({score.overlap:.2f}); {seen}; {advice}"
        )
    elif np.isnan(score.inside):
        text = "its masks are empty, or no joint lies in its images; check both folders and K"
    elif not score.inside >= min_inside:
        text = (
            f"only {seen}. One camera alone points to its extrinsics, to a crop or resize that K "
            "does not follow, to exchanged folder names, to lens distortion left out, or to masks "
            "of other images; see its overlays"
        )
    else:
        return None
    return Finding(
        "error" if error else "warning", TOPIC, f"camera {score.name}: {text}"
    )


def small_errors(scores: Sequence[CameraScore], limits: Limits) -> list[Finding]:
    """Cameras, of those without other findings, whose joints lie just outside the masks."""
    metres = {s.name: s.outside for s in scores if np.isfinite(s.outside)}
    middle = float(np.median(list(metres.values()) or [0]))
    if middle > OUTSIDE_ALL * limits.outside:
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
