"""Whose calibration is wrong, and what that usually means: the cameras' scores in sentences."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import combinations

import numpy as np

from gsgan.check.calibration import (
    EXTRINSICS,
    INVERSE,
    MIRRORED,
    WHOLE,
    CameraScore,
    Rival,
    known_mean,
)
from gsgan.check.findings import Finding, Level, listed
from gsgan.check.settings import Limits

SHARE_OF_ANY_CAMERA = 0.5  # of a standing person's joints lie in the mask whatever camera is taken
ADVICE = {
    MIRRORED: "mirror its pictures and masks back",
    INVERSE: "invert its R and t: x_cam = R x + t is expected",
    EXTRINSICS: "check its R, t and folder name",
    WHOLE: "check its calibration and folder name",
}


def beaten(score: CameraScore, limits: Limits) -> bool:
    """Whether another calibration explains the masks better, and well."""
    margin = score.overlap + limits.better_fit
    return score.rival_overlap > max(margin, limits.credible_overlap)


def shifted(score: CameraScore, limits: Limits) -> bool:
    """Whether the masks lie beside the skeleton, by more than bodies and skeletons differ."""
    gain = score.shift_overlap - score.overlap
    return score.shift_metres > limits.shift and gain > limits.better_fit


def oversized(score: CameraScore, limits: Limits) -> bool:
    """Whether the masks are far larger than the body, and that body lies in them for the most."""
    return score.fullness > limits.fullness and score.inside > SHARE_OF_ANY_CAMERA


def wrong_cameras(scores: Sequence[CameraScore], limits: Limits) -> frozenset[str]:
    """The cameras whose calibration or masks are wrong as a whole."""
    return frozenset(
        s.name
        for s in scores
        if not s.inside >= limits.inside_error or beaten(s, limits) or oversized(s, limits)
    )


def misfits(scores: Sequence[CameraScore], limits: Limits) -> frozenset[str]:
    """The cameras whose masks do not fit the skeleton as a whole, for whatever reason."""
    beside = frozenset(s.name for s in scores if shifted(s, limits) or s.lag)
    return beside | wrong_cameras(scores, limits)


def judge_cameras(
    scores: Sequence[CameraScore], limits: Limits, told: Iterable[str] = ()
) -> list[Finding]:
    """What is wrong with which camera, and what that usually means.

    Args:
        scores: of all cameras.
        limits: from where on something is wrong.
        told: cameras of which a plainer reason was told already.
    """
    found, told = list[Finding](), set(told)
    big = [s for s in scores if oversized(s, limits) and s.name not in told]
    if big:
        found.append(_oversized(big))
        told |= {s.name for s in big}
        scores = [s for s in scores if s not in big]
    best = {s.name: s for s in scores if beaten(s, limits)}
    for one, other in combinations(best.values(), 2):
        ours, theirs = _claim(one, other, limits), _claim(other, one, limits)
        if ours and theirs and not {one.name, other.name} & told:
            found.append(_swapped((one, ours), (other, theirs)))
            told |= {one.name, other.name}
    wrong = wrong_cameras(scores, limits)
    together = len(scores) > 1 and not big
    if together and not best and len(wrong) == len(scores):
        return [_all_wrong(scores, limits)]
    if together and all(shifted(s, limits) for s in scores):
        return [_all_beside(scores, "error" if wrong else "warning")]
    for score in scores:
        if score.name in best and score.name not in told:
            found.append(_explained(score, scores, limits))
        elif score.lag:
            found.append(_out_of_step(score))
        elif score.name not in told:
            found += _unexplained(score, scores, limits)
    blamed = told | misfits(scores, limits)
    return found + judge_small(scores, limits, blamed)


def _oversized(big: Sequence[CameraScore]) -> Finding:
    names = listed(f"{s.name} {s.fullness:.1f}" for s in big)
    return Finding(
        "error", "calibration",
        "masks are far larger than the body that skeleton and camera foretell (times its area: "
        f"{names}): a focal length that is too short, K of smaller pictures, a skeleton in another "
        "unit, or masks of more than the person",
    )  # fmt: skip


def _seen(score: CameraScore, scores: Sequence[CameraScore]) -> str:
    others = known_mean([s.inside for s in scores if s.name != score.name])
    seen = f"{score.inside:.0%} of the joints lie inside its masks"
    return f"{seen}, {others:.0%} in the other cameras" if len(scores) > 1 else seen


def _claim(score: CameraScore, other: CameraScore, limits: Limits) -> Rival | None:
    """The other camera's calibration, where it explains the masks about as well as anything."""
    for rival in score.rivals:
        if rival.other == other.name and rival.overlap > score.rival_overlap - limits.better_fit:
            return rival
    return None


def _explained(score: CameraScore, scores: Sequence[CameraScore], limits: Limits) -> Finding:
    best = score.rivals[0]
    close = [r for r in score.rivals if r.overlap > best.overlap - limits.better_fit]
    what = dict.fromkeys(f"{r.kind} {r.other}".strip() for r in close)
    kinds = {rival.kind for rival in close}
    advice = [text for kind, text in ADVICE.items() if kind in kinds]
    return Finding(
        "error", "calibration",
        f"camera {score.name}: {' or '.join(what)} would fit its masks better (overlap "
        f"{best.overlap:.2f}) than its own calibration ({score.overlap:.2f}); "
        f"{_seen(score, scores)}; {', or '.join(dict.fromkeys(advice))}",
    )  # fmt: skip


