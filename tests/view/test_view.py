"""The viewer in a browser: Chromium without a screen, driven by Playwright."""

import contextlib
import socket
import time
from dataclasses import replace
from urllib.request import urlopen

import numpy as np
import pytest
import torch
from commands import refused

from gsgan.utils.errors import ConfigError

viser = pytest.importorskip("viser", reason="the extra view is not installed")
PATIENCE = 60.0  # seconds


@contextlib.contextmanager
def served(compose, run):
    from gsgan.view.server import Viewer, ViewOptions

    given = (
        f"run={run}",
        "port=0",
        "device=cpu",
        "max_upload=1",
        "background=white",
    )
    made = Viewer(ViewOptions.from_config(compose("view", *given)))
    yield made
    made.stop()


@pytest.fixture(scope="module")
def viewer(bare, compose):
    with served(compose, bare) as made:
        yield made


@pytest.fixture
def open_page(viewer, chromium):
    """``open_page()``: a page and its session, once an image is there; no errors may follow."""
    problems, pages = [], []

    def run(viewer=viewer):
        known = set(viewer.sessions)
        page = chromium.new_page(viewport={"width": 800, "height": 500})
        pages.append(page)
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on(
            "console",
            lambda m: problems.append(m.text) if is_problem(m) else None,
        )
        page.goto(
            f"http://127.0.0.1:{viewer.server.get_port()}",
            timeout=1000 * PATIENCE,
        )
        until(lambda: set(viewer.sessions) - known, page)
        session = viewer.sessions[(set(viewer.sessions) - known).pop()]
        until(lambda: session.full, page)
        return page, session

    yield run
    for page in pages:
        page.close()
    assert not problems


def is_problem(message) -> bool:
    # viser's splats are quads of two coordinates, of which three.js looks for the third
    return (
        message.type == "error" and "computeBoundingSphere" not in message.text
    )


def until(holds, page) -> None:
    """Waits, and lets the browser go on."""
    end = time.monotonic() + PATIENCE
    while not holds():
        assert time.monotonic() < end, "timed out"
        page.wait_for_timeout(50)


def on_screen(session, point) -> tuple[float, float]:
    """Where the browser shows a point of the world, pixels."""
    camera = session.camera(1.0).resize((500, 800))
    pixels, _ = camera.project(
        torch.tensor(point, dtype=torch.float32)[None, None]
    )
    return tuple(pixels[0, 0].tolist())


def changed(session, page, action) -> bool:
    """Whether an action changes the image that rests."""
    before, since = session.image.copy(), session.started
    action()
    with contextlib.suppress(AssertionError):
        until(lambda: session.started > since and session.full, page)
    return before.shape != session.image.shape or not np.array_equal(
        before, session.image
    )


def test_the_image_arrives_and_follows_slider_camera_and_joint(open_page):
    page, session = open_page()
    canvas = page.locator("canvas").first
    until(lambda: len(set(canvas.screenshot()[-2000:])) > 10, page)
    assert session.image.min() < 250  # somebody is there

    def scrub():
        box = page.get_by_role("slider").first
        box.focus()
        box.press("ArrowRight")

    assert changed(session, page, scrub)
    assert session.frame == 1

    def orbit():
        page.mouse.move(200, 250)
        page.mouse.down()
        page.mouse.move(320, 260, steps=5)
        page.mouse.up()

    assert changed(session, page, orbit)
    page.get_by_label("drag joints").check()
    until(lambda: "left wrist" in session._gizmos, page)
    wrist = session.joints()[15]
    up = np.asarray(session.client.camera.up_direction)

    def pull():  # at the arrow of the axis that points up
        page.wait_for_timeout(500)
        tip = wrist + 0.08 * up
        page.mouse.move(*on_screen(session, tip))
        page.mouse.down()
        page.mouse.move(*on_screen(session, tip + 0.2 * up), steps=8)
        page.mouse.up()

    assert changed(session, page, pull)
    assert np.linalg.norm(session.joints()[15] - wrist) > 0.05
    page.get_by_text("undo dragging").click()
    until(lambda: session.pose is None, page)


def test_layers_and_3d(open_page):
    page, session = open_page()
    seen = [session.image.tobytes()]
    for layer in session.layer.options[1:]:

        def choose(layer=layer):
            page.get_by_label("layer", exact=True).click()
            page.get_by_role("option", name=layer, exact=True).click()
            until(lambda: session.layer.value == layer, page)

        changed(session, page, choose)
        seen.append(session.image.tobytes())
    assert len(set(seen)) == len(seen) == 3
    page.get_by_label("skeleton").check()
    page.get_by_label("Gaussians").check()
    until(lambda: len(session._nodes) == 2, page)
    assert not session.mesh.visible  # this avatar has no body


