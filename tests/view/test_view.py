"""The viewer in a browser: Chromium without a screen, driven by Playwright."""
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
import contextlib
from gsgan.utils.errors import ConfigError
import socket
from gsgan.utils.errors import ConfigError
import time
from gsgan.utils.errors import ConfigError
from dataclasses import replace
from gsgan.utils.errors import ConfigError
from urllib.request import urlopen
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
import numpy as np
from gsgan.utils.errors import ConfigError
import pytest
from gsgan.utils.errors import ConfigError
import torch
from gsgan.utils.errors import ConfigError
from commands import refused
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
viser = pytest.importorskip("viser", reason="the extra view is not installed")
from gsgan.utils.errors import ConfigError
PATIENCE = 60.0  # seconds
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
@contextlib.contextmanager
from gsgan.utils.errors import ConfigError
def served(compose, run):
from gsgan.utils.errors import ConfigError
    from gsgan.view.server import Viewer
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
    given = (
from gsgan.utils.errors import ConfigError
        f"run={run}",
from gsgan.utils.errors import ConfigError
        "port=0",
from gsgan.utils.errors import ConfigError
        "device=cpu",
from gsgan.utils.errors import ConfigError
        "max_upload=1",
from gsgan.utils.errors import ConfigError
        "background=white",
from gsgan.utils.errors import ConfigError
    )
from gsgan.utils.errors import ConfigError
    made = Viewer(compose("view", *given))
from gsgan.utils.errors import ConfigError
    yield made
from gsgan.utils.errors import ConfigError
    made.stop()
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
@pytest.fixture(scope="module")
from gsgan.utils.errors import ConfigError
def viewer(bare, compose):
from gsgan.utils.errors import ConfigError
    with served(compose, bare) as made:
from gsgan.utils.errors import ConfigError
        yield made
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
@pytest.fixture
from gsgan.utils.errors import ConfigError
def open_page(viewer, chromium):
from gsgan.utils.errors import ConfigError
    """``open_page()``: a page and its session, once an image is there; no errors may follow."""
from gsgan.utils.errors import ConfigError
    problems, pages = [], []
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
    def run(viewer=viewer):
from gsgan.utils.errors import ConfigError
        known = set(viewer.sessions)
from gsgan.utils.errors import ConfigError
        page = chromium.new_page(viewport={"width": 800, "height": 500})
from gsgan.utils.errors import ConfigError
        pages.append(page)
from gsgan.utils.errors import ConfigError
        page.on("pageerror", lambda error: problems.append(str(error)))
from gsgan.utils.errors import ConfigError
        page.on(
from gsgan.utils.errors import ConfigError
            "console",
from gsgan.utils.errors import ConfigError
            lambda m: problems.append(m.text) if is_problem(m) else None,
from gsgan.utils.errors import ConfigError
        )
from gsgan.utils.errors import ConfigError
        page.goto(
from gsgan.utils.errors import ConfigError
            f"http://127.0.0.1:{viewer.server.get_port()}",
from gsgan.utils.errors import ConfigError
            timeout=1000 * PATIENCE,
from gsgan.utils.errors import ConfigError
        )
from gsgan.utils.errors import ConfigError
        until(lambda: set(viewer.sessions) - known, page)
from gsgan.utils.errors import ConfigError
        session = viewer.sessions[(set(viewer.sessions) - known).pop()]
from gsgan.utils.errors import ConfigError
        until(lambda: session.full, page)
from gsgan.utils.errors import ConfigError
        return page, session
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
    yield run
from gsgan.utils.errors import ConfigError
    for page in pages:
from gsgan.utils.errors import ConfigError
        page.close()
from gsgan.utils.errors import ConfigError
    assert not problems
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
def is_problem(message) -> bool:
from gsgan.utils.errors import ConfigError
    # viser's splats are quads of two coordinates, of which three.js looks for the third
