"""Which requests the viewer's server answers: viser itself answers any web page."""

import gzip
import ipaddress
import json
import re
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any
from urllib.parse import urlsplit


def refusal(
    host: str | None,
    origin: str | None,
    served: str,
    allowed: str | None = None,
    forwarded: str | None = None,
) -> str | None:
    """The reason why a request is refused, or None.

    A browser sends in ``Origin`` which page opens a connection, so other pages are
    refused. A page whose own domain name points at this machine (DNS rebinding) has the same
    origin, but its name as ``Host``: that must be an address, localhost or a name of this machine.
    Programs other than browsers send no origin.

    Args:
        host, origin: the request's headers.
        served: the option ``host``.
        allowed: the option ``origin``: another address of the page, behind a proxy.
        forwarded: the header ``X-Forwarded-Host``, the name by which a proxy was asked.
    """
    # Behind a proxy the page would wait for a connection that is refused, so it is refused itself.
    public = urlsplit(allowed or "").netloc.lower()
    name = _first_name(forwarded)
    if name and name != public and name != host:
        return (
            "the viewer is behind a proxy or port forwarding; start it with "
            f"origin=https://{name}, the address in the browser"
        )

    # A name that is no address must be known.
    name = urlsplit(f"//{host}").hostname or ""
    try:
        ipaddress.ip_address(name)
    except ValueError:
        if name not in (
            "localhost",
            served.lower(),
            socket.gethostname().lower(),
            urlsplit(allowed or "").hostname,
        ):
            return (
                "open the viewer by the address that it prints, or start it with "
                f"host={name or '<name>'} if that is a name of this machine"
            )

    # The page has the address that it connects to, or the one of the option.
    if origin is None or origin == (allowed or "").rstrip("/"):
        return None
    if origin.partition("://")[2] != host:
        return (
            "only the viewer's own page may connect; behind a proxy start it with "
            "origin=<the address in the browser>"
        )
    return None


# A page at another address than the request tries the connection that it needs, and says why it
# gets none: browsers do not tell.
PROBE = """<script>
if (location.host !== HOST && location.origin !== ORIGIN) {
  const probe = new WebSocket(location.href.replace(/^http/, "ws"));
  probe.onopen = () => probe.close();
  probe.onerror = () => {
    document.body.innerText = "The viewer does not accept connections from this address. Start it "
      + `with origin=${location.origin}; the proxy or port forwarding must pass WebSockets.`;
  };
}
</script>"""


def with_probe(
    body: bytes, host: str, allowed: str | None, zipped: bool
) -> bytes:
    """The viewer's page with `PROBE` at its end.

    Args:
        body: HTML.
        host: the request's ``Host``.
        allowed: the option ``origin``.
        zipped: whether the body is compressed by gzip.
    """
    text = PROBE
    for word, value in (
        ("HOST", host),
        ("ORIGIN", (allowed or "").rstrip("/")),
    ):
        text = text.replace(word, json.dumps(value).replace("<", "\\u003c"))
    probe = text.encode()
    if not zipped:
        return body + probe
    return gzip.compress(gzip.decompress(body) + probe)


def _first_name(forwarded: str | None) -> str:
    """The first name in ``X-Forwarded-Host``, which proxies append to; empty for none or an odd
    one."""
    name = (forwarded or "").partition(",")[0].strip().lower()
    return name if re.fullmatch(r"[a-z0-9.:\[\]-]*", name) else "<name>"


@contextmanager
def guard_server(served: str, allowed: str | None = None) -> Iterator[None]:
    """A context in which viser starts servers that refuse requests with status 403, see `refusal`.

    Args:
        served: the option ``host``.
        allowed: the option ``origin``.
    """
    from websockets.asyncio import server  # viser's

    # A request from another page is refused before viser sees it.
    def check(inner: Any, connection: Any, request: Any) -> Any:
        host = request.headers.get("Host")
        origin = request.headers.get("Origin")
        forwarded = request.headers.get("X-Forwarded-Host")
        why = refusal(host, origin, served, allowed, forwarded)
        if why is not None:
            return connection.respond(403, f"{why}\n")
        response = inner(connection, request)
        kind = (
            "" if response is None else response.headers.get("Content-Type", "")
        )
        if not kind.startswith("text/html"):
            return response
        zipped = response.headers["Content-Encoding"] == "gzip"
        response.body = with_probe(response.body, host, allowed, zipped)
        del response.headers["Content-Length"]
        response.headers["Content-Length"] = str(len(response.body))
        return response

    def serve(*args: Any, process_request: Any, **options: Any) -> Any:
        checked = partial(check, process_request)
        return original(*args, process_request=checked, **options)

    # viser has no option for this, so the function that it calls is replaced.
    original = server.serve
    server.serve = serve  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        server.serve = original  # type: ignore[misc]
