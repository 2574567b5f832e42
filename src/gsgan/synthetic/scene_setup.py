"""The synthetic scene in numbers: its parameters, cameras, character and motion.

Everything here follows from :class:`SceneSettings` alone: workers rebuild the scene from them.
"""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from gsgan.body.free import free_body
from gsgan.data.cameras import DISTORTION_LENGTHS
from gsgan.motion.character import Character
from gsgan.motion.readers import RIGS
from gsgan.synthetic.camera import SceneCamera, look_at, through_lens, zoom
from gsgan.synthetic.free_subject import free_character, free_pose
from gsgan.synthetic.gltf import AVATARS, CHARACTER_FILES, read_character
from gsgan.synthetic.passages import choose_held_out, frame_times, split_signs
from gsgan.synthetic.recorded_motion import RecordedMotion
from gsgan.synthetic.secondary import Moving, Secondary
from gsgan.synthetic.takes import MOTIONS
from gsgan.synthetic.trace import Appearance, Light, PosedCharacter, Wrinkles
from gsgan.utils.arrays import as_floats
from gsgan.utils.checks import between, integer, one_of
from gsgan.utils.errors import ConfigError, DataError

Array = NDArray[np.float64]

TINT_STREAM = 77
CROSSTALK = 0.25  # leak from channel to channel, as a share of the tint
MAX_OFFSET = 0.25  # of a channel, as a share of the tint


@dataclass(frozen=True)
class Tint:
    """One camera's colours, ``A c + b`` on sRGB in [0, 1]: ``A [3, 3]``, ``b [3]``."""

    A: Array  # [3, 3]
    b: Array  # [3]

    def __call__(self, image: Array, alpha: Array) -> Array:
        """Tints a premultiplied image ``[H, W, 3]`` with alpha ``[H, W]``."""
        # Premultiplied colours are between 0 and alpha.
        share = alpha[..., None]
        return np.clip(image @ self.A.T + share * self.b, 0, share)


def make_tints(strength: float, cameras: int, seed: int) -> list[Tint]:
    """Random tints of the training cameras, ``strength`` the largest change of a channel's gain.

    Their mean is the identity, so a single camera has none.
    """
    rng = np.random.default_rng([TINT_STREAM, seed])
    gain = rng.uniform(-1, 1, (cameras, 3))
    leak = rng.uniform(-1, 1, (cameras, 9))
    offset = rng.uniform(-1, 1, (cameras, 3))

    # What leaks into a channel is subtracted from the channel itself, so that only the gains
    # change grey.
    identity = np.eye(3)
    leak = leak.reshape(-1, 3, 3) * (1 - identity)
    leak -= leak.sum(axis=2, keepdims=True) * identity

    # The mean over the cameras is the identity.
    change = _centre(gain)[:, :, None] * identity + CROSSTALK * _centre(leak)
    shift = MAX_OFFSET * _centre(offset)
    tints = []
    for matrix, vector in zip(change, shift, strict=True):
        tints.append(Tint(A=identity + strength * matrix, b=strength * vector))
    return tints


def _centre(x: Array) -> Array:
    """Shifted to mean 0 over the cameras, then scaled to within [-1, 1]."""
    x = x - x.mean(axis=0)
    largest = np.abs(x).max(initial=0)
    return x / max(1.0, float(largest))


VERSION = 3
"""Version of the images. Raise it when any pixel changes: datasets are then made again."""

# Names of avatars.
DEFAULT = "polo"
FREE_BODY = "free_body"
# Names of motions.
CHOREOGRAPHY = "choreography"
SIGNING = "signs"

CAMERA_ARC = math.radians(150)  # in front of a person who signs
CAMERA_HEIGHTS = (1.35, 0.95, 1.75)  # metres, in turn around the person
TEST_HEIGHTS = (1.15, 1.55)  # metres, of test cameras around the person
ARC_HEIGHTS = (1.35, 1.55, 1.2)  # metres, in turn along the arc
ARC_TEST_HEIGHTS = (1.45, 1.3)  # metres, of test cameras along the arc

# Minimum of each whole number, and the ranges of the parameters that may be None.
MIN_VALUES = {
    "size": 8,
    "train_cameras": 1,
    "frames": 1,
    "rays_per_pixel": 1,
    "test_cameras": 0,
    "test_frames": 0,
    "seed": 0,
}
OPTIONAL_NUMBERS = {"tint": (0.0, 0.3), "gloss": (0.0, 1.0)}
OPTIONAL_LISTS = {"lens": (-math.inf, math.inf), "test_scale": (0.25, 4)}


