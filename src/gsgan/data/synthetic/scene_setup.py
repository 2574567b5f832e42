"""The synthetic scene in numbers: its parameters, cameras, person and motion.

Everything here follows from :class:`Settings` alone: worker processes rebuild the scene from them.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsgan.body.free import Body, free_body
from gsgan.data.cameras import DISTORTION_LENGTHS
from gsgan.data.synthetic.choreography import held_out
from gsgan.data.synthetic.identity import make_identity, marks_of
from gsgan.data.synthetic.lens import LensView, undistort
from gsgan.data.synthetic.motion import motion
from gsgan.data.synthetic.tint import Tint, make_tints
from gsgan.data.synthetic.trace import Light, Person, PosedPerson, View
from gsgan.scene import BodyPose
from gsgan.utils.errors import ConfigError

Array = NDArray[np.float64]

VERSION = 1
"""Of the generator. Raise it when any pixel changes: cached datasets are then made again."""

RADIUS = 2.8  # metres from the middle of the scene to the cameras
MARGIN = 0.02  # share of the image kept free at each edge, over all frames and cameras
MAX_TINT = 0.3
SCALES = (0.25, 4.0)  # range of test_scale
# Lower bounds of the whole-number parameters.
AT_LEAST = {
    "size": 8,
    "train_cameras": 1,
    "test_cameras": 0,
    "frames": 1,
    "test_frames": 0,
    "rays_per_pixel": 1,
    "seed": 0,
    "identity": 0,
}
# (joint that bends, joint towards which its folds run)
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
    """The parameters of a synthetic dataset; together with `VERSION` they determine every byte.

    Args:
        size: width and height of the images, pixels.
        train_cameras: on a ring around the person, evenly spaced.
        test_cameras: in the gaps between them.
        frames: moments of the choreography.
        test_frames: of these, held out (see :func:`gsgan.data.synthetic.choreography.held_out`).
        rays_per_pixel: anti-aliasing; docs/data.md has the cost of few rays.
        seed: of the motion and the tints.
        identity: of the clothes and colours.
        lens: distortion of every camera, OpenCV order k1 k2 p1 p2 k3 …; None or zeros: pinholes.
        tint: how much the training cameras differ in colour: largest change of a channel's gain.
        gloss: peak of the highlight on shirt, trousers and shoes, as a share of the sun's strength.
        test_scale: each test camera gets further copies with its focal length times these.

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
    identity: int = 0
    lens: tuple[float, ...] | None = None
    tint: float | None = None
    gloss: float | None = None
    test_scale: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        for name, least in AT_LEAST.items():
            value = getattr(self, name)
            whole = isinstance(value, int) and not isinstance(value, bool)
            _require(
                whole and value >= least,
                f"{name} must be a whole number of at least {least}, got {value!r}",
            )
        _require(
            self.test_frames < self.frames,
            f"test_frames must be less than frames = {self.frames}, got {self.test_frames}",
        )
        _require(
            self.test_cameras <= self.train_cameras,
            f"test_cameras stand between training cameras, so there can be at most "
            f"{self.train_cameras}, got {self.test_cameras}",
        )
        self._check_lens()
        self._check_share("tint", MAX_TINT)
        self._check_share("gloss", 1.0)
        self._check_test_scale()

    def _check_lens(self) -> None:
        if self.lens is None:
            return
        count = " or ".join(map(str, DISTORTION_LENGTHS))
        lens = _numbers("lens", self.lens, f"{count} lens coefficients (k1 k2 p1 p2 k3 …)")
        _require(
            len(lens) in DISTORTION_LENGTHS,
            f"lens must list {count} lens coefficients, got {len(lens)}",
        )
        object.__setattr__(self, "lens", lens if any(lens) else None)

    def _check_share(self, name: str, most: float) -> None:
        if getattr(self, name) is None:
            return
        (value,) = _numbers(name, [getattr(self, name)], "a number")
        _require(0 <= value <= most, f"{name} must be in [0, {most:g}], got {value:g}")
        object.__setattr__(self, name, value or None)

    def _check_test_scale(self) -> None:
        if self.test_scale is None:
            return
        scales = _numbers("test_scale", self.test_scale, "a list of relative focal lengths")
        low, high = SCALES
        for scale in scales:
            _require(
                low <= scale <= high and scale != 1,
                f"test_scale must list numbers in [{low:g}, {high:g}] other than 1, got {scale:g}",
            )
        _require(
            len({f"{scale:g}" for scale in scales}) == len(scales),
            "test_scale lists a number twice",
        )
        _require(
            not scales or self.test_cameras > 0,
            "test_scale adds copies of the test cameras, but there are none; set test_cameras",
        )
        object.__setattr__(self, "test_scale", scales or None)

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


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise ConfigError(f"synthetic data: {message}")


def _numbers(name: str, raw: Any, expected: str) -> tuple[float, ...]:
    listed = not isinstance(raw, str) and hasattr(raw, "__iter__")
    values = list(raw) if listed else []
    good = [isinstance(v, (int, float)) and not isinstance(v, bool) for v in values]
    _require(
        listed and all(good) and all(math.isfinite(v) for v in values),
        f"{name} must be {expected}, all finite, got {raw!r}",
    )
    return tuple(float(v) for v in values)


def dataset_key(settings: Settings) -> str:
    """Name of a dataset in the cache: its main parameters and a hash of all of them."""
    content = repr((VERSION, sorted(asdict(settings).items())))
    digest = hashlib.sha256(content.encode()).hexdigest()[:12]
    effects = [name for name in ("lens", "tint", "gloss", "test_scale") if getattr(settings, name)]
    return "-".join([f"person{settings.identity}-{settings.size}-{digest}", *effects])


