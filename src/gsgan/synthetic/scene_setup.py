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
from gsgan.synthetic.camera import SceneCamera, look_at, through_lens, zoomed
from gsgan.synthetic.choreography import EVERYDAY, held_out
from gsgan.synthetic.controls import frame_times
from gsgan.synthetic.far import FAR
from gsgan.synthetic.free_subject import free_character, free_pose
from gsgan.synthetic.gltf import AVATARS, read_character
from gsgan.synthetic.posing import Choreography
from gsgan.synthetic.recorded_motion import RECORDED, RecordedMotion
from gsgan.synthetic.secondary import Moving, Secondary
from gsgan.synthetic.signs import SIGNS, split_signs
from gsgan.synthetic.trace import Appearance, Light, PosedCharacter, Wrinkles
from gsgan.utils.arrays import as_floats
from gsgan.utils.checks import between, one_of, whole
from gsgan.utils.errors import ConfigError, DataError

Array = NDArray[np.float64]

TINT_STREAM = 77
CROSSTALK = 0.25  # leak from channel to channel, as a share of the tint
OFFSET = 0.25  # largest offset of a channel, as a share of the tint


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
    gain = rng.uniform(-1, 1, (cameras, 3))
    leak = rng.uniform(-1, 1, (cameras, 9))
    offset = rng.uniform(-1, 1, (cameras, 3))
    leak = leak.reshape(-1, 3, 3) * (1 - np.eye(3))
    # a leak is subtracted from the channel itself, so that grey stays grey but for the gains
    leak -= leak.sum(axis=2, keepdims=True) * np.eye(3)
    change = _centred(gain)[:, :, None] * np.eye(3) + CROSSTALK * _centred(leak)
    shift = OFFSET * _centred(offset)
    return [
        Tint(np.eye(3) + strength * a, strength * b)
        for a, b in zip(change, shift, strict=True)
    ]


def _centred(x: Array) -> Array:
    """Shifted to mean 0 over the cameras, then scaled to within [-1, 1]."""
    x = x - x.mean(axis=0)
    return x / max(1.0, float(np.abs(x).max(initial=0)))


VERSION = 2
"""Of the generator. Raise it when any pixel changes: cached datasets are then made again."""

DEFAULT, FREE_BODY, CHOREOGRAPHY, SIGNING, FURTHER = (
    *("polo", "free_body", "choreography", "signs", "far"),
)
PROGRAMMES = {CHOREOGRAPHY: EVERYDAY, SIGNING: SIGNS, FURTHER: FAR}
ARC = math.radians(150)  # round the front of a person who signs
# Least value of each whole number, and the ranges of those that may be None.
LEAST = {"size": 8, "train_cameras": 1, "frames": 1, "rays_per_pixel": 1}
LEAST |= {"test_cameras": 0, "test_frames": 0, "seed": 0}
NUMBERS = {"tint": (0.0, 0.3), "gloss": (0.0, 1.0)}
LISTS = {"lens": (-math.inf, math.inf), "test_scale": (0.25, 4)}