@dataclass(frozen=True)
class SceneSettings:
    """The parameters of a synthetic dataset, as in conf/data/synthetic.yaml.

    Together with `VERSION` and the motion's file they determine every byte. Disabled effects are
    stored as None.

    Raises:
        ConfigError: naming the parameter that is out of range.
    """

    size: int = 128  # pixels of the square images
    train_cameras: int = 6
    test_cameras: int = 2  # held out, between training cameras
    frames: int = 84
    test_frames: int = 21  # held out, of all frames
    rays_per_pixel: int = 16
    seed: int = 0  # of blinks and tints
    avatar: str = DEFAULT  # name, or path of a .glb
    motion: str = CHOREOGRAPHY  # name, or path of a motion file of a rig
    secondary: bool = True  # sway and wrinkles of cloth
    lens: tuple[float, ...] | None = None  # OpenCV's distortion coefficients
    tint: float | None = None  # maximum change of a channel's gain
    gloss: float | None = None  # added highlight of clothes
    # zooms of copies of the test cameras
    test_scale: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        # Whole numbers.
        for name, minimum in MIN_VALUES.items():
            integer(f"data.source.{name}", getattr(self, name), minimum)

        # Numbers that may be None; 0 disables the effect too.
        for name, bounds in OPTIONAL_NUMBERS.items():
            value = getattr(self, name)
            if value is not None:
                between(f"data.source.{name}", value, *bounds)
            object.__setattr__(self, name, float(value) if value else None)

        # Lists that may be None; zeros alone disable the effect too.
        for name, (low, high) in OPTIONAL_LISTS.items():
            raw = getattr(self, name)
            values = as_floats([] if raw is None else raw)
            _require(
                raw is None or _is_list_within(raw, values, low, high),
                f"{name} must be a list of numbers in [{low:g}, {high:g}], got {raw!r}",
            )
            stored = tuple(values.tolist()) if values.any() else None
            object.__setattr__(self, name, stored)

        self._check_sources()
        self._check_together()

    def _check_sources(self) -> None:
        """The avatar and the motion are known names or files of a known format."""
        named = (*AVATARS, FREE_BODY)
        _require(
            self.avatar in named
            or str(self.avatar).lower().endswith(CHARACTER_FILES),
            f"avatar must be {', '.join(named)} or the path of a rigged "
            f"{', '.join(CHARACTER_FILES)} file, got {self.avatar!r}",
        )
        _require(
            self.motion in tuple(MOTIONS)
            or str(self.motion).lower().endswith(RIGS),
            f"motion must be {', '.join(MOTIONS)} or the path of a {', '.join(RIGS)} file, "
            f"got {self.motion!r}",
        )
        one_of("data.source.secondary", self.secondary, (True, False))

    def _check_together(self) -> None:
        """The parameters agree with each other."""
        # The held-out frames and cameras must fit those of the training.
        _require(
            self.test_frames < self.frames,
            f"test_frames must be less than frames = {self.frames}, got {self.test_frames}",
        )
        _require(
            self.test_cameras <= self.train_cameras,
            f"test_cameras stand between training cameras, so there can be at most "
            f"{self.train_cameras}, got {self.test_cameras}",
        )

        # A lens has one of OpenCV's numbers of coefficients; zoomed cameras copy test cameras.
        _require(
            self.lens is None or len(self.lens) in DISTORTION_LENGTHS,
            f"lens must list {' or '.join(map(str, DISTORTION_LENGTHS))} coefficients "
            "(k1 k2 p1 p2 k3 …)",
        )
        _require(
            self.test_scale is None or self.test_cameras > 0,
            "test_scale adds copies of the test cameras, but there are none; set test_cameras",
        )


def _is_list_within(
    raw: object, values: Array, low: float, high: float
) -> bool:
    """Whether a parameter is a list whose elements are all numbers from low to high."""
    if not isinstance(raw, Sequence) or len(values) != len(raw):
        return False
    finite = np.isfinite(values)
    return bool((finite & (values >= low) & (values <= high)).all())


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise ConfigError(f"data.source.{message}")


