"""The former tracer of the procedural person, until scenes are wired to trace.py.

An independent renderer: splatting takes no part in making the training data.

Convention: metres, world frame; OpenCV cameras and lenses, pixel centres at +0.5; images are RGB,
sRGB in [0, 1], premultiplied on black.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsgan.data.crop import distort
from gsgan.data.synthetic.identity import Identity, Marks, albedo
from gsgan.utils.errors import ConfigError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

GAMMA = 2.2
SHIRT, TROUSERS, SHOE = 3, 4, 5  # materials of the free body's asset
SHININESS = 12.0  # exponent of the highlight's lobe: falls to half within about 19 degrees
EXACT = 1e-10  # residual of x/z up to which an undistorted point counts as found
FURTHEST = 10.0  # bound of x/z in the search
TINT_STREAM = 77
CROSSTALK = 0.25  # leak from channel to channel, as a share of the tint
OFFSET = 0.25  # largest offset of a channel, as a share of the tint


@dataclass(frozen=True)
class Light:
    """A sun and a sky, and how clothes reflect them."""

    direction: tuple[float, float, float] = (0.5, -0.75, 0.9)  # towards the sun, any length
    sun: float = 0.85  # strength
    sky: float = 0.62  # ambient strength from above
    ground: float = 0.36  # ambient strength from below
    shadow_offset: float = 2e-3  # metres along the normal to shadow rays; less gives speckles
    fold: float = 0.38  # share of the light that a fold at full flexion removes or adds
    fold_period: float = 0.045  # metres from one fold to the next
    fold_reach: float = 0.12  # metres over which a joint's folds fade
    gloss: float = 0.0  # highlight (Blinn-Phong) of shirt, trousers and shoes, as a share of sun


@dataclass(frozen=True)
class Person:
    """The part of the person that is constant over frames."""

    vertices: Array  # [V, 3] rest positions
    faces: Ints  # [F, 3]
    labels: Ints  # [F] part of each face
    surface: Ints  # [F] material of each face
    fold_centre: Array  # [K, 3] rest positions of the joints that crease clothes
    fold_axis: Array  # [K, 3] unit directions across their folds
    identity: Identity
    marks: Marks


@dataclass(frozen=True)
class View:
    """A camera: ``K [3, 3]``, ``R [3, 3]``, ``t [3]``, ``size`` (H, W), lens ``dist`` or None."""

    K: Array
    R: Array
    t: Array
    size: tuple[int, int]
    dist: Array | None = None  # [4, 5 or 8] OpenCV's coefficients

    @property
    def centre(self) -> Array:
        return -self.R.T @ self.t

    def project(self, points: Array) -> Array:
        """``[N, 2]`` pixels of world points ``[N, 3]``, all in front of the camera."""
        x = points @ self.R.T + self.t
        if self.dist is not None:
            shown = distort(x[:, :2] / x[:, 2:], self.dist)
            return shown @ self.K[:2, :2].T + self.K[:2, 2]
        x = x @ self.K.T
        return x[:, :2] / x[:, 2:]

    def bend(self, directions: Array) -> Array:
        """The unit world rays ``[N, 3]`` seen where a pinhole sees the unit ``directions``.

        Raises:
            ConfigError: when the distortion cannot be inverted there.
        """
        if self.dist is None:
            return directions
        rays = directions @ self.R.T
        straight = undistort(rays[:, :2] / rays[:, 2:], self.dist)
        return _unit(np.concatenate([straight, np.ones((len(rays), 1))], axis=1) @ self.R)


def undistort(points: Array, dist: Array, iterations: int = 200) -> Array:
    """The inverse of `gsgan.data.crop.distort` on ``[N, 2]``, exact to `EXACT`, by fixed point.

    Raises:
        ConfigError: when a point has no inverse: the distortion folds back.
    """
    found = points
    for _ in range(iterations):
        error = points - distort(found, dist)
        if not np.abs(error).max(initial=0) >= EXACT:
            break
        found = np.clip(found + error, -FURTHEST, FURTHEST)
    lost = ~(np.abs(points - distort(found, dist)) < EXACT).all(axis=1)
    if lost.any():
        x, y = points[lost][0]
        raise ConfigError(
            f"synthetic data: lens {dist.tolist()} folds back near x/z = {x:.2f}, y/z = {y:.2f}, "
            "within the image; give weaker coefficients"
        )
    return found


@dataclass(frozen=True)
class Tint:
    """One camera's colours, ``A c + b`` on sRGB in [0, 1]: ``A [3, 3]``, ``b [3]``."""

    A: Array
    b: Array

    def __call__(self, image: Array, alpha: Array) -> Array:
        """Tints a premultiplied image ``[H, W, 3]`` with alpha ``[H, W]``."""
        share = alpha[..., None]
        return np.clip(image @ self.A.T + share * self.b, 0, share)


