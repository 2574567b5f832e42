"""Optional effects: each decided once from the training split, with the reason recorded."""

from gsgan.effects.decide import EffectSettings, ModelParts, decide
from gsgan.effects.record import EFFECT_NAMES, Effect, Effects

__all__ = [
    "EFFECT_NAMES",
    "Effect",
    "EffectSettings",
    "Effects",
    "ModelParts",
    "decide",
]