def dataset_key(settings: SceneSettings) -> str:
    """Name of a dataset in the cache: its main parameters and a hash of all of them.

    Files count by their content, not by their path.

    Raises:
        DataError: when a file does not exist.
    """
    # A file is replaced by the hash of its content: that of an avatar of gsgan by `VERSION`.
    parameters = asdict(settings)
    files = {"motion": motion_file(settings.motion)}
    if settings.avatar not in (*AVATARS, FREE_BODY):
        files["avatar"] = Path(settings.avatar).expanduser()
    for name, path in files.items():
        if not path.is_file():
            raise DataError(f"data.source.{name}: {path} does not exist")
        parameters[name] = hashlib.sha256(path.read_bytes()).hexdigest()

    # The hash covers the version of the generator and every parameter.
    content = repr((VERSION, sorted(parameters.items())))
    digest = hashlib.sha256(content.encode()).hexdigest()[:12]
    key = f"{Path(settings.avatar).stem}-{settings.size}-{digest}"

    # The name ends with the effects that are enabled.
    for effect in ("lens", "tint", "gloss", "test_scale"):
        if getattr(settings, effect):
            key += f"-{effect}"
    return key


def motion_file(motion: str) -> Path:
    """The file of ``data.source.motion``, a name in `MOTIONS` or a path."""
    return MOTIONS.get(motion) or Path(motion).expanduser()


def load_character(avatar: str) -> Character:
    """The character of ``data.source.avatar``.

    Args:
        avatar: a name in `AVATARS`, ``free_body``, or the path of a rigged .glb.

    Raises:
        DataError: when the file is missing, damaged or not a rigged person.
    """
    if avatar == FREE_BODY:
        return free_character()
    return read_character(AVATARS.get(avatar) or Path(avatar).expanduser())


class Scene:
    """A whole synthetic scene, ready to be traced.

    ``motion`` has one pose per frame; ``views`` and ``tints`` are by camera name, training cameras
    first. Held-out cameras have no tint: nothing in the training data could reveal it.

    Raises:
        ConfigError: when a lens cannot be inverted up to the images' corners.
        DataError: when the avatar's or the motion's file cannot be used.
    """

    def __init__(self, settings: SceneSettings) -> None:
        self.settings = settings
        self.light = Light(gloss=settings.gloss or 0.0)
        self.character = load_character(settings.avatar)
        self.appearance = Appearance(self.character)

        # The motion and what follows from it.
        self.source = self._moving()
        self.times = frame_times(settings.frames, self.source.duration)
        self.motion = self.source.at(self.times)
        self.secondary = None
        if settings.secondary:
            self.secondary = Secondary(self.character, self.source)

        # The split of the frames.
        passages = self.motion.passages
        if settings.motion == SIGNING:
            self.train_frames, self.test_frames = split_signs(
                passages, settings.test_frames
            )
        else:
            self.test_frames = choose_held_out(passages, settings.test_frames)
            self.train_frames = [
                i for i in range(settings.frames) if i not in self.test_frames
            ]

        # The cameras and their split.
        self.views = self._cameras()
        names = list(self.views)
        self.train_cameras = names[: settings.train_cameras]
        self.test_cameras = names[settings.train_cameras :]

        self.tints: dict[str, Tint] = {}
        if settings.tint:
            tints = make_tints(
                settings.tint, settings.train_cameras, settings.seed
            )
            self.tints = dict(zip(self.train_cameras, tints, strict=True))

    def _moving(self) -> Moving:
        """The motion on this character."""
        path = motion_file(self.settings.motion)
        return RecordedMotion(self.character, path, self.settings.seed)

    def _cameras(self) -> dict[str, SceneCamera]:
        """All cameras by name: for training, for testing, then zoomed copies of the latter."""
        # Signs are filmed from the front, other motions from all round.
        settings = self.settings
        signing = settings.motion == SIGNING
        points = extent(self.character, self.source, upper=signing)
        placed = front(settings, points) if signing else ring(settings, points)
        views = {f"cam{i:02d}": view for i, view in enumerate(placed)}

        # Copies of the test cameras at other scales.
        for name in list(views)[settings.train_cameras :]:
            for scale in settings.test_scale or ():
                views[f"{name}_x{scale:g}"] = zoom(views[name], scale)

        # The lens is the same for all cameras.
        if settings.lens is not None:
            dist = np.array(settings.lens)
            for name, view in views.items():
                views[name] = through_lens(view, dist)
        return views

    def mesh(self, frame: int) -> tuple[Array, Array, Wrinkles | None]:
        """Vertices (metres) and unit normals ``[V, 3]`` of a frame, and the wrinkles of cloth."""
        # Without secondary motion, there are no wrinkles.
        vertices, normals = self._skin(frame)
        if self.secondary is None:
            return vertices, normals, None
        rotations = self.motion.rotations[frame]
        return self.secondary(
            float(self.times[frame]), rotations, vertices, normals
        )

    def pose(self, frame: int) -> PosedCharacter:
        """The character at one frame, ready to be rendered."""
        vertices, normals, wrinkles = self.mesh(frame)
        return PosedCharacter(
            self.appearance, vertices, normals, self.light, wrinkles
        )

    def landmarks(self) -> tuple[tuple[str, ...], Array]:
        """Names and positions ``[F, L, 3]`` (metres) of the landmarks of all frames.

        They are where skinning puts them: sway and wrinkles do not move a skeleton.
        """
        if self.settings.avatar == FREE_BODY:
            body = free_body()
            pose = free_pose(self.motion)
            posed = [body.posed_landmarks(pose), body.posed_hands(pose)]
            names = (*body.landmark_names, *body.hand_names)
            return names, torch.cat(posed, dim=1).double().numpy()

        points = []
        for frame, joints in enumerate(self.motion.joints):
            vertices, _ = self._skin(frame)
            points.append(self.character.landmarks(vertices, joints))
        return self.character.anchor_names, np.stack(points)

    def _skin(self, frame: int) -> tuple[Array, Array]:
        """Vertices and normals ``[V, 3]`` by linear blend skinning of the shaped rest pose."""
        character = self.character
        motion = self.motion
        offsets = np.zeros_like(character.vertices)
        for name, shape in character.shapes.items():
            if name in motion.shapes:
                offsets = offsets + motion.shapes[name][frame] * shape
        return character.skin(
            motion.rotations[frame], motion.joints[frame], offsets
        )


