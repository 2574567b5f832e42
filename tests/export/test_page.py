"""The web page in a browser: Chromium without a screen, driven by Playwright."""

import base64
import functools
import hashlib
import http.server
import io
import json
import shutil
import subprocess
import threading
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import refused
from PIL import Image

from gsgan.export.page import WEB, block, page, quantise
from gsgan.run.drive import Drive
from gsgan.run.runs import Run
from gsgan.scene import Camera
from gsgan.utils.provenance import verify
from gsgan.view.drag import drag, position

ESBUILD = WEB / "node_modules" / ".bin" / "esbuild"
SIDE = 96  # pixels of compared images
EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
# What the page draws, as base64 of RGBA rows from the bottom.
PIXELS = """(camera) => {
  const avatar = gsgan.avatar, gl = avatar.drawing.gl, {width, height} = camera;
  avatar.draw(camera, {background: [0, 0, 0, 1]});
  const pixels = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  return btoa(pixels.reduce((text, byte) => text + String.fromCharCode(byte), ""));
}"""


@pytest.fixture
def avatar(build, tmp_path, dance, landmarks):
    """The folder of a page of random residuals that moves as ``dance``, and its run."""
    data, avatar, _ = build(
        "model=harmonic", "effects.body_points=on", "effects.view_dependence=1"
    )
    avatar.body_points.offsets = None  # they are part of a copy's residuals
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for numbers in (
            *avatar.deformation.parameters(),
            *avatar.body_points.parameters(),
        ):
            numbers += 0.3 * torch.randn(numbers.shape, generator=generator)
    avatar.deformation.active_degree, avatar.window_margin = 1, None
    run = Run(tmp_path, None, {"scene": asdict(data.info)}, avatar.freeze())
    run.data = data
    seen = np.ones(landmarks.shape[:2])
    drive = Drive(landmarks, seen, dance, list(range(len(seen))), "")
    content = block(run, run.avatar, {"dance": (drive, 30.0)}, "a & b")
    (tmp_path / "avatar.bin").write_bytes(content)
    (tmp_path / "avatar.html").write_text(page(content, "a & b"))
    return tmp_path, run


@pytest.fixture
def opened(chromium, avatar):
    """``opened()``: the page, paused; nothing may be requested or reported."""
    problems, pages, address = [], [], f"file://{avatar[0] / 'avatar.html'}"

    def run():
        made = chromium.new_page(viewport={"width": 400, "height": 400})
        pages.append(made)
        made.on("pageerror", lambda error: problems.append(str(error)))
        made.on(
            "console",
            lambda m: problems.append(m.text) if m.type == "error" else None,
        )
        made.on(
            "request",
            lambda r: problems.append(r.url) if r.url != address else None,
        )
        made.goto(address)
        until(made, "window.gsgan")
        made.evaluate("gsgan.run(false), gsgan.show(0)")
        return made

    yield run
    for made in pages:
        made.close()
    assert not [p for p in problems if not p.startswith(("data:", "blob:"))]


def until(browser_page, holds: str) -> None:
    """Waits until an expression holds; the page's policy forbids Playwright's own way."""
    for _ in range(600):
        if browser_page.evaluate(f"!!({holds})"):
            return
        browser_page.wait_for_timeout(50)
    raise AssertionError(f"timed out: {holds}")


def cameras(centre: np.ndarray) -> list[Camera]:
    """Four cameras round the person."""
    found = []
    for azimuth, height in ((0.0, 0.2), (1.7, 1.0), (3.0, -0.5), (4.5, 0.0)):
        eye = centre + np.array(
            [2.5 * np.sin(azimuth), -2.5 * np.cos(azimuth), height]
        )
        ahead = (centre - eye) / np.linalg.norm(centre - eye)
        right = np.cross(ahead, [0, 0, 1]) / np.linalg.norm(
            np.cross(ahead, [0, 0, 1])
        )
        R = np.stack([right, np.cross(ahead, right), ahead])
        K = np.array(
            [
                [1.2 * SIDE, 2, SIDE / 2 + 3],
                [0, 1.3 * SIDE, SIDE / 2],
                [0, 0, 1],
            ]
        )
        given = (torch.from_numpy(x)[None].float() for x in (K, R, -R @ eye))
        found.append(Camera(*given, (SIDE, SIDE)))
    return found


def drawn(browser_page, camera: Camera) -> np.ndarray:
    """``[H, W, 3]``: what the page draws of its pose."""
    height, width = camera.size
    plain = {
        name: getattr(camera, name)[0].flatten().tolist()
        for name in ("K", "R", "t")
    }
    data = browser_page.evaluate(
        PIXELS, plain | {"width": width, "height": height}
    )
    pixels = np.frombuffer(base64.b64decode(data), np.uint8)
    return pixels.reshape(height, width, 4)[::-1, :, :3] / 255


