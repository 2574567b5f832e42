"""The synthetic scene in numbers: its parameters, cameras, person and motion.

Everything here follows from :class:`Settings` alone: worker processes rebuild the scene from them.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gsgan.body.free import Body, free_body
from gsgan.data.cameras import DISTORTION_LENGTHS
from gsgan.data.synthetic.choreography import held_out
from gsgan.data.synthetic.identity import Marks, make_identity
from gsgan.data.synthetic.motion import motion
from gsgan.data.synthetic.trace import Light, Person, PosedPerson, View, make_tints, undistort
from gsgan.scene import BodyPose
from gsgan.utils.errors import ConfigError

Array = NDArray[np.float64]

VERSION = 1
"""Of the generator. Raise it when any pixel changes: cached datasets are then made again."""

RADIUS = 2.8  # metres from the middle of the scene to the cameras
MARGIN = 0.02  # share of the image kept free at each edge, over all frames and cameras
WHOLE, NUMBER, LIST = "a whole number", "a number", "a list of numbers"
# Kind and range of each parameter; those that are not whole numbers may be None.
RANGES = {
    "size": (WHOLE, 8, math.inf),
    **dict.fromkeys(("train_cameras", "frames", "rays_per_pixel"), (WHOLE, 1, math.inf)),
    **dict.fromkeys(("test_cameras", "test_frames", "seed", "identity"), (WHOLE, 0, math.inf)),
    "lens": (LIST, -math.inf, math.inf),
    "tint": (NUMBER, 0, 0.3),
    "gloss": (NUMBER, 0, 1),
    "test_scale": (LIST, 0.25, 4),
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
    """The parameters of a synthetic dataset, as in conf/data/synthetic.yaml.

    Together with `VERSION` they determine every byte. Effects without effect are stored as None.

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
        for name, (kind, low, high) in RANGES.items():
            raw = getattr(self, name)
            if raw is None and kind != WHOLE:
                continue
            try:
                values = np.array(raw, dtype=float)
            except (TypeError, ValueError):
                values = np.array(math.nan)
            good = np.isfinite(values) & (values >= low) & (values <= high)
            typed = not isinstance(raw, bool) and (kind != WHOLE or isinstance(raw, int))
            _require(
                typed and values.ndim == (kind == LIST) and bool(good.all()),
                f"{name} must be {kind} in [{low:g}, {high:g}], got {raw!r}",
            )
            if kind != WHOLE:
                numbers = values.tolist()
                stored = tuple(numbers) if kind == LIST else numbers
                object.__setattr__(self, name, stored if values.any() else None)
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
        raise ConfigError(f"synthetic data: {message}")


def dataset_key(settings: Settings) -> str:
    """Name of a dataset in the cache: its main parameters and a hash of all of them."""
    content = repr((VERSION, sorted(asdict(settings).items())))
    digest = hashlib.sha256(content.encode()).hexdigest()[:12]
    effects = [name for name in ("lens", "tint", "gloss", "test_scale") if getattr(settings, name)]
    return "-".join([f"person{settings.identity}-{settings.size}-{digest}", *effects])


class Scene:
    """A whole synthetic scene, ready to be traced.

    ``theta [F, 56, 3]`` and ``transl [F, 3]`` are float32; ``views`` and ``tints`` are by camera
    name, training cameras first. Held-out cameras have no tint: nothing in the training data could
    reveal it.

    Raises:
        ConfigError: when a lens cannot be inverted up to the images' corners.
    """

    def __init__(self, settings: Settings) -> None:
        body = free_body()
        self.settings, self.light = settings, Light(gloss=settings.gloss or 0.0)
        self.person = make_person(body, settings.identity)
        self.theta, self.transl, self.passages = motion(settings.frames, settings.seed)
        self.test_frames = held_out(self.passages, settings.test_frames)
        self.train_frames = [i for i in range(settings.frames) if i not in self.test_frames]
        names = [f"cam{i:02d}" for i in range(settings.train_cameras + settings.test_cameras)]
        self.train_cameras = names[: settings.train_cameras]
        self.views = dict(zip(names, ring(settings, extent(body, settings.seed)), strict=True))
        for name in names[settings.train_cameras :]:
            for scale in settings.test_scale or ():
                self.views[f"{name}_x{scale:g}"] = zoomed(self.views[name], scale)
        self.test_cameras = list(self.views)[settings.train_cameras :]
        if settings.lens is not None:
            dist = np.array(settings.lens)
            self.views = {name: through_lens(v, dist) for name, v in self.views.items()}
        tints = make_tints(settings.tint or 0.0, settings.train_cameras, settings.seed)
        self.tints = dict(zip(self.train_cameras, tints, strict=True)) if settings.tint else {}

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
        marks=Marks(body.landmarks.double().numpy()),
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


def through_lens(view: View, dist: Array) -> View:
    """The same camera with a lens, which is checked up to the image's corners."""
    H, W = view.size
    corners = np.array([[x, y, 1.0] for x in (0, W / 2, W) for y in (0, H / 2, H)])
    undistort((corners @ np.linalg.inv(view.K).T)[:, :2], dist)
    return replace(view, dist=dist)