from gsgan.utils.errors import ConfigError
    return (
from gsgan.utils.errors import ConfigError
        message.type == "error" and "computeBoundingSphere" not in message.text
from gsgan.utils.errors import ConfigError
    )
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
def until(holds, page) -> None:
from gsgan.utils.errors import ConfigError
    """Waits, and lets the browser go on."""
from gsgan.utils.errors import ConfigError
    end = time.monotonic() + PATIENCE
from gsgan.utils.errors import ConfigError
    while not holds():
from gsgan.utils.errors import ConfigError
        assert time.monotonic() < end, "timed out"
from gsgan.utils.errors import ConfigError
        page.wait_for_timeout(50)
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
def on_screen(session, point) -> tuple[float, float]:
from gsgan.utils.errors import ConfigError
    """Where the browser shows a point of the world, pixels."""
from gsgan.utils.errors import ConfigError
    camera = session.camera(1.0).resize((500, 800))
from gsgan.utils.errors import ConfigError
    pixels, _ = camera.project(
from gsgan.utils.errors import ConfigError
        torch.tensor(point, dtype=torch.float32)[None, None]
from gsgan.utils.errors import ConfigError
    )
from gsgan.utils.errors import ConfigError
    return tuple(pixels[0, 0].tolist())
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
def changed(session, page, action) -> bool:
from gsgan.utils.errors import ConfigError
    """Whether an action changes the image that rests."""
from gsgan.utils.errors import ConfigError
    before, since = session.image.copy(), session.started
from gsgan.utils.errors import ConfigError
    action()
from gsgan.utils.errors import ConfigError
    with contextlib.suppress(AssertionError):
from gsgan.utils.errors import ConfigError
        until(lambda: session.started > since and session.full, page)
from gsgan.utils.errors import ConfigError
    return before.shape != session.image.shape or not np.array_equal(
from gsgan.utils.errors import ConfigError
        before, session.image
from gsgan.utils.errors import ConfigError
    )
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
def test_the_image_arrives_and_follows_slider_camera_and_joint(open_page):
from gsgan.utils.errors import ConfigError
    page, session = open_page()
from gsgan.utils.errors import ConfigError
    canvas = page.locator("canvas").first
from gsgan.utils.errors import ConfigError
    until(lambda: len(set(canvas.screenshot()[-2000:])) > 10, page)
from gsgan.utils.errors import ConfigError
    assert session.image.min() < 250  # somebody is there
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
    def scrub():
from gsgan.utils.errors import ConfigError
        box = page.get_by_role("slider").first
from gsgan.utils.errors import ConfigError
        box.focus()
from gsgan.utils.errors import ConfigError
        box.press("ArrowRight")
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
    assert changed(session, page, scrub)
from gsgan.utils.errors import ConfigError
    assert session.frame == 1
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
    def orbit():
from gsgan.utils.errors import ConfigError
        page.mouse.move(200, 250)
from gsgan.utils.errors import ConfigError
        page.mouse.down()
from gsgan.utils.errors import ConfigError
        page.mouse.move(320, 260, steps=5)
from gsgan.utils.errors import ConfigError
        page.mouse.up()
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
    assert changed(session, page, orbit)
from gsgan.utils.errors import ConfigError
    page.get_by_label("drag joints").check()
from gsgan.utils.errors import ConfigError
    until(lambda: "left wrist" in session._gizmos, page)
from gsgan.utils.errors import ConfigError
    wrist = session.joints()[15]
from gsgan.utils.errors import ConfigError
    up = np.asarray(session.client.camera.up_direction)
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
    def pull():  # at the arrow of the axis that points up
from gsgan.utils.errors import ConfigError
        page.wait_for_timeout(500)
from gsgan.utils.errors import ConfigError
        tip = wrist + 0.08 * up
from gsgan.utils.errors import ConfigError
        page.mouse.move(*on_screen(session, tip))
from gsgan.utils.errors import ConfigError
        page.mouse.down()
