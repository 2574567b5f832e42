"""What a scene calls for: each effect decided once, from the training split, and said why."""

from gsgan.effects.decide import decide
from gsgan.effects.record import NAMES, Effect, Effects
from gsgan.effects.settings import EffectSettings

__all__ = ["NAMES", "Effect", "EffectSettings", "Effects", "decide"]