def test_the_body_lies_on_the_skeleton(open_page, run, compose):
    with served(compose, run) as viewer:
        page, session = open_page(viewer)
        assert not session.mesh.value
        page.get_by_label("body", exact=True).check()
        until(lambda: session._nodes, page)
        (mesh,) = session._nodes
        pose = session.drive.body[:1]
        vertices = viewer.show.body.posed_vertices(pose)[0]
        np.testing.assert_allclose(mesh.vertices, vertices, atol=1e-5)
        session.drag(
            "left wrist", session.joints()[15] + 0.2
        )  # the pose is now solved
        until(lambda: session._nodes and session._nodes[0] is not mesh, page)
        assert (
            np.abs(session._nodes[0].vertices - vertices.numpy()).max() > 0.05
        )
        page.close()


def test_play_moves_on_and_two_browsers_are_apart(open_page):
    first, one = open_page()
    _, two = open_page()
    frame = two.frame
    first.get_by_label("play").check()
    frames = set()
    until(lambda: frames.add(one.frame) or len(frames) > 1, first)
    assert two.frame == frame
    assert not two.play.value
    one.play.value = False


def upload(page, path) -> None:
    with page.expect_file_chooser() as chosen:
        page.get_by_text("load a motion file").click()
    chosen.value.set_files(path)


def test_a_motion_is_loaded_and_bad_files_are_reported(
    open_page, capture, tmp_path
):
    page, session = open_page()
    bad = tmp_path / "bad.bvh"
    bad.write_text("HIERARCHY\nROOT")
    upload(page, bad)
    page.get_by_text("This motion cannot be used").wait_for()
    assert page.get_by_text("bad.bvh").count()
    large = tmp_path / "large.bvh"
    large.write_bytes(b"x" * (2 << 20))
    upload(page, large)
    page.get_by_text("This file is too large").wait_for()
    upload(page, capture / "landmarks3d.npz")
    until(lambda: "landmarks3d.npz" in session.description.content, page)
    until(lambda: session.full, page)


def test_the_image_is_saved(open_page):
    from io import BytesIO

    from PIL import Image

    page, session = open_page()
    with page.expect_download() as got:
        page.get_by_text("save the image").click()
    content = got.value.path().read_bytes()
    until(lambda: session.full, page)
    saved = np.asarray(Image.open(BytesIO(content)))
    np.testing.assert_array_equal(saved, session.image)
    assert b"trainedAlgorithmicMedia" in content


def test_it_listens_on_this_machine_alone(viewer, compose):
    assert compose("view").host == "127.0.0.1"
    assert viewer.server.get_host() == "127.0.0.1"
    assert viewer.server.request_share_url() is None  # no public address


def test_all_addresses_of_the_machine_are_printed(viewer, monkeypatch):
    port = viewer.server.get_port()
    assert viewer.addresses == [f"http://127.0.0.1:{port}"]
    monkeypatch.setattr(viewer.server, "get_host", lambda: "0.0.0.0")
    monkeypatch.setattr(
        "gsgan.view.server.network_addresses", lambda: ["192.0.2.7"]
    )
    assert viewer.addresses == [
        f"http://192.0.2.7:{port}",
        f"http://localhost:{port}",
    ]


def test_an_origin_that_is_no_address_is_refused(bare, compose):
    from gsgan.view.server import Viewer, ViewOptions

    config = compose("view", f"run={bare}", "origin=name", "motion=rest")
    options = ViewOptions.from_config(config)
    with pytest.raises(ConfigError, match="origin must be"):
        Viewer(options)


def test_an_ipv6_address(bare, compose):
    from gsgan.view.server import Viewer, ViewOptions

    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip("no IPv6 here")
    given = ("host='::1'", "port=0", "motion=rest")
    config = compose("view", f"run={bare}", *given)
    viewer = Viewer(ViewOptions.from_config(config))
    try:
        assert viewer.address == f"http://[::1]:{viewer.server.get_port()}"
        assert urlopen(viewer.address).status == 200
    finally:
        viewer.stop()


def test_another_machines_address_is_refused(bare, inside):
    refused(
        inside("view", f"run={bare}", "host=203.0.113.1", "motion=rest"),
        "host=203.0.113.1",
    )
    refused(
        inside("view", f"run={bare}", "port=70000", "motion=rest"),
        "port must be",
    )
    refused(inside("view"), "run is not set")
    refused(
        inside("view", f"run={bare}", "motion=none.bvh"),
        "none.bvh",
        "does not exist",
    )


def test_a_pose_that_cannot_be_rendered_is_reported(open_page):
    page, session = open_page()
    kept = session.drive
    session.drive = replace(kept, p=np.full_like(kept.p, np.nan))
    session.touch()
    page.get_by_text("This pose cannot be rendered").wait_for()
    session.drive, behind = kept, session.show.behind

    def broken(size):
        raise RuntimeError("out of memory")

    session.show.behind = broken
    session.touch()
    page.get_by_text("RuntimeError: out of memory").wait_for()
    session.show.behind = behind
    assert changed(session, page, lambda: session._scrub(1))
