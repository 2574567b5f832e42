"""The rules: what the training split says, and the user wishes, to one decision an effect.

Each rule takes the scene, the settings and the user's word, and returns the effect. A word that
the scene makes impossible raises `Impossible`, which becomes one sentence or leaves the effect off.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from gsgan.effects.record import OFF, Effect, Effects
from gsgan.effects.settings import AUTO, CHOICES, EffectSettings
from gsgan.utils.errors import ConfigError

if TYPE_CHECKING:
    from gsgan.data.scene_info import SceneInfo

FORCED = "the config says so"
TOO_LITTLE = "too little surface is shared by two cameras, or pictures are too coarse, to tell"


class Impossible(Exception):
    """An effect that this scene cannot have, and why."""


def decide(info: SceneInfo, settings: EffectSettings) -> Effects:
    """What this scene calls for.

    Convention: pure; what the model lacks is taken out later (`gsgan.model.avatar`).

    Args:
        info: what the training split tells about the scene.
        settings: the user's words and the thresholds.

    Raises:
        ConfigError: when an effect is forced that the scene cannot have.
    """
    found = {name: _one(name, info, settings) for name in CHOICES}
    cameras = info.train_cameras if found["colour_correction"].on else ()
    return Effects(**found, cameras=cameras)


def _one(name: str, info: SceneInfo, settings: EffectSettings) -> Effect:
    wish = settings.wish(name)
    none: str | int = 0 if name == "view_dependence" else OFF
    if wish in (OFF, 0):
        return Effect(none, FORCED)
    try:
        effect = _RULES[name](info, settings, wish)
    except Impossible as reason:
        if settings.impossible == "error":
            raise ConfigError(f"effects.{name}={wish} is not possible: {reason}") from None
        return Effect(none, str(reason))
    # the model, too, may lack what an effect needs
    return replace(effect, forced=effect.forced and settings.impossible == "error")


def _view_dependence(info: SceneInfo, settings: EffectSettings, wish: str | int) -> Effect:
    if isinstance(wish, int):
        return Effect(wish, FORCED, forced=True)
    cameras, degree = info.n_train_cameras, most_degree(info, settings)
    if wish == "on":
        return Effect(max(1, degree), f"{FORCED}; {cameras} training cameras", forced=True)
    if degree == 0 and cameras < settings.degree_cameras[0]:
        return Effect(0, f"{cameras} training camera sees every moment from one side only")
    if degree == 0:
        return Effect(0, f"the training cameras stand within {info.spread:.0f} degrees")
    if info.surface is None:
        return Effect(0, TOO_LITTLE)
    left, limit = info.surface.residual, settings.view_residual
    if left < limit:
        return Effect(0, f"shared surface looks alike to {left:.3f} (limit {limit:g})")
    why = f"shared surface differs by {left:.3f} (limit {limit:g}); {cameras} cameras"
    return Effect(degree, why)


def most_degree(info: SceneInfo, settings: EffectSettings) -> int:
    """The degree that so many cameras so far apart can tell, 0 to 3."""
    if info.spread < settings.view_spread:
        return 0
    return sum(info.n_train_cameras >= count for count in settings.degree_cameras)


def _distortion(info: SceneInfo, settings: EffectSettings, wish: str | int) -> Effect:
    if not (info.has_distortion or info.held_out_distortion):
        if wish != AUTO:
            raise Impossible("no camera of this data has a lens coefficient other than zero")
        return Effect(OFF, "all lens coefficients are zero")
    if wish == "project":
        if info.has_rational_lens:
            if settings.impossible == OFF:  # data.capture does the same
                return Effect("undistort", "a lens has k4, k5 or k6, which painting does not know")
            raise Impossible(
                "a lens has coefficients beyond the fifth (k4, k5, k6), which painting does not "
                "know; choose effects.distortion=undistort"
            )
        return Effect(
            "project", "pictures stay as taken: what is painted follows the lens", forced=True
        )
    why = "a lens coefficient is not zero: pictures are undistorted on reading"
    return Effect("undistort", why if wish == AUTO else FORCED, forced=wish != AUTO)


def _antialias(info: SceneInfo, settings: EffectSettings, wish: str | int) -> Effect:
    if wish != AUTO:
        return Effect("on", FORCED, forced=True)
    if info.scale_test is None:
        return Effect(OFF, "nothing is held out to differ in scale")
    (low, high), (least, most) = info.scale_train, info.scale_test
    ratio = max(most / high, low / least)
    said = f"held-out pictures have {ratio:.2f} times the scale of training's"
    if ratio < settings.scale_ratio:
        return Effect(OFF, f"{said} at most (limit {settings.scale_ratio:g})")
    return Effect("on", f"{said} or its inverse (limit {settings.scale_ratio:g})")


def _colour_correction(info: SceneInfo, settings: EffectSettings, wish: str | int) -> Effect:
    if info.n_train_cameras < 2:
        if wish != AUTO:
            raise Impossible("one training camera has no other to agree with")
        return Effect(OFF, "one training camera has no other to agree with")
    if wish != AUTO:
        return Effect("on", FORCED, forced=True)
    seen = info.surface
    if seen is None:
        return Effect(OFF, TOO_LITTLE)
    said = f"two cameras differ by {seen.difference:.3f} on shared surface"
    noise = max(settings.colour_share * seen.residual, settings.colour_errors * seen.error)
    if seen.difference < settings.colour_difference:
        return Effect(OFF, f"{said} at most (limit {settings.colour_difference:g})")
    if seen.difference < noise:
        return Effect(OFF, f"{said}, which highlights or chance explain (limit {noise:.3f})")
    return Effect("on", f"{said} (limit {max(noise, settings.colour_difference):.3f})")


def _body_points(info: SceneInfo, settings: EffectSettings, wish: str | int) -> Effect:
    if not info.has_body_pose:
        if wish != AUTO:
            raise Impossible("the data has no body pose")
        return Effect(OFF, "the data has no body pose")
    if wish != AUTO:
        return Effect("on", FORCED, forced=True)
    if info.body_inside is None:
        return Effect(OFF, "the body's mesh is not at hand")
    said = f"{100 * info.body_inside:.0f} % of the posed body lies inside the masks"
    limit = f"limit {100 * settings.body_inside:g} %"
    if info.body_inside < settings.body_inside:
        return Effect(OFF, f"{said} ({limit}): the skeleton is trusted more")
    return Effect("on", f"{said} ({limit})")


def _random_background(info: SceneInfo, settings: EffectSettings, wish: str | int) -> Effect:
    if wish != AUTO:
        return Effect("on", FORCED, forced=True)
    said = f"the person's darkest percent has brightness {info.darkest:.2f}"
    if info.darkest < settings.dark:
        return Effect("on", f"{said} (limit {settings.dark:g}): on black it could turn transparent")
    return Effect(OFF, f"{said} (limit {settings.dark:g})")


_RULES: dict[str, Callable[[SceneInfo, EffectSettings, str | int], Effect]] = {
    "view_dependence": _view_dependence,
    "distortion": _distortion,
    "antialias": _antialias,
    "colour_correction": _colour_correction,
    "body_points": _body_points,
    "random_background": _random_background,
}