def psnr_in_box(
    image: np.ndarray, truth: np.ndarray, alpha: np.ndarray
) -> float:
    rows, columns = np.nonzero(alpha > 0.02)
    box = (
        slice(rows.min(), rows.max() + 1),
        slice(columns.min(), columns.max() + 1),
    )
    return float(-10 * np.log10(np.square(image - truth)[box].mean()))


def test_the_page_draws_what_gsgan_draws(opened, avatar, dance, landmarks):
    made, model = opened(), avatar[1].avatar
    for i in range(10):
        made.evaluate("i => gsgan.avatar.play(1, i)", i)
        p = torch.from_numpy(landmarks[i : i + 1]).float()
        for camera in cameras(landmarks[i].mean(0)):
            with torch.no_grad():
                truth = model(
                    p, torch.ones(p.shape[:2]), camera, dance[i : i + 1]
                )
            colour = truth.features[0, :3].movedim(0, -1).clamp(0, 1).numpy()
            alpha = truth.splat_alpha[0, 0].numpy()
            assert psnr_in_box(drawn(made, camera), colour, alpha) > 40


def test_poses_of_landmarks_are_the_solvers(opened, avatar, signing):
    made, run = opened(), avatar[1]
    for p in (signing[3], signing[3, :33], signing[8]):
        found = made.evaluate(
            "p => gsgan.avatar.pose(p) && Array.from(gsgan.avatar.landmarks)",
            p.tolist(),
        )
        given = torch.from_numpy(p)[None].float()
        pose = run.avatar.body_pose(given, torch.ones(given.shape[:2]))
        body = run.body
        truth = torch.cat(
            [body.posed_landmarks(pose), body.posed_hands(pose)], dim=1
        )[0]
        np.testing.assert_allclose(np.array(found), truth, atol=1e-4)
    unseen = signing[3].copy()
    unseen[11] = np.nan
    assert not made.evaluate("p => gsgan.avatar.pose(p)", unseen.tolist())


def test_a_dragged_hand_moves_as_in_the_viewer(opened, avatar):
    made, run = opened(), avatar[1]
    made.get_by_label("drag joints").check()
    hand = made.get_by_role("button", name="left wrist")
    hand.wait_for()
    before = np.array(made.evaluate("gsgan.avatar.landmarks"))
    box = hand.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    made.mouse.move(x, y)
    made.mouse.down()
    made.mouse.move(x - 20, y - 60)
    made.mouse.up()
    after = np.array(made.evaluate("gsgan.avatar.landmarks"))
    assert np.linalg.norm(after[15] - before[15]) > 0.1
    hand.press("ArrowUp")
    made.get_by_text("undo dragging").click()
    np.testing.assert_allclose(
        made.evaluate("gsgan.avatar.landmarks"), before, atol=1e-6
    )
    for name in ("right wrist", "left ankle", "head", "body"):
        made.evaluate("gsgan.show(0)")
        target = position(before, name) + np.array([0.1, -0.05, 0.12])
        made.evaluate(
            "([n, x]) => gsgan.avatar.drag(n, x)", [name, target.tolist()]
        )
        p = torch.from_numpy(drag(before, name, target))[None].float()
        pose = run.avatar.body_pose(p, torch.ones(p.shape[:2]))
        truth = run.body.posed_landmarks(pose)[0]
        found = np.array(made.evaluate("gsgan.avatar.landmarks"))[:33]
        np.testing.assert_allclose(found, truth, atol=2e-4)


def test_it_plays_and_survives_sizes_a_lost_context_and_a_second_page(
    opened, avatar
):
    first, second = opened(), opened()
    (camera, *_) = cameras(np.array([0, 0, 1.0]))
    image = drawn(first, camera)
    first.evaluate("gsgan.run(true)")
    until(first, "gsgan.frame > 2")
    first.evaluate("gsgan.run(false)")
    np.testing.assert_array_equal(drawn(second, camera), image)
    first.set_viewport_size({"width": 360, "height": 740})
    until(first, "document.getElementById('image').width == 360")
    first.evaluate("gsgan.show(0)")
    lose = "window.loss = gsgan.avatar.drawing.gl.getExtension('WEBGL_lose_context')"
    first.evaluate(f"{lose}, loss.loseContext()")
    until(first, "gsgan.avatar.drawing.gl.isContextLost()")
    first.evaluate("gsgan.show(0), gsgan.draw(true), loss.restoreContext()")
    until(first, "!gsgan.avatar.drawing.gl.isContextLost()")
    first.wait_for_timeout(200)
    np.testing.assert_array_equal(drawn(first, camera), image)


