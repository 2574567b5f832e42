"""The viewer's server: one thread that renders, one session per browser."""

import contextlib
import io
import logging
import re
import socket
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsgan.motion.orbit import Orbit
from gsgan.run.drive import (
    REST,
    Drive,
    MotionOptions,
    distil_run,
    drive_of,
    smooth,
)
from gsgan.run.runs import RunReference
from gsgan.skeleton.proportions import upright
from gsgan.utils.checks import between, integer, positive
from gsgan.utils.config import CommandOptions
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError
from gsgan.utils.images import background
from gsgan.view.guard import guard_server
from gsgan.view.session import IDLE_SECONDS, Session, Show

MEGABYTE = 1 << 20
EVERYWHERE = (
    "0.0.0.0",
    "::",
)  # hosts that stand for all addresses of this machine
ELSEWHERE = (
    "192.0.2.1",
    9,
)  # an address for documentation, and the port that discards
ORIGIN_PATTERN = r"https?://[^/\s]+/?"
MAX_UPLOADS = 8  # of a browser at the same time


@dataclass(frozen=True)
class ViewOptions(CommandOptions):
    """The options of gsgan.view: conf/view.yaml."""

    source: RunReference
    driven: MotionOptions
    fps: float
    smooth: Mapping[str, Any]
    background: str | int
    pixels: int | None
    rate: float
    host: str
    origin: str | None
    port: int
    max_upload: float
    distilled: bool


def view(options: ViewOptions) -> None:
    """Serves until interrupted.

    Raises:
        ConfigError: when an option has an invalid value, or viser is missing.
        DataError: when the run or the motion cannot be read.
    """
    viewer = Viewer(options)
    console = make_console()
    console.print(viewer.show.drive.text, markup=False, highlight=False)
    console.print(
        f"open {' or '.join(viewer.addresses)} in a browser; stop with Ctrl+C",
        highlight=False,
        soft_wrap=True,
    )
    try:
        viewer.serve()
    finally:
        viewer.stop()


