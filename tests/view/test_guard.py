"""Web pages other than the viewer's own cannot connect to it."""

import gzip

import pytest

from gsgan.view.guard import guard_server, refusal, with_probe

HOST = "127.0.0.1:8080"


@pytest.mark.parametrize(
    ("host", "origin", "served"),
    [
        (HOST, None, "127.0.0.1"),  # no browser
        (HOST, f"http://{HOST}", "127.0.0.1"),
        (
            "localhost:9999",
            "http://localhost:9999",
            "127.0.0.1",
        ),  # a forwarded port
        ("[::1]:8080", "http://[::1]:8080", "::1"),
        ("192.168.0.7:8080", "http://192.168.0.7:8080", "0.0.0.0"),
        ("studio.lab:8080", "http://studio.lab:8080", "Studio.lab"),
    ],
)
def test_the_viewers_own_page_is_answered(host, origin, served):
    assert refusal(host, origin, served) is None


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        (HOST, "http://evil.example"),
        (HOST, "null"),  # a file, a sandboxed frame
        (HOST, "http://127.0.0.1:3000"),  # another server of this machine
        (HOST, f"http://{HOST}.evil.example"),
        ("evil.example:8080", "http://evil.example:8080"),  # DNS rebinding
        ("evil.example:8080", None),
        (None, None),
    ],
)
def test_other_pages_are_refused(host, origin):
    assert refusal(host, origin, "127.0.0.1")


def test_a_refusal_names_the_option_that_allows_it():
    why = refusal("studio.lan:8080", None, "0.0.0.0")
    assert "host=studio.lan" in why
    why = refusal("localhost:8080", "https://name", "127.0.0.1")
    assert "origin=" in why
    why = refusal("localhost:8080", None, "127.0.0.1", None, "name, inner")
    assert "origin=https://name" in why
    assert "evil" not in refusal(HOST, None, "127.0.0.1", None, "<b>evil</b>")


@pytest.mark.parametrize(
    ("host", "forwarded"),
    [("localhost:8080", "name"), ("localhost:8080", None), ("name", None)],
)
def test_the_named_origin_may_connect(host, forwarded):
    for origin in ("https://name", None):
        assert (
            refusal(host, origin, "127.0.0.1", "https://name/", forwarded)
            is None
        )
    assert refusal(host, "https://other", "127.0.0.1", "https://name")


def test_a_page_whose_connection_is_refused_says_why(chromium):
    """A proxy that keeps the page's address to itself: the page loads, its connection does not."""
    viser = pytest.importorskip(
        "viser", reason="the extra view is not installed"
    )
    with guard_server("127.0.0.1"):
        server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    port = server.get_port()
    page = chromium.new_page()
    try:
        own = f"http://127.0.0.1:{port}"
        page.route(
            "http://studio.example/",
            lambda route: route.fulfill(response=route.fetch(url=own)),
        )
        page.goto("http://studio.example/")
        page.wait_for_selector("text=origin=http://studio.example")
        page.goto(own)
        assert "origin=" not in page.inner_text("body")
    finally:
        page.close()
        server.stop()


def test_the_page_holds_no_code_of_a_request():
    page = with_probe(b"<html>", '</script>"', None, zipped=False).decode()
    assert page.count("</script>") == 1
    packed = with_probe(gzip.compress(b"<html>"), HOST, None, zipped=True)
    assert HOST in gzip.decompress(packed).decode()


def test_visers_server_refuses_them():
    viser = pytest.importorskip(
        "viser", reason="the extra view is not installed"
    )
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    with guard_server("127.0.0.1"):
        server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        address = f"127.0.0.1:{server.get_port()}"
        version = [f"viser-v{viser.__version__}"]
        with connect(
            f"ws://{address}", origin=f"http://{address}", subprotocols=version
        ):
            pass
        for origin in ("http://evil.example", "null"):
            with pytest.raises(InvalidStatus, match="403"):
                connect(f"ws://{address}", origin=origin, subprotocols=version)
    finally:
        server.stop()
