"""The fit of each camera's calibration to its masks, and whether another would fit better."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from gsgan.check.report import Finding, list_names
from gsgan.check.settings import Limits
from gsgan.check.views import (
    CheckedData,
    MaskView,
    body_silhouette,
    group_by_camera,
    overlap,
)
from gsgan.data.cameras import CameraEntry
from gsgan.data.formats.consistency import spread

TOPIC = "calibration"
MIRRORED_IMAGES = "mirrored images"
FULL_MASK = 0.98  # share of the image above which a mask is white everywhere
# Area of another piece of the mask over the person's, and share of a camera's images with one.
OTHER_PIECE = 0.3
OTHER_IMAGES = 0.1
# Maximum number of images per camera on which calibrations are tried.
TRIED = 8
# The right calibration has 0.6 to 0.7, with slim masks 0.4.
CREDIBLE_OVERLAP = 0.35
# Share of a standing person's joints that lie in the mask from any camera.
SHARE_OF_ANY_CAMERA = 0.5
# Times the other cameras' distance: noisy landmarks are off in all of them.
OUTSIDE_RATIO = 3.0
# Times the limit of one camera, if all are off.
OUTSIDE_ALL = 2.0


def percent(share: float, digits: int = 0) -> str:
    """A share in percent; "n/a" if nothing is known."""
    return "n/a" if np.isnan(share) else f"{share:.{digits}%}"


@dataclass(frozen=True)
class CameraScore:
    """The fit of one camera's calibration to its masks."""

    name: str  # of the camera
    inside: float  # mean share of joints inside the mask
    overlap: float  # mean overlap of mask and estimated silhouette
    # median area of the mask over that of the estimated silhouette
    fullness: float
    # Mean overlap with other calibrations, best first, by the name of their camera or
    # `MIRRORED_IMAGES`.
    rivals: dict[str, float]
    outside: float  # metres, mean distance of the joints from the mask
    inverted: float  # mean overlap of the inverted masks with the estimated silhouette
    filled: float  # median share of the image that the masks fill
    others: float  # share of images in which another piece of the mask is large

    @property
    def best_rival(self) -> float:
        """The overlap with the best other calibration."""
        return max(self.rivals.values())

    def beaten(self, limits: Limits) -> bool:
        """Whether another calibration fits the masks better, and well."""
        return self.best_rival > max(
            self.overlap + limits.better_fit, CREDIBLE_OVERLAP
        )

    def is_oversized(self, limits: Limits) -> bool:
        """Whether the masks are far larger than the body, and most of the body lies in them."""
        return (
            self.fullness > limits.fullness
            and self.inside > SHARE_OF_ANY_CAMERA
        )

    def wrong(self, limits: Limits) -> bool:
        """Whether calibration or masks are wrong as a whole."""
        # Without a known joint the share is NaN, which is wrong as well.
        outside = not self.inside >= limits.inside_error
        return outside or self.beaten(limits) or self.is_oversized(limits)

    def close_rivals(self, limits: Limits) -> list[str]:
        """The other calibrations that fit about as well as the best."""
        lowest = self.best_rival - limits.better_fit
        return [
            name for name, overlap in self.rivals.items() if overlap > lowest
        ]


def score_cameras(
    subject: CheckedData, views: Sequence[MaskView]
) -> list[CameraScore]:
    """Scores every camera of which an image could be read."""
    scores = []
    for name, camera_views in group_by_camera(views).items():
        # Each rival's better variant, best rival first.
        chosen = spread(camera_views, TRIED)
        camera = subject.cameras[name]
        rivals = dict[str, float]()
        for rival, other in calibrations(camera, subject.cameras):
            rivals[rival] = max(
                rivals.get(rival, 0.0), _fit(subject, chosen, other)
            )
        best_first = sorted(rivals.items(), key=lambda rival: -rival[1])

        # The same masks with the person in black.
        inverted = [replace(v, mask=~v.mask & v.shown) for v in chosen]

        # Empty masks tell nothing about joints.
        inside = []
        outside = []
        fullness = []
        for view in camera_views:
            fullness.append(view.fullness)
            if view.mask.any():
                inside.append(view.inside)
                outside.append(view.distance)

        scores.append(
            CameraScore(
                name,
                inside=mean_of_known(inside),
                overlap=_fit(subject, chosen, camera),
                fullness=float(np.median(fullness)),
                rivals=dict(best_first),
                outside=mean_of_known(outside),
                inverted=_fit(subject, inverted, camera),
                filled=float(np.median([view.filled for view in camera_views])),
                others=float(
                    np.mean([v.other_piece > OTHER_PIECE for v in camera_views])
                ),
            )
        )
    return scores