from gsgan.utils.errors import ConfigError
        page.mouse.move(*on_screen(session, tip + 0.2 * up), steps=8)
from gsgan.utils.errors import ConfigError
        page.mouse.up()
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
    assert changed(session, page, pull)
from gsgan.utils.errors import ConfigError
    assert np.linalg.norm(session.joints()[15] - wrist) > 0.05
from gsgan.utils.errors import ConfigError
    page.get_by_text("undo dragging").click()
from gsgan.utils.errors import ConfigError
    until(lambda: session.pose is None, page)
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
def test_layers_and_3d(open_page):
from gsgan.utils.errors import ConfigError
    page, session = open_page()
from gsgan.utils.errors import ConfigError
    seen = [session.image.tobytes()]
from gsgan.utils.errors import ConfigError
    for layer in session.layer.options[1:]:
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
        def choose(layer=layer):
from gsgan.utils.errors import ConfigError
            page.get_by_label("layer", exact=True).click()
from gsgan.utils.errors import ConfigError
            page.get_by_role("option", name=layer, exact=True).click()
from gsgan.utils.errors import ConfigError
            until(lambda: session.layer.value == layer, page)
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
        changed(session, page, choose)
from gsgan.utils.errors import ConfigError
        seen.append(session.image.tobytes())
from gsgan.utils.errors import ConfigError
    assert len(set(seen)) == len(seen) == 3
from gsgan.utils.errors import ConfigError
    page.get_by_label("skeleton").check()
from gsgan.utils.errors import ConfigError
    page.get_by_label("Gaussians").check()
from gsgan.utils.errors import ConfigError
    until(lambda: len(session._nodes) == 2, page)
from gsgan.utils.errors import ConfigError
    assert not session.mesh.visible  # this avatar has no body
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
def test_the_body_lies_on_the_skeleton(open_page, run, compose):
from gsgan.utils.errors import ConfigError
    with served(compose, run) as viewer:
from gsgan.utils.errors import ConfigError
        page, session = open_page(viewer)
from gsgan.utils.errors import ConfigError
        assert not session.mesh.value
from gsgan.utils.errors import ConfigError
        page.get_by_label("body", exact=True).check()
from gsgan.utils.errors import ConfigError
        until(lambda: session._nodes, page)
from gsgan.utils.errors import ConfigError
        (mesh,) = session._nodes
from gsgan.utils.errors import ConfigError
        pose = session.drive.body[:1]
from gsgan.utils.errors import ConfigError
        vertices = viewer.show.body.posed_vertices(pose)[0]
from gsgan.utils.errors import ConfigError
        np.testing.assert_allclose(mesh.vertices, vertices, atol=1e-5)
from gsgan.utils.errors import ConfigError
        session.drag(
from gsgan.utils.errors import ConfigError
            "left wrist", session.joints()[15] + 0.2
from gsgan.utils.errors import ConfigError
        )  # the pose is now solved
from gsgan.utils.errors import ConfigError
        until(lambda: session._nodes and session._nodes[0] is not mesh, page)
from gsgan.utils.errors import ConfigError
        assert (
from gsgan.utils.errors import ConfigError
            np.abs(session._nodes[0].vertices - vertices.numpy()).max() > 0.05
from gsgan.utils.errors import ConfigError
        )
from gsgan.utils.errors import ConfigError
        page.close()
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
def test_play_moves_on_and_two_browsers_are_apart(open_page):
from gsgan.utils.errors import ConfigError
    first, one = open_page()
from gsgan.utils.errors import ConfigError
    _, two = open_page()
from gsgan.utils.errors import ConfigError
    frame = two.frame
from gsgan.utils.errors import ConfigError
    first.get_by_label("play").check()
from gsgan.utils.errors import ConfigError
    frames = set()
from gsgan.utils.errors import ConfigError
    until(lambda: frames.add(one.frame) or len(frames) > 1, first)
