"""Ray tracing of the posed character: image, alpha and part labels of one camera.

An independent renderer: splatting takes no part in making the training data.

Units are metres in the world frame; images are RGB, sRGB in [0, 1], premultiplied on black.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.motion.character import Character
from gsgan.synthetic.camera import SceneCamera, pixel_rays
from gsgan.synthetic.textures import Textures, srgb

Array = NDArray[np.float64]
# float32: enough for light, and twice as fast
Floats = NDArray[np.floating[Any]]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Colour = tuple[float, float, float]

# rays traced at once: their arrays stay in the processor's cache
BLOCK_RAYS = 1 << 15
# exponent of the highlight's lobe: falls to half within about 19 degrees
SHININESS = 12.0
GLOSSY_PARTS = ("upper_clothes", "lower_clothes", "left_shoe", "right_shoe")
SKY_RAYS = 48  # directions in which each vertex looks for the sky
SKY_OFFSET = 3e-3  # metres from the surface to sky rays
# metres from the surface to shadow rays; less gives speckles
SHADOW_OFFSET = 1e-3
LAYERS = 32  # cut-out surfaces that one ray passes at most
SHOULDER = 0.5  # linear light from which the tone curve is compressed


@dataclass(frozen=True)
class Light:
    """A sun and a sky, in linear light."""

    # towards the sun, any length
    direction: tuple[float, float, float] = (0.5, -0.75, 0.9)
    sun: Colour = (0.88, 0.83, 0.76)
    sky: Colour = (0.58, 0.62, 0.68)  # from straight above
    ground: Colour = (0.38, 0.35, 0.32)  # from straight below
    spread: float = 0.06  # tangent of half the sun's width: soft shadows
    # highlight (Blinn-Phong) of everything, as a share of the sun
    shine: float = 0.04
    gloss: float = 0.0  # the same, added for clothes and shoes


@dataclass(frozen=True)
class Wrinkles:
    """Waves in the shading normals of one posed mesh, per vertex.

    A normal is tilted by ``slope * wave(phase)`` along ``across``: see `wave`.
    """

    phase: Floats  # [V] radians, linear within faces
    slope: Floats  # [V] 0 where cloth is smooth
    # [V, 3] unit, world: the direction from one fold to the next
    across: Floats


def wave(phase: Floats) -> Floats:
    """The slope of folds in [-1, 1]: two waves without a common period."""
    first = np.float32(0.65) * np.cos(phase)
    return first + np.float32(0.35) * np.cos(1.618 * phase + 1)


def encode(light: Array) -> Array:
    """sRGB of linear light: exact up to `SHOULDER`, then rolled off, below 1 for any light."""
    # Above the shoulder, the rest of the range is approached exponentially.
    rest = 1 - SHOULDER
    over = np.maximum(light - SHOULDER, 0)
    light = np.where(over > 0, 1 - rest * np.exp(-over / rest), light)
    return np.asarray(srgb(light), np.float64)


class Appearance:
    """The part of a character's appearance that is constant over frames."""

    def __init__(self, character: Character) -> None:
        self.character = character

        # Arrays in the types that tracing needs.
        self.faces = character.faces.astype(np.int32)
        self.uv = character.uv.astype(np.float32)
        self.textures = Textures(character.surfaces)
        self.cutoff = np.array(
            [s.cutoff for s in character.surfaces], np.float32
        )
        self.bumpy = any(s.normal is not None for s in character.surfaces)

        # 1 on faces of clothes and shoes, which get the added gloss.
        clothes = [name in GLOSSY_PARTS for name in character.label_names]
        self.glossy = np.array(clothes, np.float32)[character.labels]

        # Edges of each face in texture coordinates.
        uv = character.uv[self.faces]
        self.du = uv[:, 1] - uv[:, 0]
        self.dv = uv[:, 2] - uv[:, 0]
        twice_uv = self.du[:, 0] * self.dv[:, 1] - self.du[:, 1] * self.dv[:, 0]
        self.mirrored = np.where(twice_uv < 0, -1, 1).astype(np.float32)

        # log2 of texels per metre, along one side.
        corners = character.vertices[self.faces]
        first_edge = corners[:, 1] - corners[:, 0]
        second_edge = corners[:, 2] - corners[:, 0]
        twice_area = np.linalg.norm(np.cross(first_edge, second_edge), axis=1)
        texels = np.abs(twice_uv) * self.textures.size(character.material).prod(
            axis=1
        )
        ratio = np.maximum(texels, 1e-9) / np.maximum(twice_area, 1e-12)
        self.density = 0.5 * np.log2(ratio)

    def coverage(self, face: Ints, bary: Floats) -> Bools:
        """Whether points of faces are on the surface, rather than cut out of it."""
        surface = self.character.material[face]
        cutoff = self.cutoff[surface]
        solid = cutoff <= 0

        # Only cut-out surfaces are looked up.
        k = np.flatnonzero(~solid)
        uv = _blend(bary[k], self.uv[self.faces[face[k]]])
        finest = np.zeros(len(k), np.int64)
        _, coverage, _ = self.textures(surface[k], uv, finest)
        if self.character.tint is not None:
            corners = self.character.tint[self.faces[face[k]], 3:]
            coverage = coverage * _blend(bary[k], corners)[:, 0]
        solid[k] = coverage >= cutoff[k]
        return solid


