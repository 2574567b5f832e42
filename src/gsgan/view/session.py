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
from PIL import Image
from scipy.spatial.transform import Rotation

from gsgan.body import SkinnedBody
from gsgan.metrics.segmentation import colour_labels
from gsgan.model.avatar import Avatar
from gsgan.model.rendering import Rendering
from gsgan.run.drive import Drive, inputs_of, joints_of
from gsgan.scene import BodyPose, Camera, Gaussians
from gsgan.utils.arrays import Bytes, Float
from gsgan.utils.errors import GsganError
from gsgan.utils.images import eight_bits
from gsgan.utils.provenance import png_bytes
from gsgan.view.drag import HANDLE_NAMES, drag, position

IDLE_SECONDS = 0.1  # between two checks whether an image is due
# seconds without movement after which the full-size image is rendered
RESTS = 0.3
MIN_SCALE = 0.25  # of the images while something moves
MAX_ASPECT = 3.0  # of width to height or of height to width, since a browser window can have any
SPEED_OVER = 2.0  # seconds over which the displayed rate is averaged
YELLOW = (255, 200, 0)
GREY = (160, 165, 175)
# layers
FINAL_IMAGE = "image"
COLOUR = "Step I's colour"
SEGMENTATION_LAYER = "segmentation S"
ALPHA = "alpha"


@dataclass
class Show:
    """The settings that all sessions share."""

    avatar: Avatar  # frozen
    body: SkinnedBody | None  # that the avatar moves with
    drive: Drive  # the first motion
    read: Callable[[str], Drive]  # reads the motion in an uploaded file
    # background [3, H, W] of a size
    behind: Callable[[tuple[int, int]], torch.Tensor]
    size: int  # height of a full-size image, pixels
    fps: float  # frames per second of a motion that plays
    rate: float  # images per second to reach while something moves