from gsgan.utils.errors import ConfigError
    assert two.frame == frame
from gsgan.utils.errors import ConfigError
    assert not two.play.value
from gsgan.utils.errors import ConfigError
    one.play.value = False
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
def upload(page, path) -> None:
from gsgan.utils.errors import ConfigError
    with page.expect_file_chooser() as chosen:
from gsgan.utils.errors import ConfigError
        page.get_by_text("load a motion file").click()
from gsgan.utils.errors import ConfigError
    chosen.value.set_files(path)
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
def test_a_motion_is_loaded_and_bad_files_are_reported(
from gsgan.utils.errors import ConfigError
    open_page, capture, tmp_path
from gsgan.utils.errors import ConfigError
):
from gsgan.utils.errors import ConfigError
    page, session = open_page()
from gsgan.utils.errors import ConfigError
    bad = tmp_path / "bad.bvh"
from gsgan.utils.errors import ConfigError
    bad.write_text("HIERARCHY\nROOT")
from gsgan.utils.errors import ConfigError
    upload(page, bad)
from gsgan.utils.errors import ConfigError
    page.get_by_text("This motion cannot be used").wait_for()
from gsgan.utils.errors import ConfigError
    assert page.get_by_text("bad.bvh").count()
from gsgan.utils.errors import ConfigError
    large = tmp_path / "large.bvh"
from gsgan.utils.errors import ConfigError
    large.write_bytes(b"x" * (2 << 20))
from gsgan.utils.errors import ConfigError
    upload(page, large)
from gsgan.utils.errors import ConfigError
    page.get_by_text("This file is too large").wait_for()
from gsgan.utils.errors import ConfigError
    upload(page, capture / "landmarks3d.npz")
from gsgan.utils.errors import ConfigError
    until(lambda: "landmarks3d.npz" in session.description.content, page)
from gsgan.utils.errors import ConfigError
    until(lambda: session.full, page)
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
def test_the_image_is_saved(open_page):
from gsgan.utils.errors import ConfigError
    from io import BytesIO
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
    from PIL import Image
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
    page, session = open_page()
from gsgan.utils.errors import ConfigError
    with page.expect_download() as got:
from gsgan.utils.errors import ConfigError
        page.get_by_text("save the image").click()
from gsgan.utils.errors import ConfigError
    content = got.value.path().read_bytes()
from gsgan.utils.errors import ConfigError
    np.testing.assert_array_equal(
from gsgan.utils.errors import ConfigError
        np.asarray(Image.open(BytesIO(content))), session.image
from gsgan.utils.errors import ConfigError
    )
from gsgan.utils.errors import ConfigError
    assert b"trainedAlgorithmicMedia" in content
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
def test_it_listens_on_this_machine_alone(viewer, compose):
from gsgan.utils.errors import ConfigError
    assert compose("view").host == "127.0.0.1"
from gsgan.utils.errors import ConfigError
    assert viewer.server.get_host() == "127.0.0.1"
from gsgan.utils.errors import ConfigError
    assert viewer.server.request_share_url() is None  # no public address
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
def test_all_addresses_of_the_machine_are_printed(viewer, monkeypatch):
from gsgan.utils.errors import ConfigError
    port = viewer.server.get_port()
from gsgan.utils.errors import ConfigError
    assert viewer.addresses == [f"http://127.0.0.1:{port}"]
from gsgan.utils.errors import ConfigError
    monkeypatch.setattr(viewer.server, "get_host", lambda: "0.0.0.0")
from gsgan.utils.errors import ConfigError
    monkeypatch.setattr(
from gsgan.utils.errors import ConfigError
        "gsgan.view.server.network_addresses", lambda: ["192.0.2.7"]
from gsgan.utils.errors import ConfigError
    )