class Tracer:
    """Finds the first face of a mesh along rays, with Embree.

    Args:
        vertices: ``[V, 3]``.
        faces: ``[F, 3]``.
        solid: tells for faces ``[N]`` and barycentric weights ``[N, 3]`` which points stop a ray;
            None: all.
    """

    def __init__(
        self,
        vertices: Array,
        faces: NDArray[Any],
        solid: Callable[[Ints, Floats], Bools] | None = None,
    ) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        # The mesh has to be kept as long as the scene.
        self._scene = EmbreeScene()
        self._solid = solid
        self._mesh = TriangleMesh(
            self._scene, vertices.astype(np.float32), faces.astype(np.int32)
        )

    def first(self, origins: Floats, directions: Floats) -> tuple[Ints, Floats]:
        """Face index ``[N]``, -1 for a miss, and barycentric weights ``[N, 3]``."""
        face, bary, distance = self._run(origins, directions)
        if self._solid is None:
            return face, bary

        # Rays that hit a hole go on behind it.
        # metres until the last hole
        travelled = np.zeros(len(face), np.float32)
        going = np.arange(len(face))
        for _ in range(LAYERS):
            going = going[face[going] >= 0]
            going = going[~self._solid(face[going], bary[going])]
            if not len(going):
                break
            travelled[going] += distance[going] + np.float32(1e-5)
            towards = directions[going]
            start = origins[going] + travelled[going, None] * towards
            face[going], bary[going], distance[going] = self._run(
                start, towards
            )
        return face, bary

    def is_blocked(self, origins: Floats, directions: Floats) -> Bools:
        """Whether each ray ``[N]`` meets the mesh."""
        if self._solid is not None:
            return self.first(origins, directions)[0] >= 0
        hit: NDArray[np.int32] = self._scene.run(
            origins, directions, query="OCCLUDED"
        )
        return hit >= 0  # 0 for a hit, whatever the face, and -1 for a miss

    def _run(
        self, origins: Floats, directions: Floats
    ) -> tuple[Ints, Floats, Floats]:
        """Face, barycentric weights and distance of the first hit, whether solid or not."""
        hit = self._scene.run(origins, directions, query="INTERSECT", output=1)
        u = hit["u"]
        v = hit["v"]
        bary = np.stack([1 - u - v, u, v], axis=1)
        return hit["primID"].astype(np.int64), bary, hit["tfar"]


