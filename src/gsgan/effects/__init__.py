"""Optional effects: each decided once from the training split, with the reason recorded."""

from gsgan.effects.decide import ModelParts, decide
from gsgan.effects.record import NAMES, Effect, Effects
from gsgan.effects.settings import EffectSettings

__all__ = ["NAMES", "Effect", "EffectSettings", "Effects", "ModelParts", "decide"]
