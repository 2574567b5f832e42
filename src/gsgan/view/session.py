"""One browser's view of the avatar: camera, pose, layer, and which image is rendered next."""

import tempfile
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from gsgan.body import SkinnedBody
from gsgan.metrics.segmentation import colour_labels
from gsgan.model.avatar import Avatar
from gsgan.model.rendering import Rendering
from gsgan.run.drive import Drive, inputs_of, joints_of
from gsgan.scene import BodyPose, Camera, Gaussians
from gsgan.utils.errors import GsganError
from gsgan.utils.images import eight_bits
from gsgan.utils.provenance import png_bytes
from gsgan.view.drag import NAMES, dragged, position

Float = NDArray[np.float64]
Bytes = NDArray[np.uint8]

IDLE = 0.1  # seconds between two checks whether an image is due
RESTS = 0.3  # seconds without movement after which the full-size image is rendered
SMALLEST = 0.25  # least scale of the images while something moves
WIDEST = 3.0  # bound on the aspect ratio, since a browser window can have any
SPEED_OVER = 2.0  # seconds over which the displayed rate is averaged
YELLOW = (255, 200, 0)
GREY = (160, 165, 175)
# layers
IMAGE = "image"
COLOUR = "Step I's colour"
PARTS = "segmentation S"
ALPHA = "alpha"


@dataclass
class Show:
    """What all sessions share.

    Args:
        avatar: frozen.
        body: that the avatar moves with, or None.
        drive: the first motion.
        read: reads the motion in an uploaded file.
        behind: the background ``[3, H, W]`` of a size.
        size: height of a full-size image, pixels.
        fps: frames per second of a motion that plays.
        rate: images per second to reach while something moves.
    """

    avatar: Avatar
    body: SkinnedBody | None
    drive: Drive
    read: Callable[[str], Drive]
    behind: Callable[[tuple[int, int]], torch.Tensor]
    size: int
    fps: float
    rate: float