class PosedCharacter:
    """A character with ``vertices`` and unit ``normals [V, 3]`` posed, ready to be rendered.

    Args:
        appearance: of the character; shared by all frames.
        vertices: ``[V, 3]`` metres.
        normals: ``[V, 3]`` unit.
        light: of the scene.
        wrinkles: waves in the normals, None for smooth cloth.
    """

    def __init__(
        self,
        appearance: Appearance,
        vertices: Array,
        normals: Array,
        light: Light,
        wrinkles: Wrinkles | None = None,
    ) -> None:
        self.appearance = appearance
        self.light = light
        self.wrinkles = wrinkles
        self.vertices = vertices
        faces = appearance.faces
        solid = appearance.coverage if (appearance.cutoff > 0).any() else None
        self.tracer = Tracer(vertices, faces, solid)

        # Flat normals, on the same side as those of the vertices.
        X = vertices.astype(np.float32)
        N = normals.astype(np.float32)
        first_edge = X[faces[:, 1]] - X[faces[:, 0]]
        second_edge = X[faces[:, 2]] - X[faces[:, 0]]
        flat = _unit(np.cross(first_edge, second_edge))
        outwards = (flat * N[faces].sum(axis=1)).sum(axis=1, keepdims=True)
        self.flat = np.where(outwards < 0, -flat, flat)

        # Tangents along u, for the normal maps.
        along_u = (
            first_edge * appearance.dv[:, 1:]
            - second_edge * appearance.du[:, 1:]
        )
        tangent = _unit(along_u * appearance.mirrored[:, None])
        self.tangent = tangent.astype(np.float32)

        # Attributes of the vertices, in the columns that `_shade` reads: position, normal, sky
        # light outside and inside, texture coordinates, and the phase, slope and direction of
        # wrinkles; last, factors of colour. One lookup interpolates them all.
        attributes = [X, N, self._sky(X, N), appearance.uv]
        if wrinkles is not None:
            attributes += [wrinkles.phase, wrinkles.slope, wrinkles.across]
        if appearance.character.tint is not None:
            attributes.append(appearance.character.tint[:, :3])
        self.attributes = np.column_stack(attributes).astype(np.float32)

    def render(self, view: SceneCamera, rays: int) -> tuple[Array, Array, Ints]:
        """Image ``[H,W,3]``, alpha ``[H,W]`` and labels ``[H,W]`` seen by a camera.

        Casts ``rays`` per pixel that the person can touch. A pixel's label is the one that most of
        its rays hit; it is background unless at least half of them hit the person. Its colour is
        the mean light of the rays that hit, encoded as sRGB, times alpha.
        """
        H, W = view.size
        image = np.zeros((H, W, 3))
        alpha = np.zeros((H, W))
        labels = np.zeros((H, W), dtype=np.int64)
        character = self.appearance.character

        # Pixels are traced in blocks.
        touched = np.argwhere(self._find_touched(view))
        step = max(1, BLOCK_RAYS // rays)
        for first in range(0, len(touched), step):
            y, x = touched[first : first + step].T
            origin, directions = pixel_rays(view, x, y, rays)
            face, light = self._shoot(view, origin, view.bend(directions), rays)
            hits = (face >= 0).reshape(-1, rays)
            count = hits.sum(axis=1)

            # The mean light of the rays that hit.
            total = light.reshape(-1, rays, 3).sum(axis=1)
            mean = total / np.maximum(count, 1)[:, None]
            alpha[y, x] = count / rays
            image[y, x] = encode(mean) * alpha[y, x, None]

            # The label that most rays hit.
            part = np.where(hits, character.labels[face].reshape(-1, rays), 0)
            labels[y, x] = majority(part, len(character.label_names))
        return image, alpha, labels

    def _find_touched(self, view: SceneCamera) -> Bools:
        """Pixels ``[H, W]`` that the person may touch: faces' edges and what is between them."""
        H, W = view.size
        # A person who is partly behind the camera may touch every pixel.
        depth = self.vertices @ view.R[2] + view.t[2]
        if depth.min() <= 0:
            return np.ones((H, W), dtype=bool)

        # Pixels of vertices; far ones are moved to where OpenCV can draw them.
        pixels = np.floor(view.project(self.vertices))
        pixels = np.clip(pixels, -9999, 9999).astype(np.int32)
        edges = np.zeros((H, W), np.uint8)
        inside = ((pixels >= 0) & (pixels < [W, H])).all(axis=1)
        edges[pixels[inside, 1], pixels[inside, 0]] = 1

        # Edges of the faces that are longer than a pixel.
        corners = pixels[self.appearance.faces]
        long = (np.ptp(corners, axis=1) > 1).any(axis=1)
        cv2.polylines(edges, list(corners[long]), True, 1)
        touched: Bools = cv2.dilate(edges, np.ones((3, 3), np.uint8)) > 0

        # Elsewhere, a ray through the pixel's centre decides: the inside of large faces.
        y, x = np.nonzero(~touched)
        origin, directions = pixel_rays(view, x, y, 1)
        directions = view.bend(directions).astype(np.float32)
        start = np.tile(origin.astype(np.float32), (len(directions), 1))
        touched[y, x] = self.tracer.is_blocked(start, directions)
        return touched

    def _shoot(
        self, view: SceneCamera, origin: Array, directions: Array, rays: int
    ) -> tuple[Ints, Floats]:
        """Face ``[N]`` and linear light ``[N, 3]`` of each ray."""
        towards = directions.astype(np.float32)
        start = np.tile(origin.astype(np.float32), (len(towards), 1))
        face, bary = self.tracer.first(start, towards)
        light = np.zeros((len(face), 3), np.float32)

        # Each ray of a pixel looks at another point of the sun's disc.
        k = np.flatnonzero(face >= 0)
        disc = _disc(rays)[k % rays] * np.float32(self.light.spread)
        # Metres between neighbouring rays, at 1 m from the camera.
        spacing = 1 / (view.K[0, 0] * np.sqrt(rays))
        light[k] = self._shade(
            start[k], towards[k], face[k], bary[k], disc, spacing
        )
        return face, light

    def _shade(
        self,
        eye: Floats,
        ray: Floats,
        face: Ints,
        bary: Floats,
        disc: Floats,
        spacing: float,
    ) -> Floats:
        """Linear light of surface points: sun with cast shadow, sky and ground, highlight."""
        looks = self.appearance
        corners = self.attributes[looks.faces[face]]
        here = _blend(bary, corners)
        point = here[:, :3]

        # Shadow rays start on the smooth surface (Hanika 2021): no facets in shadows.
        depth = ((point[:, None] - corners[:, :, :3]) * corners[:, :, 3:6]).sum(
            axis=2
        )
        lifted = point - _blend(bary * np.minimum(depth, 0), corners[:, :, 3:6])

        # The colour, at the mip level whose texels are as far apart as the rays.
        level = looks.density[face] + np.log2(
            _norm(point - eye)[:, 0] * spacing
        )
        colour, _, bump = looks.textures(
            surface=looks.character.material[face],
            uv=here[:, 8:10],
            level=np.rint(level).astype(np.int64),
        )
        if looks.character.tint is not None:
            colour = colour * here[:, -3:]

        # The back of cloth is lit on its own side.
        normal = self._shading_normal(here, face, bump)
        flat = self.flat[face]
        inside = _dot(flat, ray)[:, 0] > 0
        side = np.where(inside, np.float32(-1), np.float32(1))[:, None]
        normal = normal * side
        flat = flat * side
        lifted = np.where(inside[:, None], point, lifted)

        # Light of sky and ground.
        sky = np.array(self.light.sky, np.float32)
        ground = np.array(self.light.ground, np.float32)
        up = 0.5 + 0.5 * normal[:, 2:]
        seen = np.where(inside, here[:, 7], here[:, 6])[:, None]
        out = colour * (seen * (ground + (sky - ground) * up))

        # Light of the sun where nothing blocks it, with the highlight.
        towards = self._sun_directions(disc)
        facing = _dot(normal, towards)[:, 0]

        # Only points that face the sun, and that nothing shades.
        k = np.flatnonzero(facing > 0)
        start = lifted[k] + np.float32(SHADOW_OFFSET) * flat[k]
        k = k[~self.tracer.is_blocked(start, towards[k])]

        # Blinn-Phong's highlight, about half-way between sun and camera.
        half = _unit(towards[k] - ray[k])
        lobe = np.maximum(_dot(normal[k], half), 0) ** np.float32(SHININESS)
        shine = (
            self.light.shine + self.light.gloss * looks.glossy[face[k], None]
        )
        sun = np.array(self.light.sun, np.float32)
        out[k] += (colour[k] + shine * lobe) * facing[k, None] * sun
        return out

    def _shading_normal(self, here: Floats, face: Ints, bump: Floats) -> Floats:
        """``[N, 3]`` unit normals of points with the normal map and the wrinkles."""
        normal = _unit(here[:, 3:6])
        if self.appearance.bumpy:
            tangent = self.tangent[face]
            tangent = _unit(tangent - _dot(tangent, normal) * normal)
            down = np.cross(normal, tangent)  # along +v
            down = down * self.appearance.mirrored[face, None]
            bumped = bump[:, :1] * tangent - bump[:, 1:2] * down
            normal = _unit(bumped + bump[:, 2:] * normal)
        if self.wrinkles is not None:
            tilt = here[:, 11:12] * wave(here[:, 10:11])
            normal = _unit(normal + tilt * here[:, 12:15])
        return normal

    def _sun_directions(self, disc: Floats) -> Floats:
        """``[N, 3]`` unit directions towards points of the sun's disc ``[N, 2]``."""
        middle = _unit(np.array([self.light.direction], np.float32))
        helper = np.eye(3, dtype=np.float32)[np.abs(middle).argmin()]
        across = _unit(np.cross(middle, helper))
        down = np.cross(middle, across)
        return _unit(middle + disc[:, :1] * across + disc[:, 1:] * down)

    def _sky(self, X: Floats, N: Floats) -> Floats:
        """``[V, 2]`` share of the sky's and ground's light that arrives, outside and inside."""
        # A Fibonacci sphere, always the same: nothing flickers.
        i = np.arange(SKY_RAYS) + 0.5
        z = 1 - 2 * i / SKY_RAYS
        turn = np.pi * (1 + 5**0.5) * i
        ring = np.sqrt(1 - z * z)
        sphere = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)

        # The light that arrives, and what would if nothing were in the way, on
        # both sides.
        sky = np.mean(self.light.sky)
        ground = np.mean(self.light.ground)
        arrived = np.zeros((len(X), 2), np.float32)
        possible = np.zeros((len(X), 2), np.float32)
        rows = np.arange(len(X))
        for d in sphere.astype(np.float32):
            # A direction belongs to the side of the surface that it leaves.
            cosine = N @ d
            inside = (cosine < 0).astype(np.int64)
            light = ground + (sky - ground) * (0.5 + 0.5 * d[2])
            weight = np.abs(cosine) * np.float32(light)

            # Rays start a little above the surface, which would block them.
            start = X + np.float32(SKY_OFFSET) * np.sign(cosine)[:, None] * N
            free = ~self.tracer.is_blocked(start, np.tile(d, (len(X), 1)))
            possible[rows, inside] += weight
            arrived[rows, inside] += weight * free
        share: Floats = arrived / np.maximum(possible, np.float32(1e-6))
        return share


