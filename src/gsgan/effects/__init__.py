"""Optional effects: each decided once from the training split, with the reason recorded."""

from gsgan.effects.decide import EffectSettings, ModelParts, decide
from gsgan.effects.record import NAMES, Effect, Effects

__all__ = ["NAMES", "Effect", "EffectSettings", "Effects", "ModelParts", "decide"]