def make_tints(strength: float, cameras: int, seed: int) -> list[Tint]:
    """Random tints of the training cameras, ``strength`` the largest change of a channel's gain.

    Their mean is the identity, so a single camera has none.
    """
    rng = np.random.default_rng([TINT_STREAM, seed])
    gain, leak, offset = (rng.uniform(-1, 1, (cameras, n)) for n in (3, 9, 3))
    leak = leak.reshape(-1, 3, 3) * (1 - np.eye(3))
    # a leak is subtracted from the channel itself, so that grey stays grey but for the gains
    leak -= leak.sum(axis=2, keepdims=True) * np.eye(3)
    change = _centred(gain)[:, :, None] * np.eye(3) + CROSSTALK * _centred(leak)
    shift = OFFSET * _centred(offset)
    return [
        Tint(np.eye(3) + strength * a, strength * b) for a, b in zip(change, shift, strict=True)
    ]


def _centred(x: Array) -> Array:
    """Shifted to mean 0 over the cameras, then scaled to within [-1, 1]."""
    x = x - x.mean(axis=0)
    return x / max(1.0, float(np.abs(x).max(initial=0)))


class Tracer:
    """Finds the first of the triangles ``[F, 3, 3]`` along rays, with Embree."""

    def __init__(self, triangles: Array) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._scene = EmbreeScene()
        self._mesh = TriangleMesh(self._scene, np.ascontiguousarray(triangles, dtype=np.float32))

    def first(self, origins: Array, directions: Array) -> tuple[Ints, Array]:
        """Face index ``[N]``, -1 for a miss, and barycentric (u, v) ``[N, 2]``."""
        # also for shadow rays: the query OCCLUDED returns wrong results
        hit = self._scene.run(
            np.ascontiguousarray(origins, dtype=np.float32),
            np.ascontiguousarray(directions, dtype=np.float32),
            query="INTERSECT",
            output=1,
        )
        return hit["primID"].astype(np.int64), np.stack([hit["u"], hit["v"]], axis=1)