class Viewer:
    """A server of one avatar.

    Args:
        options: what it shows, and where.
    """

    def __init__(self, options: ViewOptions) -> None:
        # The avatar.
        viser = import_viser()
        self.run = options.source.load()
        fps = float(positive("fps", options.fps))
        if options.distilled:
            self.run.avatar = distil_run(options.driven, self.run)

        def read(motion: str | list[str]) -> Drive:
            chosen = replace(options.driven, motion=motion)
            drive = drive_of(chosen, self.run, fps)
            return smooth(options.smooth, drive, fps)

        # The settings and the first motion of all browsers.
        first = REST if self.run.is_shared else self.run.data.watched[0]
        drive = read(options.driven.motion or first)
        size = integer(
            "pixels",
            options.pixels or self.run.trained_as.image_size or 512,
            16,
        )
        behind: Any = background(str(options.background), video=True)
        self.show = Show(
            avatar=self.run.avatar,
            body=self.run.body,
            drive=drive,
            read=read,
            behind=behind,
            size=size,
            fps=fps,
            rate=float(positive("rate", options.rate)),
        )

        # The page's address behind a proxy.
        origin = None if options.origin is None else str(options.origin)
        if origin is not None and not re.fullmatch(ORIGIN_PATTERN, origin):
            raise ConfigError(
                f"origin must be the beginning of an address, such as https://name, got {origin!r}"
            )

        # With an address of another machine, viser would never return.
        host = str(options.host)
        port = between("port", integer("port", options.port, 0), 0, 65535)
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            socket.create_server((host, 0), family=family).close()
        except OSError as error:
            raise ConfigError(
                f"host={host} is not an address of this machine ({error})"
            ) from None

        # The server without viser's own banner, and without its share button, which would put the
        # avatar on a public address.
        logging.getLogger("websockets").setLevel(logging.WARNING)
        with (
            contextlib.redirect_stdout(io.StringIO()),
            guard_server(host, origin),
        ):
            self.server = viser.ViserServer(
                host, port, label="gsgan", verbose=False
            )
        self.server.request_share_url = lambda verbose=True: None  # type: ignore[method-assign]
        self.server.gui.configure_theme(
            show_share_button=False, control_width="medium"
        )
        self._camera(size)

        # A session per browser, and one thread that renders for all.
        self._limit = int(positive("max_upload", options.max_upload) * MEGABYTE)
        self.sessions: dict[int, Session] = {}
        self._wake = threading.Event()
        self._ended = False
        self.server.on_client_connect(self._join)
        self.server.on_client_disconnect(self._leave)
        self._renderer = threading.Thread(
            target=self._render,
            daemon=True,
            name="rendering",
        )
        self._renderer.start()

    @property
    def address(self) -> str:
        """The address to open in a browser."""
        host = self.server.get_host()
        if ":" in host:  # IPv6
            host = f"[{host}]"
        return f"http://{host}:{self.server.get_port()}"

    @property
    def addresses(self) -> list[str]:
        """The addresses to open in a browser, of which other machines can open the first."""
        port = self.server.get_port()
        if self.server.get_host() not in EVERYWHERE:
            return [self.address]
        network = [f"http://{name}:{port}" for name in network_addresses()]
        return [*network, f"http://localhost:{port}"]

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
        p = self.show.drive.p
        orbit = Orbit()
        proportions = self.run.proportions
        trained = self.run.trained_as.image_size or size
        camera = orbit.cameras(
            p[:1], proportions, self.run.scene, size, trained
        )

        # The same camera in viser's terms.
        up = upright(proportions.up)[2]
        self.server.scene.set_up_direction(tuple(map(float, up)))
        view = self.server.initial_camera
        view.up = up
        view.position = camera.centre[0].double().numpy()
        view.look_at = np.nanmean(p[0], axis=0)
        view.fov = float(np.radians(orbit.fov))

    def _join(self, client: Any) -> None:
        _bound_uploads(client, self._limit)
        self.sessions[client.client_id] = Session(
            client, self.show, self._wake.set
        )
        self._wake.set()

    def _leave(self, client: Any) -> None:
        self.sessions.pop(client.client_id, None)

    def _render(self) -> None:
        """Renders for each browser in turn, as long as one of them needs a new image."""
        while not self._ended:
            # Browsers come and go while others are served.
            due = IDLE_SECONDS
            for session in list(self.sessions.values()):
                due = min(due, session.step())
            if due > 0:
                self._wake.wait(due)
                self._wake.clear()


def network_addresses() -> list[str]:
    """The address of this machine by which others reach it; empty without a network."""
    # Nothing is sent: the system chooses the interface that leads to other networks.
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(ELSEWHERE)
            return [str(probe.getsockname()[0])]
        except OSError:
            return []


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
    """Drops uploads beyond `MAX_UPLOADS`, or of more than ``limit`` bytes together, whatever size
    the browser declares.

    viser itself collects the parts of an upload without a limit.
    """
    from viser import _messages

    # viser has no public access to uploads.
    uploads: dict[str, Any] = client.gui._current_file_upload_states
    connection = client._websock_connection

    def check(_: int, message: Any) -> None:
        # All uploads of a browser count together.
        held = 0
        for upload in uploads.values():
            held += max(upload["total_bytes"], upload["transferred_bytes"])
        if held <= limit and len(uploads) <= MAX_UPLOADS:
            return
        dropped = uploads.pop(message.transfer_uuid, None)
        if dropped is None:
            return

        # An acknowledgement of all bytes ends the browser's waiting.
        total = dropped["total_bytes"]
        end = _messages.FileTransferPartAck(
            message.source_component_uuid,
            message.transfer_uuid,
            total,
            total,
        )
        connection.queue_message(end)
        text = f"Motion files are limited to {limit // MEGABYTE} MB."
        client.add_notification("This file is too large", text, color="red")

    register: Callable[..., None] = connection.register_handler
    for kind in (_messages.FileTransferStartUpload, _messages.FileTransferPart):
        register(kind, check)