def calibrations(
    calibration: CameraEntry,
    cameras: Mapping[str, CameraEntry],
) -> Iterator[tuple[str, CameraEntry]]:
    """Other calibrations that a camera may have: mirrored, and those of other cameras.

    Of another camera either R and t are exchanged, or the whole calibration.
    """
    # u becomes width - u.
    mirror = calibration.K.copy()
    mirror[0] = -mirror[0]
    mirror[0, 2] += calibration.size[1]
    yield MIRRORED_IMAGES, replace(calibration, K=mirror)
    for name, other in cameras.items():
        if name != calibration.name:
            yield name, replace(calibration, R=other.R, t=other.t)
            yield name, other


def _fit(
    subject: CheckedData, views: Sequence[MaskView], camera: CameraEntry
) -> float:
    """Mean overlap of the masks with the silhouettes estimated for a camera."""
    overlaps = []
    for view in views:
        # The silhouette that this camera would see.
        row = subject.rows[view.frame]
        body = body_silhouette(
            view.small(camera),
            subject.p[row],
            subject.visible[row],
            subject.template,
        )
        overlaps.append(overlap(view.mask, body))
    return float(np.mean(overlaps))


def mean_of_known(values: Sequence[float]) -> float:
    """The mean of the values that are not NaN; NaN if there are none."""
    array = np.array(values)
    finite = array[~np.isnan(array)]
    return float(finite.mean()) if len(finite) else np.nan


def calibration_findings(
    scores: Sequence[CameraScore],
    limits: Limits,
    min_inside: float,
    named: Iterable[str] = (),
) -> list[Finding]:
    """Findings on wrong cameras and the usual causes; other findings name ``named`` already."""
    findings = list[Finding]()
    named = set(named)

    # Masks far larger than the body: one finding for all of them, which then do not count.
    big = [s for s in scores if s.is_oversized(limits) and s.name not in named]
    if big:
        # One sentence names all of them with their sizes.
        sizes = []
        for score in big:
            sizes.append(f"{score.name} {score.fullness:.1f}")
            named.add(score.name)
        text = (
            f"masks are far larger than the body (times its area: {list_names(sizes)}): a focal "
            "length that is too short, K of smaller images, a skeleton in another unit, or "
            "masks of more"
        )
        findings.append(Finding("error", TOPIC, text))
        scores = [score for score in scores if score not in big]

    # Pairs that fit better with each other's calibration.
    beaten = [score for score in scores if score.beaten(limits)]
    for one, other in combinations(beaten, 2):
        if one.name in named or other.name in named:
            continue
        if _are_exchanged(one, other, limits):
            text = (
                f"cameras {one.name} and {other.name} look exchanged: the R and t of the other "
                f"would fit the masks better (overlap {one.rivals[other.name]:.2f} and "
                f"{other.rivals[one.name]:.2f}, its own {one.overlap:.2f} and {other.overlap:.2f});"
                " exchange them in the calibration, or rename the folders"
            )
            findings.append(Finding("error", TOPIC, text))
            named.update((one.name, other.name))

    # All cameras are off, so no single one is the cause.
    off = [score for score in scores if not score.inside >= min_inside]
    if len(scores) > 1 and not beaten and not big and off == scores:
        shares = list_names(
            f"{score.name} {percent(score.inside)}" for score in scores
        )
        text = (
            f"in every camera joints lie outside the masks (inside: {shares}): axes, unit, size or "
            "frame numbers of the skeleton are wrong, K does not follow a crop, or the masks "
            "belong to other images"
        )
        wrong = any(score.wrong(limits) for score in scores)
        return [Finding("error" if wrong else "warning", TOPIC, text)]

    # Cameras that are off by themselves, then those that are slightly off.
    fine = []
    for score in scores:
        if score.name in named:
            continue
        finding = _of_one(score, scores, limits, min_inside)
        if finding:
            findings.append(finding)
        else:
            fine.append(score)
    return findings + small_errors(fine, limits)


