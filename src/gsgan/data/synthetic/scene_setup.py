"""The synthetic scene in numbers: its parameters, its cameras, its person, its motion.

Everything here follows from :class:`Settings` alone, so that workers rebuild it instead of being
sent it.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsgan.body.free import Body, free_body, free_body_path
from gsgan.data.synthetic.identity import make_identity, marks_of
from gsgan.data.synthetic.motion import held_out, motion
from gsgan.data.synthetic.trace import Person, View
from gsgan.scene import BodyPose
from gsgan.utils.errors import ConfigError

Array = NDArray[np.float64]

# joint that bends, and the joint its folds run towards
FOLDS = (
    ("upperarm01.L", "lowerarm01.L"),
    ("upperarm01.R", "lowerarm01.R"),
    ("upperleg01.L", "lowerleg01.L"),
    ("upperleg01.R", "lowerleg01.R"),
    ("lowerleg01.L", "foot.L"),
    ("lowerleg01.R", "foot.R"),
    ("spine03", "spine01"),
)


@dataclass(frozen=True)
class Settings:
    """Every parameter of a synthetic dataset; what is not here does not change a byte of it.

    Args:
        size: width and height of the pictures, pixels.
        train_cameras: on a ring around the person, evenly.
        test_cameras: in the gaps between them.
        frames: moments of the choreography.
        test_frames: of these, held out (see :func:`gsgan.data.synthetic.motion.held_out`).
        rays_per_pixel: anti-aliasing; docs/data.md tells what few of them cost.
        seed: of the motion.
        identity: of the clothes and colours.
        radius: metres from the middle of the scene to the cameras.
        margin: share of the picture kept free at each edge, over all frames and cameras.

    Raises:
        ConfigError: naming the parameter that makes no sense.
    """

    size: int = 128
    train_cameras: int = 6
    test_cameras: int = 2
    frames: int = 84
    test_frames: int = 21
    rays_per_pixel: int = 16
    seed: int = 0
    identity: int = 0
    radius: float = 2.8
    margin: float = 0.02

    def __post_init__(self) -> None:
        for name, least in (
            ("size", 8),
            ("train_cameras", 1),
            ("test_cameras", 0),
            ("frames", 1),
            ("test_frames", 0),
            ("rays_per_pixel", 1),
            ("seed", 0),
            ("identity", 0),
        ):
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool) or value < least:
                raise ConfigError(
                    f"synthetic data: {name} must be a whole number of at least {least}, "
                    f"got {value!r}"
                )
        if self.test_frames >= self.frames:
            raise ConfigError(
                f"synthetic data: test_frames must be less than frames = {self.frames}, "
                f"got {self.test_frames}"
            )
        if self.test_cameras > self.train_cameras:
            raise ConfigError(
                f"synthetic data: test_cameras lie between training cameras, so at most "
                f"{self.train_cameras} of them fit, got {self.test_cameras}"
            )
        if not 1.8 <= self.radius <= 20:
            raise ConfigError(
                f"synthetic data: radius must lie in [1.8, 20] metres, so that no camera stands "
                f"inside the person's reach, got {self.radius}"
            )
        if not 0 <= self.margin < 0.4:
            raise ConfigError(f"synthetic data: margin must lie in [0, 0.4), got {self.margin}")

    @classmethod
    def from_parameters(cls, parameters: dict[str, Any]) -> Settings:
        """Settings from keyword arguments.

        Raises:
            ConfigError: when a name is unknown.
        """
        known = [field.name for field in fields(cls)]
        unknown = sorted(set(parameters) - set(known))
        if unknown:
            raise ConfigError(
                f"synthetic data: unknown parameter {unknown[0]!r}; known are {', '.join(known)}"
            )
        return cls(**parameters)


def dataset_key(settings: Settings) -> str:
    """Name of a dataset in the cache: a hash of every parameter, the asset and the generator."""
    digest = hashlib.sha256(repr(sorted(asdict(settings).items())).encode())
    here = Path(__file__).resolve().parent
    body = here.parents[1] / "body"
    moves = [body / name for name in ("free.py", "lbs.py", "skinned.py")]
    sources = [*sorted(here.glob("*.py")), *moves, free_body_path()]
    for path in sources:
        digest.update(path.name.encode() + path.read_bytes())
    return f"person{settings.identity}-{settings.size}-{digest.hexdigest()[:12]}"


@dataclass(frozen=True)
class Stage:
    """A whole synthetic scene, ready to be traced.

    Args:
        person: what does not change, in numpy.
        views: camera name to camera, training cameras first.
        theta: ``[F, 56, 3]`` float32.
        transl: ``[F, 3]`` float32.
        passages: name of each frame's passage.
        train_cameras, test_cameras: names.
        train_frames, test_frames: frame ids.
    """

    person: Person
    views: dict[str, View]
    theta: torch.Tensor
    transl: torch.Tensor
    passages: list[str]
    train_cameras: list[str]
    test_cameras: list[str]
    train_frames: list[int]
    test_frames: list[int]

    def pose(self, frame: int) -> BodyPose:
        """The body pose of one frame, batched by one."""
        return BodyPose(self.theta[frame : frame + 1], self.transl[frame : frame + 1])

    def vertices(self, frame: int) -> Array:
        """``[V, 3]`` posed vertices, float64."""
        return free_body().posed_vertices(self.pose(frame))[0].double().numpy()

    def flexion(self, frame: int) -> Array:
        """``[K]`` radians each fold joint is bent."""
        names = free_body().joint_names
        index = [names.index(joint) for joint, _ in FOLDS]
        return self.theta[frame, index].double().norm(dim=-1).numpy()


def build_stage(settings: Settings) -> Stage:
    """Everything of the scene but the pictures."""
    body = free_body()
    theta, transl, passages = motion(settings.frames, settings.seed)
    test = held_out(settings.frames, settings.test_frames)
    names = [f"cam{i:02d}" for i in range(settings.train_cameras + settings.test_cameras)]
    views = ring(settings, extent(body, settings.seed))
    return Stage(
        person=numpy_person(body, settings.identity),
        views=dict(zip(names, views, strict=True)),
        theta=theta,
        transl=transl,
        passages=passages,
        train_cameras=names[: settings.train_cameras],
        test_cameras=names[settings.train_cameras :],
        train_frames=[i for i in range(settings.frames) if i not in test],
        test_frames=test,
    )


def numpy_person(body: Body, identity: int) -> Person:
    """The body as the tracer wants it, dressed as an identity."""
    joint = {n: body.joints[i].double().numpy() for i, n in enumerate(body.joint_names)}
    axis = np.array([joint[end] - joint[start] for start, end in FOLDS])
    return Person(
        vertices=body.vertices.double().numpy(),
        faces=body.faces.numpy(),
        labels=body.face_labels.numpy(),
        surface=body.face_surface.numpy(),
        fold_centre=np.array([joint[start] for start, _ in FOLDS]),
        fold_axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
        identity=make_identity(identity),
        marks=marks_of(body.landmarks.double().numpy()),
    )


def extent(body: Body, seed: int, samples: int = 160, stride: int = 24) -> Array:
    """``[N, 3]`` points the whole choreography reaches, whatever the number of frames.

    A share of the vertices at a fixed number of moments: cameras fitted to these do not change with
    ``frames``.
    """
    theta, transl, _ = motion(samples, seed)
    thin = _every(body, stride)
    return thin.posed_vertices(BodyPose(theta, transl)).reshape(-1, 3).double().numpy()


def _every(body: Body, stride: int) -> Body:
    return replace(
        body,
        vertices=body.vertices[::stride],
        bone_index=body.bone_index[::stride],
        bone_weight=body.bone_weight[::stride],
    )


def ring(settings: Settings, points: Array) -> list[View]:
    """Cameras around the person, training ones first, each zoomed to keep ``points`` in view."""
    n, low, high = settings.train_cameras, points.min(axis=0), points.max(axis=0)
    middle = (low + high) / 2
    step = 2 * math.pi / n
    # 0.3: no camera looks exactly along the person's axis
    train = [(0.3 + i * step, (1.35, 0.95, 1.75)[i % 3]) for i in range(n)]
    gaps = [(i * n) // max(settings.test_cameras, 1) for i in range(settings.test_cameras)]
    test = [(0.3 + (i + 0.5) * step, (1.15, 1.55)[k % 2]) for k, i in enumerate(gaps)]
    return [look_at(a, h, middle, points, settings) for a, h in train + test]


def look_at(
    azimuth: float, height: float, middle: Array, points: Array, settings: Settings
) -> View:
    """A camera at an azimuth (0 = before the person, growing towards the person's left)."""
    offset = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0]) * settings.radius
    centre = np.array([middle[0], middle[1], height]) + offset
    forward = middle - centre
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    t = -R @ centre
    x = points @ R.T + t
    rays = x[:, :2] / x[:, 2:]
    low, high = rays.min(axis=0), rays.max(axis=0)
    focal = (1 - 2 * settings.margin) * settings.size / (high - low).max()
    principal = settings.size / 2 - focal * (low + high) / 2
    K = np.array([[focal, 0, principal[0]], [0, focal, principal[1]], [0, 0, 1]])
    return View(K, R, t, (settings.size, settings.size))