class PosedPerson:
    """The person with ``vertices [V, 3]`` posed and fold joints bent by ``flexion [K]`` radians."""

    def __init__(self, person: Person, vertices: Array, flexion: Array, light: Light) -> None:
        self.person, self.vertices, self.flexion, self.light = person, vertices, flexion, light
        triangles = vertices[person.faces]
        self.normals = vertex_normals(triangles, person.faces, len(vertices))
        self.tracer = Tracer(triangles)

    def render(self, view: View, rays: int) -> tuple[Array, Array, Ints]:
        """Image ``[H,W,3]``, alpha ``[H,W]`` and labels ``[H,W]`` seen by a camera.

        Casts ``rays`` per pixel of the person's bounding box. A pixel's label is the one that most
        of its rays hit; it is background unless at least half of them hit the person.
        """
        H, W = view.size
        image, alpha = np.zeros((H, W, 3)), np.zeros((H, W))
        labels = np.zeros((H, W), dtype=np.int64)
        left, top, right, bottom = self._box(view)
        if right <= left or bottom <= top:
            return image, alpha, labels
        origin, directions = pixel_rays(view, (left, top, right, bottom), rays)
        face, colour = self._shoot(origin, view.bend(directions))
        shape = (bottom - top, right - left, rays)
        window = (slice(top, bottom), slice(left, right))
        image[window] = colour.reshape(*shape, 3).mean(axis=2)
        alpha[window] = (face >= 0).reshape(shape).mean(axis=2)
        part = np.where(face >= 0, self.person.labels[face], 0).reshape(shape)
        labels[window] = majority(part, int(self.person.labels.max()) + 1)
        return image, alpha, labels

    def _box(self, view: View, margin: int = 1) -> tuple[int, int, int, int]:
        H, W = view.size
        pixels = view.project(self.vertices)
        low, high = np.floor(pixels.min(axis=0)) - margin, np.ceil(pixels.max(axis=0)) + margin
        left, top = np.clip(low, 0, [W, H]).astype(int)
        right, bottom = np.clip(high, 0, [W, H]).astype(int)
        return int(left), int(top), int(right), int(bottom)

    def _shoot(self, origin: Array, directions: Array) -> tuple[Ints, Array]:
        face, uv = self.tracer.first(np.broadcast_to(origin, directions.shape), directions)
        hit = face >= 0
        colour = np.zeros((len(face), 3))
        colour[hit] = self._shade(face[hit], uv[hit], directions[hit])
        return face, colour

    def _shade(self, face: Ints, uv: Array, directions: Array) -> Array:
        """sRGB of surface points: Lambert sun, cast shadow, hemisphere ambient, folds, gloss."""
        person, light = self.person, self.light
        surface, corners = person.surface[face], person.faces[face]
        weight = np.concatenate([1 - uv.sum(axis=1, keepdims=True), uv], axis=1)[:, :, None]
        rest = (weight * person.vertices[corners]).sum(axis=1)
        here = (weight * self.vertices[corners]).sum(axis=1)
        normal = _unit((weight * self.normals[corners]).sum(axis=1))
        normal *= np.where((normal * directions).sum(axis=1) > 0, -1.0, 1.0)[:, None]
        sun = np.asarray(light.direction) / np.linalg.norm(light.direction)
        facing = np.maximum(normal @ sun, 0)
        lit = facing > 0
        start = here[lit] + light.shadow_offset * normal[lit]
        lit[lit] = self.tracer.first(start, np.broadcast_to(sun, start.shape))[0] < 0
        up = 0.5 + 0.5 * normal[:, 2]
        irradiance = light.sun * (facing * lit) + light.ground + (light.sky - light.ground) * up
        irradiance *= self._folds(rest, surface)
        paint = albedo(person.identity, person.marks, rest, surface) ** GAMMA
        colour = np.clip(paint * irradiance[:, None], 0, 1) ** (1 / GAMMA)
        if light.gloss > 0:
            shiny = np.isin(surface, (SHIRT, TROUSERS, SHOE))
            halfway = _unit(sun - directions[shiny])
            lobe = np.maximum((normal[shiny] * halfway).sum(axis=1), 0) ** SHININESS
            linear = colour[shiny] ** GAMMA + (light.gloss * light.sun * lit[shiny] * lobe)[:, None]
            colour[shiny] = np.clip(linear, 0, 1) ** (1 / GAMMA)
        return colour

    def _folds(self, rest: Array, surface: Ints) -> Array:
        """Factor on the light: creases of the clothes that deepen as a joint bends."""
        light, factor = self.light, np.ones(len(rest))
        cloth = (surface == SHIRT) | (surface == TROUSERS)
        p = rest[cloth]
        crease = np.zeros(len(p))
        for centre, axis, bend in zip(
            self.person.fold_centre, self.person.fold_axis, self.flexion, strict=True
        ):
            off = p - centre
            near = np.exp(-(off * off).sum(axis=1) / light.fold_reach**2)
            wave = np.sin(2 * np.pi * (off @ axis) / light.fold_period + 9.0 * off[:, 0])
            crease += np.tanh(bend) * near * wave
        factor[cloth] = 1 + light.fold * np.clip(crease, -1, 1)
        return factor


def vertex_normals(triangles: Array, faces: Ints, vertices: int) -> Array:
    """``[V, 3]`` unit normals, faces weighted by their area."""
    face = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    out = np.zeros((vertices, 3))
    np.add.at(out, faces.ravel(), np.repeat(face, 3, axis=0))
    return _unit(out, 1e-20)


def _unit(x: Array, least: float = 1e-12) -> Array:
    return x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), least)


def pixel_offsets(rays: int) -> Array:
    """``[rays, 2]`` positions in a pixel, in [0, 1): the centre, then the R2 sequence."""
    g = 1.32471795724474602596  # the plastic number: x³ = x + 1
    step = np.array([1 / g, 1 / g**2])
    return np.mod(0.5 + np.arange(rays)[:, None] * step, 1.0)


def pixel_rays(view: View, box: tuple[int, int, int, int], rays: int) -> tuple[Array, Array]:
    """Origin ``[3]`` and unit directions ``[h*w*rays, 3]`` of the pixels of a box."""
    left, top, right, bottom = box
    y, x = np.mgrid[top:bottom, left:right].astype(np.float64)
    offset = pixel_offsets(rays)
    x = (x[..., None] + offset[:, 0]).ravel()
    y = (y[..., None] + offset[:, 1]).ravel()
    pixel = np.stack([x, y, np.ones_like(x)], axis=1)
    directions = pixel @ np.linalg.inv(view.K).T @ view.R
    return view.centre, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def majority(part: Ints, classes: int) -> Ints:
    """``[h, w]`` most frequent part of ``[h, w, rays]``; 0 where more than half the rays miss."""
    votes = np.stack([(part == c).sum(axis=-1) for c in range(1, classes)], axis=-1)
    solid = 2 * (part > 0).sum(axis=-1) >= part.shape[-1]
    return np.where(solid, votes.argmax(axis=-1) + 1, 0)