from gsgan.utils.errors import ConfigError
    assert viewer.addresses == [
from gsgan.utils.errors import ConfigError
        f"http://192.0.2.7:{port}",
from gsgan.utils.errors import ConfigError
        f"http://localhost:{port}",
from gsgan.utils.errors import ConfigError
    ]
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
def test_an_origin_that_is_no_address_is_refused(bare, compose):
from gsgan.utils.errors import ConfigError
    from gsgan.view.server import Viewer
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
    with pytest.raises(ConfigError, match="origin must be"):
from gsgan.utils.errors import ConfigError
        Viewer(compose("view", f"run={bare}", "origin=name", "motion=rest"))
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
def test_an_ipv6_address(bare, compose):
from gsgan.utils.errors import ConfigError
    from gsgan.view.server import Viewer
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
    try:
from gsgan.utils.errors import ConfigError
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
from gsgan.utils.errors import ConfigError
    except OSError:
from gsgan.utils.errors import ConfigError
        pytest.skip("no IPv6 here")
from gsgan.utils.errors import ConfigError
    viewer = Viewer(
from gsgan.utils.errors import ConfigError
        compose("view", f"run={bare}", "host='::1'", "port=0", "motion=rest")
from gsgan.utils.errors import ConfigError
    )
from gsgan.utils.errors import ConfigError
    try:
from gsgan.utils.errors import ConfigError
        assert viewer.address == f"http://[::1]:{viewer.server.get_port()}"
from gsgan.utils.errors import ConfigError
        assert urlopen(viewer.address).status == 200
from gsgan.utils.errors import ConfigError
    finally:
from gsgan.utils.errors import ConfigError
        viewer.stop()
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
def test_another_machines_address_is_refused(bare, inside):
from gsgan.utils.errors import ConfigError
    refused(
from gsgan.utils.errors import ConfigError
        inside("view", f"run={bare}", "host=203.0.113.1", "motion=rest"),
from gsgan.utils.errors import ConfigError
        "host=203.0.113.1",
from gsgan.utils.errors import ConfigError
    )
from gsgan.utils.errors import ConfigError
    refused(
from gsgan.utils.errors import ConfigError
        inside("view", f"run={bare}", "port=70000", "motion=rest"),
from gsgan.utils.errors import ConfigError
        "port must be",
from gsgan.utils.errors import ConfigError
    )
from gsgan.utils.errors import ConfigError
    refused(inside("view"), "run is not set")
from gsgan.utils.errors import ConfigError
    refused(
from gsgan.utils.errors import ConfigError
        inside("view", f"run={bare}", "motion=none.bvh"),
from gsgan.utils.errors import ConfigError
        "none.bvh",
from gsgan.utils.errors import ConfigError
        "does not exist",
from gsgan.utils.errors import ConfigError
    )
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
def test_a_pose_that_cannot_be_rendered_is_reported(open_page):
from gsgan.utils.errors import ConfigError
    page, session = open_page()
from gsgan.utils.errors import ConfigError
    kept = session.drive
from gsgan.utils.errors import ConfigError
    session.drive = replace(kept, p=np.full_like(kept.p, np.nan))
from gsgan.utils.errors import ConfigError
    session.touch()
from gsgan.utils.errors import ConfigError
    page.get_by_text("This pose cannot be rendered").wait_for()
from gsgan.utils.errors import ConfigError
    session.drive, behind = kept, session.show.behind
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
    def broken(size):
from gsgan.utils.errors import ConfigError
        raise RuntimeError("out of memory")
from gsgan.utils.errors import ConfigError

from gsgan.utils.errors import ConfigError
    session.show.behind = broken
from gsgan.utils.errors import ConfigError
    session.touch()
from gsgan.utils.errors import ConfigError
    page.get_by_text("RuntimeError: out of memory").wait_for()
from gsgan.utils.errors import ConfigError
    session.show.behind = behind
from gsgan.utils.errors import ConfigError
    assert changed(session, page, lambda: session._scrub(1))
from gsgan.utils.errors import ConfigError