class Session:
    """One client of the server; only the rendering thread calls `step`."""

    def __init__(
        self, client: Any, show: Show, wake: Callable[[], None]
    ) -> None:
        self.client = client
        self.show = show
        self._wake = wake

        # The pose: a frame of a motion, or one that was dragged.
        self.drive = show.drive
        self.frame = 0
        self.pose: Float | None = None

        # The current image, and when something changed or moved.
        self.changed = time.monotonic()
        self.moved = self.changed
        self.started = 0.0  # when rendering of the current image began
        self.full = False  # whether the current image is of full size
        self.saving = False  # whether the next image is saved
        self.seconds = 0.0  # to render a full-size image
        self.times: deque[float] = deque(maxlen=200)  # of the last images
        self.image: Bytes | None = None
        self._problem = ""  # that the page shows

        # The 3D nodes of the page, and the state that they were drawn from.
        self._drawn: tuple[Any, ...] = ()
        self._nodes: list[Any] = []
        self._gizmos: dict[str, Any] = {}
        self._controls()

    # -- the page

    def _controls(self) -> None:
        """Adds the controls of the page, and what they do."""
        # Numbers, and the layer that is shown.
        gui = self.client.gui
        self.status = gui.add_text("images per second", "", disabled=True)
        avatar = self.show.avatar
        self.far = gui.add_text(
            "deviations from training",
            "",
            disabled=True,
            visible=avatar.poses is not None,
        )
        self.layer = gui.add_dropdown(
            "layer",
            layers(avatar),
            initial_value=FINAL_IMAGE,
        )

        # The motion and its frame.
        with gui.add_folder("motion"):
            last = max(1, len(self.drive.p) - 1)
            self.slider = gui.add_slider("frame", 0, last, 1, 0)
            self.play = gui.add_checkbox("play", False)
            upload = gui.add_upload_button("load a motion file")
            self.description = gui.add_markdown(self.drive.text)

        # What is drawn in 3D.
        with gui.add_folder("3D"):
            self.handles = gui.add_checkbox("drag joints", False)
            reset = gui.add_button("undo dragging")
            self.bones = gui.add_checkbox("skeleton", False)
            has_body = self.show.body is not None
            self.mesh = gui.add_checkbox("body", False, visible=has_body)
            self.splats = gui.add_checkbox("Gaussians", False)
        save = gui.add_button("save the image")

        # Callbacks run in threads of viser.
        for control in (self.layer, self.bones, self.mesh, self.splats):
            control.on_update(lambda _: self.touch(moving=False))
        self.play.on_update(lambda _: self._on_play())
        self.handles.on_update(lambda _: self._show_handles())
        self.slider.on_update(self._on_scrub)
        upload.on_upload(lambda event: self._load(event.target.value))
        reset.on_click(lambda _: self._scrub(self.frame))
        save.on_click(lambda _: self._on_save())
        self.client.camera.on_update(lambda _: self.touch())

    def touch(self, moving: bool = True) -> None:
        """Requests a new image: a fast one while something moves, else one of full size."""
        self.changed = time.monotonic()
        if moving:
            self.moved = self.changed
        self._wake()

    def _on_play(self) -> None:
        # The time since the last image is no part of the motion.
        self.started = 0.0
        self.touch(moving=False)

    def _on_scrub(self, event: Any) -> None:
        # The slider was moved by the user, not by `step`.
        if event.client_id is not None:
            self._scrub(int(self.slider.value))

    def _scrub(self, frame: int) -> None:
        self.frame = min(frame, len(self.drive.p) - 1)
        self.pose = None
        self.touch()

    def _load(self, file: Any) -> None:
        """Loads an uploaded motion; an error is shown on the page."""
        # Whatever the file is, the server must keep running.
        try:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / Path(file.name).name
                path.write_bytes(file.content)
                drive = self.show.read(str(path))
        except Exception as error:
            text = _message(error).replace(folder + "/", "")
            title = "This motion cannot be used"
            self.client.add_notification(title, text, color="red")
            return

        # The new motion is shown from its first frame.
        self.drive = drive
        self.description.content = drive.text
        self.slider.max = max(1, len(drive.p) - 1)
        self.slider.value = 0
        self._scrub(0)

    def _on_save(self) -> None:
        # What is saved is of full size, also while the motion plays.
        self.saving = True
        self.touch(moving=False)

    def _save(self, image: Bytes) -> None:
        self.saving = False
        name = f"gsgan_{self.frame:06d}.png"
        content = png_bytes(Image.fromarray(image))
        self.client.send_file_download(name, content, save_immediately=True)

    # -- dragging

    def _show_handles(self) -> None:
        """Adds a handle per joint that can be dragged, or removes them."""
        old = self._gizmos
        self._gizmos = {}
        for gizmo in old.values():
            gizmo.remove()

        # All handles are set at once: the rendering thread iterates over them.
        if self.handles.value:
            gizmos = {}
            for name in HANDLE_NAMES:
                gizmo = self.client.scene.add_transform_controls(
                    f"/drag/{name}",
                    scale=0.12,
                    disable_rotations=True,
                    depth_test=False,
                    position=position(self.joints(), name),
                )
                gizmo.on_update(
                    lambda event, name=name: self.drag(
                        name, event.target.position
                    )
                )
                gizmos[name] = gizmo
            self._gizmos = gizmos
        self.touch(moving=False)

    def drag(self, name: str, target: Any) -> None:
        """Moves a joint to ``target`` ``[3]``, metres."""
        # The other handles follow, but for the one that the user holds.
        self.pose = drag(self.joints(), name, np.asarray(target, np.float64))
        self.play.value = False
        for other, gizmo in self._gizmos.items():
            if other != name:
                gizmo.position = position(self.pose, other)
        self.touch()

    def joints(self) -> Float:
        """The current pose ``[J, 3]``, metres, finite; J is the number of the motion's joints."""
        if self.pose is not None:
            return self.pose
        current = self._current()
        p, _ = joints_of(self.show.avatar, current, 0)
        return np.asarray(p[0, : current.p.shape[1]].cpu().numpy(), np.float64)

    def _current(self) -> Drive:
        """The current pose, as a motion of one frame."""
        # Another thread may load a shorter motion.
        drive = self.drive
        pose = self.pose
        drive = drive.rows(np.array([self.frame % len(drive.p)]))
        if pose is None:
            return drive
        visibility = drive.visibility[:, : len(pose)]
        return replace(drive, p=pose[None], visibility=visibility, body=None)

    # -- rendering

    def step(self) -> float:
        """Renders an image if one is due; returns the seconds until the next one may be."""
        # A motion that plays goes on by the frames that have passed since the last image.
        now = time.monotonic()
        if self.play.value and len(self.drive.p) > 1:
            # A frame that is due later is waited for; late frames are skipped.
            early = self.started + 1 / self.show.fps - now
            if early > 0:
                return early
            passed = 1
            if self.started:
                passed = max(1, round((now - self.started) * self.show.fps))
            self.frame = (self.frame + passed) % len(self.drive.p)
            self.pose = None
            self.slider.value = self.frame
            self.changed = now
            self.moved = now

        # Nothing changed since the last image, which is of full size or will be at rest.
        moving = now - self.moved < RESTS
        if self.started > self.changed and (self.full or moving):
            return self.moved + RESTS - now if moving else IDLE_SECONDS

        # The time of an image is proportional to its area.
        share = 1.0
        if moving and self.seconds and not self.saving:
            fast_enough = (1 / self.show.rate / self.seconds) ** 0.5
            share = min(1.0, max(MIN_SCALE, fast_enough))
        self.started = now
        self.full = False

        # Whatever the pose is, the thread must render for all browsers. A problem is shown once,
        # not for every image.
        try:
            self._render(share)
        except Exception as error:
            text = _message(error)
            if self._problem != text:
                self._problem = text
                title = "This pose cannot be rendered"
                self.client.add_notification(title, text, color="red")
            self.play.value = False
            self.full = True
            return IDLE_SECONDS
        self._problem = ""
        self.full = share == 1
        if self.saving and self.full and self.image is not None:
            self._save(self.image)

        # A running mean of the time of a full-size image.
        took = time.monotonic() - now
        whole = took / share**2
        self.seconds = (
            0.7 * self.seconds + 0.3 * whole if self.seconds else whole
        )
        return 0.0

    def camera(self, share: float) -> Camera:
        """The browser's camera, its image ``share`` times the full height."""
        view = self.client.camera
        height = max(16, round(self.show.size * share))
        aspect = min(MAX_ASPECT, max(1 / MAX_ASPECT, view.aspect))
        width = max(16, round(height * aspect))

        # viser's field of view is that of the height; its rotation is from camera to world.
        focal = height / 2 / np.tan(view.fov / 2)
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        w, x, y, z = view.wxyz
        R = Rotation.from_quat([x, y, z, w]).as_matrix().T
        t = -R @ view.position
        return Camera(
            K=torch.tensor(K, dtype=torch.float32)[None],
            R=torch.tensor(R, dtype=torch.float32)[None],
            t=torch.tensor(t, dtype=torch.float32)[None],
            size=(height, width),
        )

    def _render(self, share: float) -> None:
        """Renders an image and shows it on the page, with its numbers and 3D nodes."""
        avatar = self.show.avatar
        layer = self.layer.value
        current = self._current()
        camera = self.camera(share)
        p, visibility, body = inputs_of(avatar, current, 0)

        # Maps are computed only if a layer shows them.
        maps = layer != FINAL_IMAGE or self.splats.value
        with torch.no_grad():
            rendering = avatar(p, visibility, camera, body, maps=maps)
        if avatar.poses is not None:
            self.far.value = f"{float(avatar.poses.distance(p)):.1f}"

        # The image, or the background if the browser draws the Gaussians.
        behind = self.show.behind(camera.size)
        self.image = show_layer(layer, rendering, behind)
        drawn = self.image
        if self.splats.value and rendering.gaussians is not None:
            drawn = eight_bits(behind, torch.ones(1), behind)
        self.client.scene.set_background_image(drawn, "jpeg", jpeg_quality=90)
        joints = np.asarray(p[0].cpu().numpy(), np.float64)
        self._place(rendering.gaussians, joints, body)

        # The size of the image, and the rate over the last seconds.
        now = time.monotonic()
        self.times.append(now)

        # The rate over the last moments, not since the start.
        recent = [x for x in self.times if x > now - SPEED_OVER]
        height, width = self.image.shape[:2]
        status = f"{width} × {height}"
        if len(recent) > 1:
            rate = (len(recent) - 1) / max(now - recent[0], 1e-6)
            status = f"{rate:.1f} at {status}"
        self.status.value = status

    def _place(
        self, splats: Gaussians | None, p: Float, pose: BodyPose | None
    ) -> None:
        """Draws skeleton, body and Gaussians, and moves the handles that are not being dragged."""
        scene = self.client.scene
        avatar = self.show.avatar
        body = self.show.body
        if not self.splats.value:
            splats = None

        # Nodes are sent again only if they have changed.
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

        # The nodes are replaced, not moved.
        for node in self._nodes:
            node.remove()
        self._nodes = []
        if self.bones.value:
            lines = scene.add_line_segments(
                "/skeleton",
                p[np.array(avatar.template.edges)],
                colors=YELLOW,
                line_width=3.0,
            )
            self._nodes.append(lines)

        # The body is posed on the CPU: the browser needs its vertices.
        if self.mesh.value and body is not None and pose is not None:
            vertices = body.posed_vertices(pose.to("cpu"))[0]
            mesh = scene.add_mesh_simple(
                "/body",
                vertices.numpy(),
                body.faces.numpy(),
                color=GREY,
                opacity=0.5,
            )
            self._nodes.append(mesh)
        if splats is not None:
            assert splats.covariances is not None
            cloud = scene.add_gaussian_splats(
                "/gaussians",
                centers=splats.means[0].cpu().numpy(),
                covariances=splats.covariances[0].cpu().numpy(),
                rgbs=splats.features[0, :, :3].clamp(0, 1).cpu().numpy(),
                opacities=splats.opacities[0, :, None].cpu().numpy(),
            )
            self._nodes.append(cloud)

        # Handles of a dragged pose were moved by `drag`.
        if self.pose is None:
            for name, gizmo in self._gizmos.items():
                gizmo.position = position(p, name)


