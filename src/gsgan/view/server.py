"""The viewer's server: one thread that renders, one session per browser."""

import contextlib
import io
import logging
import socket
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from gsgan.data.proportions import upright
from gsgan.motion.orbit import Orbit
from gsgan.run.drive import Drive, distilled_of, drive_of
from gsgan.run.runs import Run
from gsgan.utils.checks import above, between, whole
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError
from gsgan.utils.images import background
from gsgan.view.guard import guarded
from gsgan.view.session import IDLE, Session, Show

MEGABYTE = 1 << 20
MOST_UPLOADS = 8  # of a browser at the same time


def view_config(config: DictConfig) -> None:
    """Serves until interrupted.

    Raises:
        ConfigError: when an option has an invalid value, or viser is missing.
        DataError: when the run or the motion cannot be read.
    """
    viewer = Viewer(config)
    console = make_console()
    console.print(viewer.show.drive.text, markup=False, highlight=False)
    console.print(
        f"open {viewer.address} in a browser; stop with Ctrl+C", highlight=False
    )
    try:
        viewer.serve()
    finally:
        viewer.stop()


class Viewer:
    """A server of one avatar.

    Args:
        config: the options of conf/view.yaml.
    """

    def __init__(self, config: DictConfig) -> None:
        viser = import_viser()
        self.run = Run.load(config)
        fps = float(above("fps", config.fps))
        if config.distilled:
            self.run.avatar = distilled_of(config, self.run)

        def read(motion: str) -> Drive:
            return drive_of(OmegaConf.merge(config, {"motion": motion}), self.run, fps)  # type: ignore[arg-type]

        drive = read(config.motion or self.run.data.watched[0])
        size = whole("pixels", config.pixels or self.run.stored.data.size or 512, 16)
        behind: Any = background(str(config.background), video=True)
        rate = float(above("rate", config.rate))
        self.show = Show(
            self.run.avatar, self.run.body, drive, read, behind, size, fps, rate
        )
        host = str(config.host)
        port = between("port", whole("port", config.port, 0), 0, 65535)
        try:  # viser itself would never return
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            socket.create_server((host, 0), family=family).close()
        except OSError as error:
            raise ConfigError(
                f"host={host} is not an address of this machine ({error})"
            ) from None
        logging.getLogger("websockets").setLevel(logging.WARNING)
        # without viser's own banner
        with contextlib.redirect_stdout(io.StringIO()), guarded(host):
            self.server = viser.ViserServer(host, port, label="gsgan", verbose=False)
        # viser's share button would put the avatar on a public address
        self.server.request_share_url = lambda verbose=True: None  # type: ignore[method-assign]
        self.server.gui.configure_theme(show_share_button=False, control_width="medium")
        self._camera(size)
        limit = int(above("max_upload", config.max_upload) * MEGABYTE)
        self.sessions: dict[int, Session] = {}
        self._wake = threading.Event()
        self._ended = False
        self.server.on_client_connect(lambda client: self._join(client, limit))
        self.server.on_client_disconnect(
            lambda client: self.sessions.pop(client.client_id, None)
        )
        self._renderer = threading.Thread(
            target=self._render, daemon=True, name="rendering"
        )
        self._renderer.start()

    @property
    def address(self) -> str:
        """What to open in a browser."""
        host = self.server.get_host()
        return f"http://{f'[{host}]' if ':' in host else host}:{self.server.get_port()}"

    def serve(self) -> None:
        """Waits until interrupted."""
        threading.Event().wait()

    def stop(self) -> None:
        """Stops the server and its thread; a second call does nothing."""
        if self._ended:
            return
        self._ended = True
        self._wake.set()
        self._renderer.join()
        self.server.stop()

    def _camera(self, size: int) -> None:
        """Sets the first view of new browsers: the first pose from the front, as large as in
        training images."""
        drive = self.show.drive
        scene = self.run.scene
        proportions = self.run.proportions
        trained = self.run.stored.data.size or size
        camera = Orbit().cameras(drive.p[:1], proportions, scene, size, trained)
        up = upright(proportions.up)[2]
        self.server.scene.set_up_direction(tuple(map(float, up)))
        self.server.initial_camera.up = up
        self.server.initial_camera.position = camera.centre[0].double().numpy()
        self.server.initial_camera.look_at = np.nanmean(drive.p[0], axis=0)
        self.server.initial_camera.fov = float(np.radians(Orbit().fov))

    def _join(self, client: Any, limit: int) -> None:
        _bound_uploads(client, limit)
        self.sessions[client.client_id] = Session(client, self.show, self._wake.set)
        self._wake.set()

    def _render(self) -> None:
        """Renders for each browser in turn, as long as one of them needs a new image."""
        while not self._ended:
            due = min((s.step() for s in list(self.sessions.values())), default=IDLE)
            if due > 0:
                self._wake.wait(min(due, IDLE))
                self._wake.clear()


def import_viser() -> Any:
    """The package viser.

    Raises:
        ConfigError: when it is not installed.
    """
    try:
        import viser
    except ImportError:
        raise ConfigError(
            "the viewer needs the package viser: pip install 'gsgan[view]'"
        ) from None
    return viser


def _bound_uploads(client: Any, limit: int) -> None:
    """Drops uploads beyond `MOST_UPLOADS`, or of more than ``limit`` bytes together, whatever size
    the browser declares.

    viser itself collects the parts of an upload without a limit.
    """
    from viser import _messages

    uploads: dict[str, Any] = client.gui._current_file_upload_states
    connection = client._websock_connection

    def check(_: int, message: Any) -> None:
        state = uploads.get(message.transfer_uuid)
        held = (max(s["total_bytes"], s["transferred_bytes"]) for s in uploads.values())
        if state and (sum(held) > limit or len(uploads) > MOST_UPLOADS):
            uploads.pop(message.transfer_uuid)
            total = state["total_bytes"]  # the browser stops waiting
            ends = message.source_component_uuid, message.transfer_uuid, total, total
            connection.queue_message(_messages.FileTransferPartAck(*ends))
            text = f"Motion files are limited to {limit // MEGABYTE} MB."
            client.add_notification("This file is too large", text, color="red")

    register: Callable[..., None] = connection.register_handler
    for kind in (_messages.FileTransferStartUpload, _messages.FileTransferPart):
        register(kind, check)