@dataclass(frozen=True)
class Scene:
    """A whole synthetic scene, ready to be traced.

    Args:
        person: the constant part, in numpy.
        light: sun and sky.
        views: camera name to camera, training cameras first.
        tints: camera name to tint, for the tinted cameras. Held-out cameras stay neutral: nothing
            in the training data could reveal their tint.
        theta: ``[F, 56, 3]`` float32.
        transl: ``[F, 3]`` float32.
        passages: passage of each frame.
        train_cameras, test_cameras: names.
        train_frames, test_frames: frame ids.
    """

    person: Person
    light: Light
    views: dict[str, View]
    tints: dict[str, Tint]
    theta: torch.Tensor
    transl: torch.Tensor
    passages: list[str]
    train_cameras: list[str]
    test_cameras: list[str]
    train_frames: list[int]
    test_frames: list[int]

    def pose(self, frame: int) -> BodyPose:
        """The body pose of one frame, with a batch size of 1."""
        return BodyPose(self.theta[frame : frame + 1], self.transl[frame : frame + 1])

    def vertices(self, frame: int) -> Array:
        """``[V, 3]`` posed vertices, float64."""
        return free_body().posed_vertices(self.pose(frame))[0].double().numpy()

    def flexion(self, frame: int) -> Array:
        """``[K]`` radians by which each joint of `FOLDS` is bent."""
        names = free_body().joint_names
        index = [names.index(joint) for joint, _ in FOLDS]
        return self.theta[frame, index].double().norm(dim=-1).numpy()

    def posed(self, frame: int) -> PosedPerson:
        """The person at one frame, ready to be rendered."""
        return PosedPerson(self.person, self.vertices(frame), self.flexion(frame), self.light)


def build_scene(settings: Settings) -> Scene:
    """Everything of the scene but the images."""
    body = free_body()
    theta, transl, passages = motion(settings.frames, settings.seed)
    test_frames = held_out(settings.frames, settings.test_frames)
    names = [f"cam{i:02d}" for i in range(settings.train_cameras + settings.test_cameras)]
    train, test = names[: settings.train_cameras], names[settings.train_cameras :]
    views = dict(zip(names, ring(settings, extent(body, settings.seed)), strict=True))
    for name in list(test):
        for scale in settings.test_scale or ():
            views[f"{name}_x{scale:g}"] = zoomed(views[name], scale)
            test.append(f"{name}_x{scale:g}")
    if settings.lens is not None:
        views = {n: through_lens(v, np.array(settings.lens)) for n, v in views.items()}
    tints = make_tints(settings.tint, len(train), settings.seed) if settings.tint else []
    return Scene(
        person=make_person(body, settings.identity),
        light=Light(gloss=settings.gloss or 0.0),
        views=views,
        tints=dict(zip(train, tints, strict=False)),
        theta=theta,
        transl=transl,
        passages=passages,
        train_cameras=train,
        test_cameras=test,
        train_frames=[i for i in range(settings.frames) if i not in test_frames],
        test_frames=test_frames,
    )


def make_person(body: Body, identity: int) -> Person:
    """The free body in numpy, dressed as an identity."""
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
    """``[N, 3]`` points that the choreography reaches, metres.

    Every ``stride``-th vertex at a fixed number of moments: cameras fitted to these points do not
    depend on ``frames``.
    """
    theta, transl, _ = motion(samples, seed)
    thinned = replace(
        body,
        vertices=body.vertices[::stride],
        bone_index=body.bone_index[::stride],
        bone_weight=body.bone_weight[::stride],
    )
    return thinned.posed_vertices(BodyPose(theta, transl)).reshape(-1, 3).double().numpy()


def ring(settings: Settings, points: Array) -> list[View]:
    """Cameras around the person, training cameras first, zoomed to keep ``points`` in view."""
    n, low, high = settings.train_cameras, points.min(axis=0), points.max(axis=0)
    middle = (low + high) / 2
    step = 2 * math.pi / n
    # starting at 0.3, so that no camera looks exactly along the person's axis
    train = [(0.3 + i * step, (1.35, 0.95, 1.75)[i % 3]) for i in range(n)]
    gaps = [(i * n) // max(settings.test_cameras, 1) for i in range(settings.test_cameras)]
    test = [(0.3 + (i + 0.5) * step, (1.15, 1.55)[k % 2]) for k, i in enumerate(gaps)]
    return [look_at(a, h, middle, points, settings.size) for a, h in train + test]


def look_at(azimuth: float, height: float, middle: Array, points: Array, size: int) -> View:
    """A camera at an azimuth: 0 in front of the person, growing towards the person's left."""
    offset = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0]) * RADIUS
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
    focal = (1 - 2 * MARGIN) * size / (high - low).max()
    principal = size / 2 - focal * (low + high) / 2
    K = np.array([[focal, 0, principal[0]], [0, focal, principal[1]], [0, 0, 1]])
    return View(K, R, t, (size, size))


def zoomed(view: View, scale: float) -> View:
    """The same camera with its focal length times ``scale``, zoomed about the image's centre."""
    H, W = view.size
    K = view.K.copy()
    K[:2, :2] *= scale
    K[:2, 2] = scale * (K[:2, 2] - [W / 2, H / 2]) + [W / 2, H / 2]
    return replace(view, K=K)


def through_lens(view: View, dist: Array) -> LensView:
    """The same camera with a lens.

    Raises:
        ConfigError: when the distortion cannot be inverted up to the image's corners.
    """
    H, W = view.size
    corners = np.array([[x, y, 1.0] for x in (0, W / 2, W) for y in (0, H / 2, H)])
    undistort((corners @ np.linalg.inv(view.K).T)[:, :2], dist)
    return LensView(view.K, view.R, view.t, view.size, dist)