def majority(part: Ints, classes: int) -> Ints:
    """``[n]`` most frequent part of ``[n, rays]``; 0 if more than half the rays miss."""
    # Votes of each part in each row, counted in one call.
    slot = np.arange(len(part))[:, None] * classes + part
    votes = np.bincount(slot.ravel(), minlength=len(part) * classes)
    votes = votes.reshape(-1, classes)
    solid = 2 * votes[:, 0] <= part.shape[1]
    return np.where(solid, votes[:, 1:].argmax(axis=1) + 1, 0)


def _disc(count: int) -> Floats:
    """``[count, 2]`` points spread over the unit disc."""
    # The R2 sequence, unrelated to the rays' positions in the pixel.
    i = np.arange(count)
    radius = np.sqrt(np.mod(0.5 + 0.7548776662466927 * i, 1))
    turn = 2 * np.pi * 0.5698402909980532 * i
    spread = np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=1)
    return spread.astype(np.float32)


def _blend(weight: Floats, corners: Floats) -> Floats:
    """``[N, C]`` of barycentric weights ``[N, 3]`` and corners ``[N, 3, C]``."""
    blended: Floats = np.einsum("nk,nkc->nc", weight, corners)
    return blended


def _dot(a: Floats, b: Floats) -> Floats:
    return np.einsum("nc,nc->n", a, b)[:, None]


def _norm(x: Floats) -> Floats:
    return np.sqrt(_dot(x, x))


def _unit(x: Floats) -> Floats:
    return x / np.maximum(_norm(x), np.float32(1e-12))