def _unexplained(
    score: CameraScore, scores: Sequence[CameraScore], limits: Limits
) -> list[Finding]:
    if np.isnan(score.inside):
        text = (
            f"camera {score.name}: its masks are empty, or no joint lies in its pictures; check "
            "both folders and K"
        )
        return [Finding("error", "calibration", text)]
    level: Level = "error" if not score.inside >= limits.inside_error else "warning"
    if shifted(score, limits):
        text = (
            f"camera {score.name}: its masks lie {_pixels(score)} pixels (right, down) beside the "
            f"skeleton; {_seen(score, scores)}. A crop or resize that K does not follow, or masks "
            "of other pictures, do this"
        )
    elif not score.inside >= limits.inside_warning:
        text = (
            f"camera {score.name}: only {_seen(score, scores)}. One camera alone points to its "
            "extrinsics, to exchanged folder names, to lens distortion left out, or to masks of "
            "other pictures; look at its overlays"
        )
    else:
        return []
    return [Finding(level, "calibration", text)]


def _pixels(score: CameraScore) -> str:
    return f"{score.shift[0]:+.0f}, {score.shift[1]:+.0f}"


def _swapped(one: tuple[CameraScore, Rival], other: tuple[CameraScore, Rival]) -> Finding:
    (a, of_a), (b, of_b) = one, other
    what = "R and t" if of_a.kind == EXTRINSICS else "calibration"
    return Finding(
        "error", "calibration",
        f"cameras {a.name} and {b.name} look exchanged: the {what} of the other would fit the "
        f"masks of each better (overlap {of_a.overlap:.2f} and {of_b.overlap:.2f}) than its own "
        f"({a.overlap:.2f} and {b.overlap:.2f}); exchange them in the calibration, or rename the "
        "folders",
    )  # fmt: skip


def _all_beside(scores: Sequence[CameraScore], level: Level) -> Finding:
    return Finding(
        level, "calibration",
        "in every camera the masks lie beside the skeleton, by pixels right, down: "
        f"{listed(f'{s.name} {_pixels(s)}' for s in scores)}; the skeleton is moved or of another "
        "size, or pictures were cropped and K did not follow",
    )  # fmt: skip


def _all_wrong(scores: Sequence[CameraScore], limits: Limits) -> Finding:
    if all(shifted(s, limits) for s in scores):
        return _all_beside(scores, "error")
    return Finding(
        "error", "calibration",
        f"in every camera joints lie outside the masks (inside: "
        f"{listed(f'{s.name} {s.inside:.0%}' for s in scores)}): the skeleton's axes, unit or "
        "frame numbers do not fit the cameras, or the masks belong to other pictures",
    )  # fmt: skip


def _out_of_step(score: CameraScore) -> Finding:
    when = "later" if score.lag > 0 else "earlier"
    return Finding(
        "error", "synchronisation",
        f"camera {score.name}: its pictures fit the skeleton {abs(score.lag)} frame(s) {when} "
        f"better (joints {100 * score.lag_outside:.1f} cm outside the masks instead of "
        f"{100 * score.outside:.1f}); its clock or its numbering is off: add {score.lag:+d}",
    )  # fmt: skip


def judge_small(
    scores: Sequence[CameraScore], limits: Limits, told: Iterable[str] = ()
) -> list[Finding]:
    """Calibrations that are nearly right: joints lie just outside the masks.

    Args:
        scores: of all cameras.
        limits: from where on something is wrong.
        told: cameras of which a plainer reason was told already.
    """
    told = set(told)
    left = {s.name: s for s in scores if np.isfinite(s.outside) and s.name not in told}
    if left and np.median([s.outside for s in left.values()]) > limits.outside_all:
        return [_all_outside(float(np.median([s.outside for s in left.values()])))]
    found = list[Finding]()
    for name, score in left.items():
        rest = [s.outside for other, s in left.items() if other != name]
        others = float(np.median(rest)) if rest else np.inf
        if score.outside > max(limits.outside, limits.outside_ratio * others):
            found.append(_just_outside(score, others))
    return found


def _all_outside(metres: float) -> Finding:
    return Finding(
        "warning", "calibration",
        f"in most cameras joints lie {100 * metres:.1f} cm outside the masks on the mean (good "
        "captures: 0.1): a focal length or unit that is a little off in all of them, masks that "
        "are too tight, or noisy landmarks",
    )  # fmt: skip


def _just_outside(score: CameraScore, others: float) -> Finding:
    return Finding(
        "warning", "calibration",
        f"camera {score.name}: joints lie {100 * score.outside:.1f} cm outside its masks on the "
        f"mean, {100 * others:.1f} in the other cameras; its R, t or focal length is off by a "
        "little (some degrees, centimetres or per cent), or its masks are worse",
    )  # fmt: skip
