"""The posed person seen through a lens, with glossy clothes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsgan.data.synthetic.scenes.lens import LensView
from gsgan.data.synthetic.trace import GAMMA, Array, Ints, Light, Person, PosedPerson, View

SHIRT, TROUSERS, SHOE = 3, 4, 5


@dataclass(frozen=True)
class Gloss:
    """A highlight of the sun (Blinn-Phong) over the matt colour.

    Args:
        strength: its peak, as a share of the sun's strength.
        shininess: exponent of its lobe; 12 falls to half within about 19 degrees.
        surfaces: which are glossy, as the free body's asset counts them.
    """

    strength: float
    shininess: float = 12.0
    surfaces: tuple[int, ...] = (SHIRT, TROUSERS, SHOE)


class PhotographedPerson(PosedPerson):
    """One moment, as a scene's cameras see it.

    Args:
        person, vertices, flexion, light: as of :class:`PosedPerson`.
        gloss: None for matt clothes.
    """

    def __init__(
        self, person: Person, vertices: Array, flexion: Array, light: Light, gloss: Gloss | None
    ) -> None:
        super().__init__(person, vertices, flexion, light)
        self.gloss = gloss
        self._view: View | None = None

    def render(self, view: View, rays: int) -> tuple[Array, Array, Ints]:
        """As of :class:`PosedPerson`, through the view's lens where it has one."""
        self._view = view
        return super().render(view, rays)

    def _shoot(self, origin: Array, directions: Array) -> tuple[Ints, Array]:
        if isinstance(self._view, LensView):
            directions = self._view.bend(directions)
        return super()._shoot(origin, directions)

    def _shade(self, face: Ints, uv: Array, directions: Array) -> Array:
        colour = super()._shade(face, uv, directions)
        if self.gloss is None:
            return colour
        shiny = np.isin(self.person.surface[face], self.gloss.surfaces)
        extra = self._highlight(self.gloss, face[shiny], uv[shiny], directions[shiny])
        linear = colour[shiny] ** GAMMA + extra[:, None]
        colour[shiny] = np.clip(linear, 0, 1) ** (1 / GAMMA)
        return colour

    def _highlight(self, gloss: Gloss, face: Ints, uv: Array, directions: Array) -> Array:
        """``[N]`` linear light that surface points mirror into the rays that hit them."""
        corners = self.person.faces[face]
        weight = np.concatenate([1 - uv.sum(axis=1, keepdims=True), uv], axis=1)[:, :, None]
        here = (weight * self.vertices[corners]).sum(axis=1)
        normal = _unit((weight * self.normals[corners]).sum(axis=1))
        normal *= np.where((normal * directions).sum(axis=1) > 0, -1.0, 1.0)[:, None]
        sun = np.asarray(self.light.direction) / np.linalg.norm(self.light.direction)
        facing: NDArray[np.bool_] = normal @ sun > 0
        lit = self._lit(here + self.light.shadow_offset * normal, sun, facing)
        halfway = _unit(sun - directions)
        lobe = np.maximum((normal * halfway).sum(axis=1), 0) ** gloss.shininess
        return gloss.strength * self.light.sun * lit * lobe


def _unit(x: Array) -> Array:
    return x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-12)