@dataclass(frozen=True)
class SceneSettings:
    """The parameters of a synthetic dataset, as in conf/data/synthetic.yaml.

    Together with `VERSION` they determine every byte. Disabled effects are stored as None.

    Raises:
        ConfigError: naming the parameter that is out of range.
    """

    size: int = 128
    train_cameras: int = 6
    test_cameras: int = 2
    frames: int = 84
    test_frames: int = 21
    rays_per_pixel: int = 16
    seed: int = 0
    avatar: str = DEFAULT
    motion: str = CHOREOGRAPHY
    secondary: bool = True
    lens: tuple[float, ...] | None = None
    tint: float | None = None
    gloss: float | None = None
    test_scale: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        for name, least in LEAST.items():
            whole(f"data.source.{name}", getattr(self, name), least)
        for name, bounds in NUMBERS.items():
            if (value := getattr(self, name)) is not None:
                between(f"data.source.{name}", value, *bounds)
            object.__setattr__(self, name, float(value) if value else None)
        for name, (low, high) in LISTS.items():
            raw = getattr(self, name)
            values = as_floats([] if raw is None else raw)
            _require(
                (raw is None or (isinstance(raw, Sequence) and len(values) == len(raw)))
                and bool(
                    (np.isfinite(values) & (values >= low) & (values <= high)).all()
                ),
                f"{name} must be a list of numbers in [{low:g}, {high:g}], got {raw!r}",
            )
            object.__setattr__(
                self, name, tuple(values.tolist()) if values.any() else None
            )
        named = (*AVATARS, FREE_BODY)
        _require(
            self.avatar in named or str(self.avatar).endswith(".glb"),
            f"avatar must be {', '.join(named)} or the path of a rigged .glb, got {self.avatar!r}",
        )
        _require(
            self.motion in tuple(PROGRAMMES) or str(self.motion).endswith(RECORDED),
            f"motion must be {', '.join(PROGRAMMES)} or the path of a .bvh or .amc, "
            f"got {self.motion!r}",
        )
        one_of("data.source.secondary", self.secondary, (True, False))
        _require(
            self.test_frames < self.frames,
            f"test_frames must be less than frames = {self.frames}, got {self.test_frames}",
        )
        _require(
            self.test_cameras <= self.train_cameras,
            f"test_cameras stand between training cameras, so there can be at most "
            f"{self.train_cameras}, got {self.test_cameras}",
        )
        _require(
            self.lens is None or len(self.lens) in DISTORTION_LENGTHS,
            f"lens must list {' or '.join(map(str, DISTORTION_LENGTHS))} coefficients "
            "(k1 k2 p1 p2 k3 …)",
        )
        _require(
            self.test_scale is None or self.test_cameras > 0,
            "test_scale adds copies of the test cameras, but there are none; set test_cameras",
        )


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise ConfigError(f"data.source.{message}")