class Session:
    """One client of the server; only the rendering thread calls `step`."""

    def __init__(self, client: Any, show: Show, wake: Callable[[], None]) -> None:
        self.client = client
        self.show = show
        self._wake = wake
        self.drive = show.drive
        self.frame = 0
        self.pose: Float | None = None  # dragged
        self.changed = self.moved = time.monotonic()
        self.started = 0.0  # when rendering of the current image began
        self.full = False  # whether the current image is of full size
        self.seconds = 0.0  # to render a full-size image
        self.times: deque[float] = deque(maxlen=200)
        self.image: NDArray[np.uint8] | None = None
        self._problem = ""  # that the page shows
        self._drawn: tuple[Any, ...] = ()  # what the 3D nodes show
        self._nodes: list[Any] = []
        self._gizmos: dict[str, Any] = {}
        self._controls()

    # -- the page

    def _controls(self) -> None:
        gui = self.client.gui
        client = self.client
        self.status = gui.add_text("images per second", "", disabled=True)
        known = self.show.avatar.poses is not None
        self.far = gui.add_text(
            "deviations from training", "", disabled=True, visible=known
        )
        self.layer = gui.add_dropdown(
            "layer", layers(self.show.avatar), initial_value=IMAGE
        )
        with gui.add_folder("motion"):
            self.slider = gui.add_slider(
                "frame", 0, max(1, len(self.drive.p) - 1), 1, 0
            )
            self.play = gui.add_checkbox("play", False)
            upload = gui.add_upload_button("load a motion file")
            self.description = gui.add_markdown(self.drive.text)
        with gui.add_folder("3D"):
            self.handles = gui.add_checkbox("drag joints", False)
            reset = gui.add_button("undo dragging")
            self.bones = gui.add_checkbox("skeleton", False)
            self.mesh = gui.add_checkbox(
                "body", False, visible=self.show.body is not None
            )
            self.splats = gui.add_checkbox("Gaussians", False)
        save = gui.add_button("save the image")
        for control in (self.layer, self.bones, self.mesh, self.splats):
            control.on_update(lambda _: self.touch(moving=False))
        self.play.on_update(lambda _: self._played())
        self.handles.on_update(lambda _: self._show_handles())
        self.slider.on_update(self._scrubbed)
        upload.on_upload(lambda event: self._load(event.target.value))
        reset.on_click(lambda _: self._scrub(self.frame))
        save.on_click(lambda _: self._save())
        client.camera.on_update(lambda _: self.touch())

    def touch(self, moving: bool = True) -> None:
        """Requests a new image: a fast one while something moves, else one of full size."""
        self.changed = time.monotonic()
        if moving:
            self.moved = self.changed
        self._wake()

    def _played(self) -> None:
        self.started = 0.0  # the time since the last image is no part of the motion
        self.touch(moving=False)

    def _scrubbed(self, event: Any) -> None:
        if event.client_id is not None:  # moved by the user, not by `step`
            self._scrub(int(self.slider.value))

    def _scrub(self, frame: int) -> None:
        self.frame = min(frame, len(self.drive.p) - 1)
        self.pose = None
        self.touch()

    def _load(self, file: Any) -> None:
        """Loads an uploaded motion; an error is shown on the page."""
        try:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / Path(file.name).name
                path.write_bytes(file.content)
                drive = self.show.read(str(path))
        except Exception as error:  # whatever the file is, the server must keep running
            self._warn(
                "This motion cannot be used", _message(error).replace(folder + "/", "")
            )
            return
        self.drive = drive
        self.description.content = drive.text
        self.slider.max = max(1, len(drive.p) - 1)
        self.slider.value = 0
        self._scrub(0)

    def _warn(self, title: str, text: str) -> None:
        self.client.add_notification(title, text, color="red")

    def _save(self) -> None:
        if self.image is not None:
            name = f"gsgan_{self.frame:06d}.png"
            self.client.send_file_download(
                name, png_bytes(Image.fromarray(self.image)), save_immediately=True
            )

    # -- dragging

    def _show_handles(self) -> None:
        old, self._gizmos = self._gizmos, {}
        for gizmo in old.values():
            gizmo.remove()
        if self.handles.value:
            gizmos = {}
            for name in NAMES:
                gizmo = self.client.scene.add_transform_controls(
                    f"/drag/{name}",
                    scale=0.12,
                    disable_rotations=True,
                    depth_test=False,
                    position=position(self.joints(), name),
                )
                gizmo.on_update(
                    lambda event, name=name: self.drag(name, event.target.position)
                )
                gizmos[name] = gizmo
            self._gizmos = gizmos  # at once: the rendering thread iterates over them
        self.touch(moving=False)

    def drag(self, name: str, target: Any) -> None:
        """Moves a joint to ``target`` ``[3]``, metres."""
        self.pose = dragged(self.joints(), name, np.asarray(target, np.float64))
        self.play.value = False
        for other, gizmo in self._gizmos.items():
            if other != name:
                gizmo.position = position(self.pose, other)
        self.touch()

    def joints(self) -> Float:
        """``[J, 3]`` metres, finite: the current pose, J the joints that the motion has."""
        if self.pose is not None:
            return self.pose
        current = self._current()
        p, _ = joints_of(self.show.avatar, current, 0)
        return np.asarray(p[0, : current.p.shape[1]].cpu().numpy(), np.float64)

    def _current(self) -> Drive:
        """The current pose, as a motion of one frame."""
        # another thread may load a shorter motion
        drive = self.drive
        pose = self.pose
        drive = drive.rows(np.array([self.frame % len(drive.p)]))
        if pose is None:
            return drive
        return replace(
            drive, p=pose[None], visibility=drive.visibility[:, : len(pose)], body=None
        )

    # -- rendering

    def step(self) -> float:
        """Renders an image if one is due; returns the seconds until the next one may be."""
        now = time.monotonic()
        if self.play.value and len(self.drive.p) > 1:
            if (early := self.started + 1 / self.show.fps - now) > 0:
                return early
            passed = (
                max(1, round((now - self.started) * self.show.fps))
                if self.started
                else 1
            )
            self.frame = (self.frame + passed) % len(self.drive.p)
            self.pose = None
            self.slider.value = self.frame
            self.changed = self.moved = now
        moving = now - self.moved < RESTS
        if self.started > self.changed and (self.full or moving):
            return self.moved + RESTS - now if moving else IDLE
        share = 1.0
        if moving and self.seconds:
            share = min(1.0, max(SMALLEST, (1 / self.show.rate / self.seconds) ** 0.5))
        self.started = now
        self.full = False
        try:
            self._render(share)
        # whatever the pose is, the thread renders for all browsers
        except Exception as error:
            if self._problem != _message(error):  # once, not for every image
                self._problem = _message(error)
                self._warn("This pose cannot be rendered", self._problem)
            self.play.value = False
            self.full = True
            return IDLE
        self._problem = ""
        self.full = share == 1
        took = time.monotonic() - now
        whole = took / share**2
        self.seconds = whole if not self.seconds else 0.7 * self.seconds + 0.3 * whole
        return 0.0

    def camera(self, share: float) -> Camera:
        """The browser's camera, its image ``share`` times the full height."""
        view = self.client.camera
        height = max(16, round(self.show.size * share))
        aspect = min(WIDEST, max(1 / WIDEST, view.aspect))
        size = height, max(16, round(height * aspect))
        focal = height / 2 / np.tan(view.fov / 2)
        w, x, y, z = view.wxyz
        R = Rotation.from_quat([x, y, z, w]).as_matrix().T
        K = [[focal, 0, size[1] / 2], [0, focal, size[0] / 2], [0, 0, 1]]
        t = -R @ view.position
        world = [
            torch.tensor(np.array(a), dtype=torch.float32)[None] for a in (K, R, t)
        ]
        return Camera(world[0], world[1], world[2], size)

    def _render(self, share: float) -> None:
        avatar = self.show.avatar
        layer = self.layer.value
        current = self._current()
        camera = self.camera(share)
        p, visibility, body = inputs_of(avatar, current, 0)
        maps = layer != IMAGE or self.splats.value
        with torch.no_grad():
            rendering = avatar.rendered(p, visibility, camera, body, maps=maps)
        if avatar.poses is not None:
            self.far.value = f"{float(avatar.poses.distance(p)):.1f}"
        behind = self.show.behind(camera.size)
        self.image = drawn = shown(layer, rendering, behind)
        # the browser draws these instead
        if self.splats.value and rendering.gaussians is not None:
            drawn = eight_bits(behind, torch.ones(1), behind)
        self.client.scene.set_background_image(drawn, "jpeg", jpeg_quality=90)
        self._place(
            rendering.gaussians, np.asarray(p[0].cpu().numpy(), np.float64), body
        )
        self.times.append(time.monotonic())
        recent = [x for x in self.times if x > self.times[-1] - SPEED_OVER]
        rate = (len(recent) - 1) / max(recent[-1] - recent[0], 1e-6)
        height, width = self.image.shape[:2]
        shown_rate = f"{rate:.1f} at " if len(recent) > 1 else ""
        self.status.value = f"{shown_rate}{width} × {height}"

    def _place(self, splats: Gaussians | None, p: Float, pose: BodyPose | None) -> None:
        """Draws skeleton, body and Gaussians, and moves the handles that are not being dragged."""
        scene = self.client.scene
        avatar = self.show.avatar
        body = self.show.body
        splats = splats if self.splats.value else None
        drawn = (
            p.tobytes(),
            self.bones.value,
            self.mesh.value,
            splats is not None,
            avatar,
        )
        if drawn == self._drawn:
            return
        self._drawn = drawn
        for node in self._nodes:
            node.remove()
        self._nodes = []
        if self.bones.value:
            bones = p[np.array(avatar.template.edges)]
            lines = scene.add_line_segments(
                "/skeleton", bones, colors=YELLOW, line_width=3.0
            )
            self._nodes.append(lines)
        if self.mesh.value and body is not None and pose is not None:
            vertices = body.posed_vertices(pose.to("cpu"))[0]
            arrays = (vertices.numpy(), body.faces.numpy())
            mesh = scene.add_mesh_simple("/body", *arrays, color=GREY, opacity=0.5)
            self._nodes.append(mesh)
        if splats is not None:
            assert splats.covariances is not None
            given = (
                *(splats.means[0], splats.covariances[0]),
                *(splats.features[0, :, :3].clamp(0, 1), splats.opacities[0, :, None]),
            )
            colours = (x.cpu().numpy() for x in given)
            self._nodes.append(scene.add_gaussian_splats("/gaussians", *colours))
        if self.pose is None:
            for name, gizmo in self._gizmos.items():
                gizmo.position = position(p, name)