def layers(avatar: Avatar) -> tuple[str, ...]:
    """The layers of an avatar."""
    names = [FINAL_IMAGE, ALPHA]
    if avatar.splats is not None:
        names.append(COLOUR)
    if avatar.segmentation is not None:
        names.append(SEGMENTATION_LAYER)
    return tuple(names)


def show_layer(layer: str, rendering: Rendering, behind: torch.Tensor) -> Bytes:
    """One layer of a rendering as an image ``[H, W, 3]``.

    Args:
        layer: of `layers`.
        rendering: with maps, unless the layer is the image.
        behind: ``[3, H, W]`` the background.
    """
    assert rendering.image is not None and rendering.alpha is not None  # noqa: PT018
    alpha = rendering.alpha[0].cpu()

    # Alpha and labels are opaque.
    if layer == ALPHA:
        grey = (alpha[0].clamp(0, 1) * 255).byte().numpy()
        return np.repeat(grey[..., None], 3, axis=2)
    if layer == SEGMENTATION_LAYER and rendering.segmentation is not None:
        colours = colour_labels(rendering.segmentation.argmax(dim=1))[0]
        return (colours.permute(1, 2, 0) * 255).byte().cpu().numpy()

    # Colours are shown on the background.
    features = rendering.features
    splat_alpha = rendering.splat_alpha
    if layer == COLOUR and features is not None and splat_alpha is not None:
        return eight_bits(features[0, :3].cpu(), splat_alpha[0].cpu(), behind)
    return eight_bits(rendering.image[0].cpu(), alpha, behind)


def _message(error: Exception) -> str:
    """The error for the page; one that is not gsgan's own is named."""
    expected = isinstance(error, (GsganError, ValueError))
    return str(error) if expected else f"{type(error).__name__}: {error}"