def extent(
    character: Character,
    source: Moving,
    samples: int = 160,
    stride: int = 24,
    upper: bool = False,
) -> Array:
    """``[N, 3]`` points that a motion reaches, metres; with ``upper`` from the waist upwards.

    Every ``stride``-th vertex at a fixed number of moments: cameras fitted to these points do not
    depend on ``frames``.
    """
    # With `upper`, only vertices that the spine or its descendants carry.
    chosen = np.arange(len(character.vertices))
    if upper:
        trunk = character.with_descendants(character.bones.index("Spine"))
        chosen = np.flatnonzero(np.isin(character.dominant_bones(), trunk))

    # A character of the chosen vertices alone is quick to skin.
    chosen = chosen[::stride]
    thinned = replace(
        character,
        vertices=character.vertices[chosen],
        normals=character.normals[chosen],
        bone_index=character.bone_index[chosen],
        bone_weight=character.bone_weight[chosen],
    )

    # The vertices at moments that are evenly spread over the motion.
    motion = source.at(frame_times(samples, source.duration))
    points = []
    for rotations, joints in zip(motion.rotations, motion.joints, strict=True):
        vertices, _ = thinned.skin(rotations, joints)
        points.append(vertices)
    return np.concatenate(points)


def ring(settings: SceneSettings, points: Array) -> list[SceneCamera]:
    """Cameras around the person, training cameras first, zoomed to keep ``points`` in view."""
    step = 2 * math.pi / settings.train_cameras
    places = []

    # Training cameras start at 0.3, so that none looks exactly along the person's axis.
    for i in range(settings.train_cameras):
        places.append((0.3 + i * step, CAMERA_HEIGHTS[i % 3]))

    # Test cameras stand half-way between neighbours, spread evenly around the person.
    for k in range(settings.test_cameras):
        gap = (k * settings.train_cameras) // settings.test_cameras
        places.append((0.3 + (gap + 0.5) * step, TEST_HEIGHTS[k % 2]))
    return _cameras_at(places, points, settings.size)


def front(settings: SceneSettings, points: Array) -> list[SceneCamera]:
    """Cameras on an arc before the person, training cameras first, zoomed to ``points``."""
    step = CAMERA_ARC / settings.train_cameras
    places = []

    # Training cameras, spread evenly along the arc.
    for i in range(settings.train_cameras):
        places.append(((i + 0.5) * step - CAMERA_ARC / 2, ARC_HEIGHTS[i % 3]))

    # Test cameras, half-way between neighbours.
    for k in range(settings.test_cameras):
        gap = int(
            (k + 0.5) * (settings.train_cameras - 1) / settings.test_cameras
        )
        places.append(
            ((gap + 1) * step - CAMERA_ARC / 2, ARC_TEST_HEIGHTS[k % 2])
        )
    return _cameras_at(places, points, settings.size)


def _cameras_at(
    places: list[tuple[float, float]], points: Array, size: int
) -> list[SceneCamera]:
    """Cameras at azimuths and heights that look at the middle of the points."""
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    return [look_at(a, height, middle, points, size) for a, height in places]