def layers(avatar: Avatar) -> tuple[str, ...]:
    """The layers of an avatar."""
    names = [IMAGE, ALPHA]
    if avatar.splats is not None:
        names.append(COLOUR)
    if avatar.segmentation is not None:
        names.append(PARTS)
    return tuple(names)


def shown(layer: str, rendering: Rendering, behind: torch.Tensor) -> Bytes:
    """``[H, W, 3]`` one layer of a rendering.

    Args:
        layer: of `layers`.
        rendering: with maps, unless the layer is the image.
        behind: ``[3, H, W]`` the background.
    """
    assert rendering.image is not None and rendering.alpha is not None  # noqa: PT018
    image = rendering.image[0].cpu()
    alpha = rendering.alpha[0].cpu()
    if layer == ALPHA:
        grey = (alpha[0].clamp(0, 1) * 255).byte().numpy()
        return np.repeat(grey[..., None], 3, axis=2)
    if layer == PARTS and rendering.segmentation is not None:
        colours = colour_labels(rendering.segmentation.argmax(dim=1))[0]
        return np.asarray((colours.permute(1, 2, 0) * 255).byte().cpu().numpy())
    if (
        layer == COLOUR
        and rendering.features is not None
        and rendering.splat_alpha is not None
    ):
        return eight_bits(
            rendering.features[0, :3].cpu(), rendering.splat_alpha[0].cpu(), behind
        )
    return eight_bits(image, alpha, behind)


def _message(error: Exception) -> str:
    """The error for the page; one that is not gsgan's own is named."""
    expected = isinstance(error, (GsganError, ValueError))
    return str(error) if expected else f"{type(error).__name__}: {error}"
