"""A session without a browser, from bare skeletons, on the device that GPU_CHECK_DEVICE names."""

import os
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import torch
from configs import load_run

from gsgan.run.drive import MotionOptions, drive_of
from gsgan.view.session import Session, Show, layers

DEVICE = os.environ.get("GPU_CHECK_DEVICE", "cpu")


class Control(SimpleNamespace):
    """A control of a page that nobody touches; also a folder of controls and a 3D node."""

    def __getattr__(self, name):
        return lambda *_, **__: None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return None


class Page:
    """Everything that is added to a page, in order of arrival."""

    def __init__(self):
        self.added = []

    def __getattr__(self, name):
        def add(*given, initial_value=None, **_):
            value = False if name == "add_checkbox" else initial_value
            numbers = [x for x in given[1:] if isinstance(x, int)]
            self.added.append((name, given))
            options = given[1] if name == "add_dropdown" else ()
            return Control(
                value=numbers[-1] if numbers else value,
                options=options,
                content="",
            )

        return add


def test_every_layer_is_rendered_from_a_bare_skeleton(run, compose):
    config = compose(
        "view", f"run={run}", f"device={DEVICE}", "motion=novel_pose"
    )
    loaded = load_run(config)
    assert next(loaded.avatar.parameters()).device.type == DEVICE
    drive = replace(
        drive_of(MotionOptions.from_config(config), loaded, 30.0), body=None
    )  # the body is solved
    show = Show(
        loaded.avatar,
        loaded.body,
        drive,
        lambda motion: drive,
        lambda size: torch.zeros(3, *size),
        32,
        30.0,
        10.0,
    )
    view = drive.camera[0]
    camera = SimpleNamespace(
        wxyz=np.array([0.0, 1.0, 0.0, 0.0]), position=view.centre[0].numpy(), fov=0.8, aspect=1.0,
        on_update=lambda _: None,
    )  # fmt: skip
    client = SimpleNamespace(
        gui=Page(),
        scene=Page(),
        camera=camera,
        add_notification=lambda *given, **_: given,
    )
    session = Session(client, show, lambda: None)
    session.camera = lambda share: view[:1]
    images = []
    session.bones.value = session.mesh.value = True
    for layer in session.layer.options:
        session.layer.value = layer
        session.splats.value = layer == session.layer.options[-1]
        session.touch(moving=False)
        session.step()
        images.append(session.image.tobytes())
    print(
        [
            a
            for a in range(len(images))
            for b in range(a)
            if images[a] == images[b]
        ],
        session.layer.options,
    )
    # a layer that cannot be rendered leaves the image of the one before
    assert len(set(images)) == len(images) == len(layers(loaded.avatar))
    drawn = {name for name, _ in client.scene.added}
    assert {
        "add_line_segments",
        "add_mesh_simple",
        "add_gaussian_splats",
    } <= drawn