def dataset_key(settings: SceneSettings) -> str:
    """Name of a dataset in the cache: its main parameters and a hash of all of them.

    Files count by their content, not by their path.

    Raises:
        DataError: when a file does not exist.
    """
    parameters = asdict(settings)
    for name in ("avatar", "motion"):
        if parameters[name] not in (*AVATARS, FREE_BODY, *PROGRAMMES):
            path = Path(parameters[name]).expanduser()
            if not path.is_file():
                raise DataError(f"data.source.{name}: {path} does not exist")
            parameters[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    content = repr((VERSION, sorted(parameters.items())))
    digest = hashlib.sha256(content.encode()).hexdigest()[:12]
    effects = [
        name
        for name in ("lens", "tint", "gloss", "test_scale")
        if getattr(settings, name)
    ]
    return "-".join(
        [f"{Path(settings.avatar).stem}-{settings.size}-{digest}", *effects]
    )


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
        self.character = character = load_character(settings.avatar)
        self.appearance = Appearance(character)
        self.source: Moving = (
            Choreography(character, settings.seed, PROGRAMMES[settings.motion])
            if settings.motion in PROGRAMMES
            else RecordedMotion(
                character, Path(settings.motion).expanduser(), settings.seed
            )
        )
        times = frame_times(settings.frames, self.source.duration)
        self.motion = self.source.at(times)
        self.secondary = (
            Secondary(character, self.source) if settings.secondary else None
        )
        self.times = times
        passages = self.motion.passages
        signing = settings.motion == SIGNING
        if signing:
            self.train_frames, self.test_frames = split_signs(
                passages, settings.test_frames
            )
        else:
            self.test_frames = held_out(passages, settings.test_frames)
            self.train_frames = [
                i for i in range(settings.frames) if i not in self.test_frames
            ]
        names = [
            f"cam{i:02d}" for i in range(settings.train_cameras + settings.test_cameras)
        ]
        self.train_cameras = names[: settings.train_cameras]
        points = extent(character, self.source, upper=signing)
        views = (front if signing else ring)(settings, points)
        self.views = dict(zip(names, views, strict=True))
        for name in names[settings.train_cameras :]:
            for scale in settings.test_scale or ():
                self.views[f"{name}_x{scale:g}"] = zoomed(self.views[name], scale)
        self.test_cameras = list(self.views)[settings.train_cameras :]
        if settings.lens is not None:
            dist = np.array(settings.lens)
            self.views = {name: through_lens(v, dist) for name, v in self.views.items()}
        tints = make_tints(settings.tint or 0.0, settings.train_cameras, settings.seed)
        self.tints = (
            dict(zip(self.train_cameras, tints, strict=True)) if settings.tint else {}
        )

    def mesh(self, frame: int) -> tuple[Array, Array, Wrinkles | None]:
        """Vertices (metres) and unit normals ``[V, 3]`` of a frame, and the wrinkles of cloth."""
        vertices, normals = self._skinned(frame)
        if self.secondary is None:
            return vertices, normals, None
        rotations = self.motion.rotations[frame]
        return self.secondary(float(self.times[frame]), rotations, vertices, normals)

    def posed(self, frame: int) -> PosedCharacter:
        """The character at one frame, ready to be rendered."""
        vertices, normals, wrinkles = self.mesh(frame)
        return PosedCharacter(self.appearance, vertices, normals, self.light, wrinkles)

    def landmarks(self) -> tuple[tuple[str, ...], Array]:
        """Names and positions ``[F, L, 3]`` (metres) of the landmarks of all frames.

        They are where skinning puts them: sway and wrinkles do not move a skeleton.
        """
        if self.settings.avatar == FREE_BODY:
            body = free_body()
            pose = free_pose(self.motion)
            points = torch.cat(
                [body.posed_landmarks(pose), body.posed_hands(pose)], dim=1
            )
            return (*body.landmark_names, *body.hand_names), points.double().numpy()
        character = self.character
        joints = self.motion.joints
        posed = [
            character.landmarks(self._skinned(f)[0], p) for f, p in enumerate(joints)
        ]
        return character.anchor_names, np.stack(posed)

    def _skinned(self, frame: int) -> tuple[Array, Array]:
        character = self.character
        motion = self.motion
        offsets = sum(
            (
                motion.shapes[name][frame] * shape
                for name, shape in character.shapes.items()
                if name in motion.shapes
            ),
            np.zeros_like(character.vertices),
        )
        return character.skinned(motion.rotations[frame], motion.joints[frame], offsets)


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
    chosen = np.arange(len(character.vertices))
    if upper:
        trunk = character.with_descendants(character.bones.index("Spine"))
        chosen = np.flatnonzero(np.isin(character.dominant_bones(), trunk))
    chosen = chosen[::stride]
    motion = source.at(frame_times(samples, source.duration))
    thinned = replace(
        character,
        vertices=character.vertices[chosen],
        normals=character.normals[chosen],
        bone_index=character.bone_index[chosen],
        bone_weight=character.bone_weight[chosen],
    )
    poses = zip(motion.rotations, motion.joints, strict=True)
    return np.concatenate([thinned.skinned(R, joints)[0] for R, joints in poses])


def ring(settings: SceneSettings, points: Array) -> list[SceneCamera]:
    """Cameras around the person, training cameras first, zoomed to keep ``points`` in view."""
    n = settings.train_cameras
    low = points.min(axis=0)
    high = points.max(axis=0)
    middle = (low + high) / 2
    step = 2 * math.pi / n
    # starting at 0.3, so that no camera looks exactly along the person's axis
    train = [(0.3 + i * step, (1.35, 0.95, 1.75)[i % 3]) for i in range(n)]
    gaps = [
        (i * n) // max(settings.test_cameras, 1) for i in range(settings.test_cameras)
    ]
    test = [(0.3 + (i + 0.5) * step, (1.15, 1.55)[k % 2]) for k, i in enumerate(gaps)]
    return [look_at(a, h, middle, points, settings.size) for a, h in train + test]


def front(settings: SceneSettings, points: Array) -> list[SceneCamera]:
    """Cameras on an arc before the person, training cameras first, zoomed to ``points``."""
    n = settings.train_cameras
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    step = ARC / n
    train = [((i + 0.5) * step - ARC / 2, (1.35, 1.55, 1.2)[i % 3]) for i in range(n)]
    gaps = [
        int((k + 0.5) * (n - 1) / settings.test_cameras)
        for k in range(settings.test_cameras)
    ]
    test = [
        ((gap + 1) * step - ARC / 2, (1.45, 1.3)[k % 2]) for k, gap in enumerate(gaps)
    ]
    return [look_at(a, h, middle, points, settings.size) for a, h in train + test]
