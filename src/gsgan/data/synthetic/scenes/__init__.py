"""The default person photographed otherwise: scenes that call for an effect.

They lie beside the generator rather than in it: the default person's code, and with it the key of
its cache, does not change when a scene does.
"""

from gsgan.data.synthetic.scenes.make import ensure_scene
from gsgan.data.synthetic.scenes.options import SceneOptions

__all__ = ["SceneOptions", "ensure_scene"]
