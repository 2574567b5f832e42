"""The settings of effects, and the rules that decide each once from the training split."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from gsgan.effects.record import OFF, Effect, Effects
from gsgan.utils.checks import AUTO, is_number, one_of
from gsgan.utils.errors import ConfigError

if TYPE_CHECKING:
    from gsgan.data.scene_info import SceneInfo

ON_OFF = (AUTO, "on", "off")
# Values that each effect may be set to.
CHOICES: dict[str, tuple[str | int, ...]] = {
    "view_dependence": (*ON_OFF, 0, 1, 2, 3),
    "distortion": (*ON_OFF, "undistort", "project"),
    "antialias": ON_OFF,
    "colour_correction": ON_OFF,
    "body_points": ON_OFF,
    "random_background": ON_OFF,
    "registration": ON_OFF,
    "light": ON_OFF,
}

# Reasons that more than one rule gives.
FORCED = "set in the config"
TOO_LITTLE = "the cameras share too little surface, or images are too coarse, to compare colours"
RATIONAL = (
    "a lens has coefficients beyond the fifth (k4, k5, k6), which rendering does not support; "
    "choose effects.distortion=undistort"
)


@dataclass(frozen=True)
class EffectSettings:
    """A requested value per effect, and the thresholds of ``auto``; see conf/effects/auto.yaml.

    ``auto`` decides from the scene, ``off`` builds and computes nothing, any other value forces the
    effect. YAML's bare on and off arrive as true and false and are accepted.

    Raises:
        ConfigError: on a value that is not allowed, naming it.
    """

    # The requested values.
    view_dependence: str | int | bool
    distortion: str | bool
    antialias: str | bool
    colour_correction: str | bool
    body_points: str | bool
    random_background: str | bool
    registration: str | bool
    light: str | bool

    # Restrictions of all of them, and what happens to a forced effect that is not possible.
    only: Sequence[str] | None
    impossible: str | bool

    # Thresholds of ``auto``.
    view_residual: float
    rendered_scales: Sequence[float]
    degree_cameras: Sequence[int]
    colour_difference: float
    colour_share: float
    scale_ratio: float
    dark: float
    body_inside: float
    texture: float
    pixels_per_metre: float
    degrees_seen: float

    def __post_init__(self) -> None:
        # Each requested value is one of the effect's.
        for name in CHOICES:
            value = getattr(self, name)
            # YAML reads a bare on or off as a truth value.
            if isinstance(value, bool):
                value = "on" if value else "off"
            object.__setattr__(
                self, name, one_of(f"effects.{name}", value, CHOICES[name])
            )
        if self.impossible is False:  # YAML's off
            object.__setattr__(self, "impossible", "off")
        one_of("effects.impossible", self.impossible, ("error", "off"))

        # Lists must have the right length and order.
        counts = list(self.degree_cameras)
        if len(counts) != 3 or counts != sorted(counts):
            raise ConfigError(
                f"effects.degree_cameras must be three rising numbers, got {counts}"
            )
        scales = list(self.rendered_scales)
        numbers = len(scales) == 2 and all(map(is_number, scales))
        if not numbers or not 0 < scales[0] <= scales[1]:
            raise ConfigError(
                f"effects.rendered_scales must be two rising positive numbers, got {scales}"
            )

        # A single name is a mistake: its letters would be taken for effects.
        listed = (
            [self.only] if isinstance(self.only, str) else list(self.only or ())
        )
        if isinstance(self.only, str) or set(listed) - set(CHOICES):
            raise ConfigError(
                f"effects.only must list some of {', '.join(CHOICES)}; got {listed}"
            )

    def value_of(self, name: str) -> str | int:
        """The value requested for an effect, with ``only`` taken into account."""
        # Without `only` every effect is as requested.
        value: str | int = getattr(self, name)
        if self.only is None:
            return value

        # Effects that are not listed are off, but for the lens, which is the camera's.
        if name not in self.only:
            return value if name == "distortion" else "off"

        # Listed effects are on.
        return "on" if value in (AUTO, "off", 0) else value


@dataclass(frozen=True)
class ModelParts:
    """The parts of a model that effects need; the default is the full model.

    Args:
        splats: it renders Gaussians.
        points: it places Gaussians on the skeleton.
        network: Ψ is a network.
        body_points: its config has a part that places them on a body instead.
    """

    splats: bool = True
    points: bool = True
    network: bool = True
    body_points: bool = True

    def lacks(self, effect: str) -> str | None:
        """The reason why the model cannot have an effect; None if it can."""
        # Images are undistorted before any model sees them.
        if effect == "distortion":
            return None
        if effect == "body_points":
            if not self.points:
                return "this model has no points on the skeleton"
            return None if self.body_points else "the model leaves them out"
        if effect == "light" and not self.network:
            return "this model has no Ψ that is a network"
        # All other effects are of Gaussians.
        return None if self.splats else "this model has no Gaussians"


def decide(
    info: SceneInfo, settings: EffectSettings, model: ModelParts | None = None
) -> Effects:
    """The effects of a run, decided once from the training split.

    Args:
        info: properties of the scene, computed from the training split.
        settings: requested values and thresholds.
        model: the parts that the model has; None: all.

    Raises:
        ConfigError: when a forced effect is not possible in this scene or model.
    """
    # Registration depends on whether Gaussians are on a body; all others decide by themselves.
    model = model or ModelParts()
    on_body = _one("body_points", info, settings, model)
    effects = {
        name: _one(name, info, settings, model, on_body) for name in CHOICES
    }
    cameras = info.train_cameras if effects["colour_correction"].on else ()
    return Effects(**effects, cameras=cameras)


def _one(
    name: str,
    info: SceneInfo,
    settings: EffectSettings,
    model: ModelParts,
    body_points: Effect | None = None,
) -> Effect:
    # Off by request.
    requested = settings.value_of(name)
    off: str | int = 0 if name == "view_dependence" else OFF
    if requested in (OFF, 0):
        return Effect(off, FORCED)

    # Not possible in this scene or model. Lenses that cannot be rendered are undistorted.
    reason = _impossible(name, info, requested) or model.lacks(name)
    on_body = body_points is not None and body_points.on
    if name == "registration" and not on_body:
        reason = "no Gaussians are on a body"
    if reason is not None:
        if requested != AUTO and settings.impossible == "error":
            raise ConfigError(
                f"effects.{name}={requested} is not possible: {reason}"
            )
        return Effect("undistort" if reason == RATIONAL else off, reason)

    # Decided by rule, or forced; "on" stands for the usual mode or degree.
    if requested == AUTO:
        return _RULES[name](info, settings)
    if name == "distortion" and requested == "on":
        requested = "undistort"
    if name == "view_dependence" and requested == "on":
        requested = max(1, max_degree(info, settings))
    return Effect(requested, FORCED, forced=True)


def _impossible(name: str, info: SceneInfo, requested: str | int) -> str | None:
    """The reason why the scene cannot have an effect; None if it can."""
    # Lenses that are all pinholes need nothing.
    if name == "distortion":
        if not (info.has_distortion or info.held_out_distortion):
            return (
                "no camera of this data has a lens coefficient other than zero"
            )
        return (
            RATIONAL
            if requested == "project" and info.has_rational_lens
            else None
        )

    # Corrections are relative to other cameras.
    if name == "colour_correction" and info.n_train_cameras < 2:
        return "one training camera has no other to differ from"

    # A skinned body needs poses, and a model file unless it is the free one.
    if name == "body_points" and not info.has_body_pose:
        return "the data has no body pose"
    if name == "body_points" and info.body != "free" and info.body_file is None:
        return f"the data's poses are of the body {info.body!r}, of which there is no model file"
    return None


def _view_dependence(info: SceneInfo, settings: EffectSettings) -> Effect:
    # Few cameras see a point from too few sides to resolve its harmonics.
    cameras = info.n_train_cameras
    degree = max_degree(info, settings)
    if degree == 0:
        return Effect(
            0, f"{cameras} training camera sees each moment from one side only"
        )

    # Colours of one surface that differ between cameras after colour correction.
    if info.surface is None:
        return Effect(0, TOO_LITTLE)
    left = info.surface.residual
    limit = settings.view_residual
    if left < limit:
        return Effect(
            0, f"shared surface differs by only {left:.3f} (limit {limit:g})"
        )
    why = f"shared surface differs by {left:.3f} (limit {limit:g}); {cameras} cameras"
    return Effect(degree, why)


def max_degree(info: SceneInfo, settings: EffectSettings) -> int:
    """The highest degree, 0 to 3, that this number of training cameras can resolve."""
    return sum(
        info.n_train_cameras >= count for count in settings.degree_cameras
    )


def _distortion(info: SceneInfo, settings: EffectSettings) -> Effect:
    return Effect(
        "undistort",
        "a lens coefficient is not zero: images are undistorted when read",
    )


def _antialias(info: SceneInfo, settings: EffectSettings) -> Effect:
    # The ratio of the largest to the smallest scale, trained or rendered.
    low, high = info.scale_train
    smallest, largest = settings.rendered_scales
    ratio = max(high * float(largest), high) / min(low * float(smallest), low)
    measured = (
        f"training and rendered images differ by {ratio:.2f} times in scale"
    )
    if ratio < settings.scale_ratio:
        return Effect(
            OFF, f"{measured} at most (limit {settings.scale_ratio:g})"
        )
    return Effect("on", f"{measured} (limit {settings.scale_ratio:g})")


def _colour_correction(info: SceneInfo, settings: EffectSettings) -> Effect:
    seen = info.surface
    if seen is None:
        return Effect(OFF, TOO_LITTLE)

    # Differences that highlights can cause are not the camera's.
    measured = f"two cameras differ by {seen.difference:.3f} on shared surface"
    highlights = settings.colour_share * seen.residual
    if seen.difference < settings.colour_difference:
        return Effect(
            OFF, f"{measured} at most (limit {settings.colour_difference:g})"
        )
    if seen.difference < highlights:
        return Effect(
            OFF,
            f"{measured}, which highlights can cause (limit {highlights:.3f})",
        )
    return Effect(
        "on",
        f"{measured} (limit {max(highlights, settings.colour_difference):.3f})",
    )


def _body_points(info: SceneInfo, settings: EffectSettings) -> Effect:
    if info.body_inside is None:
        return Effect(OFF, "the body's mesh cannot be read")

    # A body that reaches beyond the masks does not fit the person.
    measured = f"{100 * info.body_inside:.0f} % of the posed body lies inside the masks"
    limit = f"limit {100 * settings.body_inside:g} %"
    if info.body_inside < settings.body_inside:
        return Effect(OFF, f"{measured} ({limit}): the skeleton fits better")
    return Effect("on", f"{measured} ({limit})")


def _random_background(info: SceneInfo, settings: EffectSettings) -> Effect:
    # Dark clothes on black look the same whether they are painted or transparent.
    measured = f"the person's darkest percent has brightness {info.darkest:.2f}"
    limit = f"limit {settings.dark:g}"
    if info.darkest < settings.dark:
        return Effect(
            "on", f"{measured} ({limit}): on black it could turn transparent"
        )
    return Effect(OFF, f"{measured} ({limit})")


def _registration(info: SceneInfo, settings: EffectSettings) -> Effect:
    # One camera sees no depth: its flow moves surface sideways that should move towards it.
    if info.n_train_cameras < 2:
        return Effect(OFF, "one training camera does not see depth")

    # The body's surface is off by less than a coarse pixel.
    scale = info.scale_train[1]
    if scale < settings.pixels_per_metre:
        return Effect(
            OFF,
            f"training images have {scale:.0f} pixels per metre (limit "
            f"{settings.pixels_per_metre:g}): the body's surface is off by less than a pixel",
        )

    # Flow follows fine print; plain cloth gives it nothing to follow.
    measured = f"the person's texture is {info.texture:.2f} on average"
    limit = f"limit {settings.texture:g}"
    if info.texture < settings.texture:
        return Effect(OFF, f"{measured} ({limit}): little that flow can follow")
    return Effect("on", f"{measured} ({limit})")


def _light(info: SceneInfo, settings: EffectSettings) -> Effect:
    # Seen from few sides, too few directions of normals are seen to find the light.
    measured = (
        f"the person is seen from {info.degrees_seen} of 360 degrees "
        f"(limit {settings.degrees_seen:g})"
    )
    if info.degrees_seen < settings.degrees_seen:
        return Effect(OFF, measured)
    return Effect("on", measured)


# The rule that decides each effect if its value is `auto`.
_RULES: dict[str, Callable[[SceneInfo, EffectSettings], Effect]] = {
    "view_dependence": _view_dependence,
    "distortion": _distortion,
    "antialias": _antialias,
    "colour_correction": _colour_correction,
    "body_points": _body_points,
    "random_background": _random_background,
    "registration": _registration,
    "light": _light,
}