def test_the_camera_by_mouse_keys_and_wheel_and_the_saved_image(
    opened, tmp_path
):
    made = opened()
    orbit = made.evaluate("({...gsgan.orbit})")
    made.mouse.move(200, 200)
    made.mouse.down()
    made.mouse.move(260, 200)
    made.mouse.up()
    made.keyboard.press("ArrowUp")
    made.mouse.wheel(0, 200)
    until(made, f"gsgan.orbit.distance > {orbit['distance']}")
    now = made.evaluate("({...gsgan.orbit})")
    assert now["azimuth"] != orbit["azimuth"]
    assert now["elevation"] != orbit["elevation"]
    assert made.title() == "a & b"
    with made.expect_download() as got:
        made.get_by_text("save the image").click()
    path = tmp_path / "saved.png"
    path.write_bytes(got.value.path().read_bytes())
    assert verify(path).synthetic
    assert Image.open(io.BytesIO(path.read_bytes())).size[0] == 400


@pytest.fixture
def served(avatar):
    """The address of the page's folder, with the library and the examples beside it."""
    for path in (WEB / "gsgan.js", EXAMPLES / "webcam.html"):
        shutil.copy(path, avatar[0])
    handler = functools.partial(
        http.server.SimpleHTTPRequestHandler, directory=avatar[0]
    )
    handler.log_message = lambda *_: None
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.mark.parametrize("source", ["avatar.html", "avatar.bin"])
def test_the_webcam_example_by_recorded_landmarks(
    chromium, served, avatar, landmarks, source
):
    p = landmarks[7] - landmarks[7, 23:25].mean(0)
    as_mediapipe = 1.1 * np.stack([p[:, 0], -p[:, 2], p[:, 1]], axis=-1)
    frame = [dict(zip("xyz", x, strict=True)) for x in as_mediapipe.tolist()]
    (avatar[0] / "landmarks.json").write_text(
        json.dumps({"fps": 30, "frames": [frame]})
    )
    made, problems = (
        chromium.new_page(viewport={"width": 200, "height": 200}),
        [],
    )
    made.on("pageerror", lambda error: problems.append(str(error)))
    made.on(
        "console",
        lambda m: problems.append(m.text) if m.type == "error" else None,
    )
    made.goto(f"{served}/webcam.html?avatar={source}&recording=landmarks.json")
    until(made, "window.avatar?.landmarks.length")
    made.wait_for_timeout(500)
    found = np.array(
        made.evaluate("avatar.landmarks.map(x => avatar.toStandard(x))")
    )
    for a, b in ((11, 13), (12, 14), (23, 25), (26, 28)):
        bones = [
            (x[b] - x[a]) / np.linalg.norm(x[b] - x[a]) for x in (found, p)
        ]
        assert bones[0] @ bones[1] > 0.8  # the tiny subject and its body differ
    made.close()
    assert not problems


def test_the_script_is_built_from_its_sources(tmp_path):
    sources = [*sorted(WEB.glob("*.ts")), WEB / "solve.wasm"]
    digest = hashlib.sha256(
        b"".join(path.read_bytes() for path in sources)
    ).hexdigest()
    built = (WEB / "gsgan.js").read_text()
    assert built.startswith(f"// {digest}\n"), (
        "run npm ci and npm run build in export/web"
    )
    if ESBUILD.exists():
        command = json.loads((WEB / "package.json").read_text())["scripts"][
            "build"
        ]
        command = command.replace(
            "outfile=gsgan.js", f"outfile={tmp_path / 'gsgan.js'}"
        )
        done = subprocess.run(
            f"{ESBUILD.parent}/{command}", shell=True, cwd=WEB, check=False
        )
        assert done.returncode == 0
        assert (tmp_path / "gsgan.js").read_text() == built


def test_quantised_values():
    values = np.array([[0.0, 0.0], [1.0, -2.0]])
    found, step = quantise(values, 127)
    assert found.tolist() == [[0, 0], [64, -127]]
    np.testing.assert_allclose(step[1], 2 / 127)
    assert quantise(values, 32767)[0].dtype == np.int16


def test_an_avatar_without_a_body_is_refused(bare, inside):
    given = inside("export", f"run={bare}", "format=html", "out=a.html")
    refused(given, "a page needs", "body_points")


def test_training_writes_the_page(on_body, tmp_path, inside):
    text = (on_body() / "avatar.html").read_text()
    assert "trainedAlgorithmicMedia" in text
    assert (on_body() / "avatar.html.MODEL_CARD.md").exists()
    given = (
        f"run={on_body()}",
        "format=bin",
        "motion=[novel_pose,train]",
        "out=avatar.gsgan.bin",
    )
    result = inside("export", *given)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "avatar.gsgan.bin").stat().st_size < len(text)