def mask_findings(
    scores: Sequence[CameraScore], limits: Limits
) -> list[Finding]:
    """Findings on masks that are wrong in themselves: empty, white, inverted, of another person."""
    # In all cameras: then nothing else can be told. One camera has a finding of its own.
    names = list_names(score.name for score in scores)
    wrong = "every mask must be white where the person is, and black elsewhere"
    if scores and all(score.filled == 0 for score in scores):
        text = f"all masks are empty ({names}); {wrong}"
        return [Finding("error", TOPIC, text)]

    # White everywhere, or inverted.
    findings = []
    full = [score.name for score in scores if score.filled > FULL_MASK]
    if full:
        text = f"masks are white everywhere ({list_names(full)}); {wrong}"
        findings.append(Finding("error", TOPIC, text))
    inverted = []
    for score in scores:
        limit = max(score.overlap + limits.better_fit, CREDIBLE_OVERLAP)
        if score.inverted > limit and score.name not in full:
            inverted.append(
                f"{score.name} {score.inverted:.2f}, as they are {score.overlap:.2f}"
            )
    if inverted:
        text = (
            f"the inverted masks would fit (overlap: {list_names(inverted)}): the person must be "
            "white and the background black; invert them"
        )
        findings.append(Finding("error", TOPIC, text))

    # A second body.
    several = []
    for score in scores:
        if score.others > OTHER_IMAGES:
            several.append(f"{score.name} {score.others:.0%}")
    if several:
        text = (
            "masks have a second piece, as large as a person, that holds no joint (of the images: "
            f"{list_names(several)}): another person, whom training would learn as well; remove it "
            "from the masks"
        )
        findings.append(Finding("warning", TOPIC, text))
    return findings


def _are_exchanged(
    one: CameraScore, other: CameraScore, limits: Limits
) -> bool:
    """Whether each of two cameras is among those that fit the other's masks best."""
    first = other.name in one.close_rivals(limits)
    return first and one.name in other.close_rivals(limits)


def _of_one(
    score: CameraScore,
    scores: Sequence[CameraScore],
    limits: Limits,
    min_inside: float,
) -> Finding | None:
    """The finding on one camera; None if nothing is wrong."""
    seen = f"{percent(score.inside)} of the joints lie inside its masks"
    if len(scores) > 1:
        others = mean_of_known([s.inside for s in scores if s is not score])
        seen += f", {others:.0%} in the other cameras"

    # Another calibration fits better, or joints lie outside the masks.
    error = not score.inside >= limits.inside_error
    if score.beaten(limits):
        error = True

        # The rivals by name; mirrored images are a case of their own.
        names = []
        advice = "check its R, t and folder name"
        rivals = score.close_rivals(limits)
        for rival in rivals:
            mirrored = rival == MIRRORED_IMAGES
            names.append(rival if mirrored else f"the calibration of {rival}")
        if MIRRORED_IMAGES in rivals:
            other = f", or {advice}" if len(rivals) > 1 else ""
            advice = f"mirror its images and masks back{other}"
        text = (
            f"{' or '.join(names)} would fit its masks better (overlap {score.best_rival:.2f}) "
            f"than its own calibration ({score.overlap:.2f}); {seen}; {advice}"
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
        "error" if error else "warning",
        TOPIC,
        f"camera {score.name}: {text}",
    )


def small_errors(
    scores: Sequence[CameraScore], limits: Limits
) -> list[Finding]:
    """Findings on cameras, of those without other ones, whose joints lie just outside the masks."""
    metres = {s.name: s.outside for s in scores if np.isfinite(s.outside)}

    # Most cameras are off: the cause is common to them.
    middle = float(np.median(list(metres.values()) or [0]))
    if middle > OUTSIDE_ALL * limits.outside:
        text = (
            f"in most cameras joints lie {100 * middle:.1f} cm outside the masks on average (good "
            "captures: 0.1): focal lengths or unit slightly off, tight masks, or noisy landmarks"
        )
        return [Finding("warning", TOPIC, text)]

    # One camera is off much more than the others.
    findings = []
    for name, distance in metres.items():
        rest = [value for other, value in metres.items() if other != name]
        others = float(np.median(rest)) if rest else np.inf
        if distance > max(limits.outside, OUTSIDE_RATIO * others):
            text = (
                f"camera {name}: joints lie {100 * distance:.1f} cm outside its masks on average, "
                f"{100 * others:.1f} in the other cameras; its R, t or focal length is slightly off"
            )
            findings.append(Finding("warning", TOPIC, text))
    return findings
