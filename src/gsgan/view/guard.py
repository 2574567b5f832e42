"""Which requests the viewer's server answers: viser itself answers any web page."""

import ipaddress
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any
from urllib.parse import urlsplit


def refusal(host: str | None, origin: str | None, served: str) -> str | None:
    """The reason why a request is refused, or None.

    A browser sends in ``Origin`` which page opens a connection, so other pages are
    refused. A page whose own domain name points at this machine (DNS rebinding) has the same
    origin, but its name as ``Host``: that must be an address, localhost or a name of this machine.
    Programs other than browsers send no origin.

    Args:
        host, origin: the request's headers.
        served: the option ``host``.
    """
    # A name that is no address must be known.
    name = urlsplit(f"//{host}").hostname or ""
    try:
        ipaddress.ip_address(name)
    except ValueError:
        if name not in (
            "localhost",
            served.lower(),
            socket.gethostname().lower(),
        ):
            return "open the viewer by the address that it prints"

    # The page has the address that it connects to.
    if origin is not None and origin.partition("://")[2] != host:
        return "only the viewer's own page may connect"
    return None


@contextmanager
def guarded(served: str) -> Iterator[None]:
    """A context in which viser starts servers that refuse requests with status 403, see `refusal`.

    Args:
        served: the option ``host``.
    """
    from websockets.asyncio import server  # viser's

    # A request from another page is refused before viser sees it.
    def check(inner: Any, connection: Any, request: Any) -> Any:
        host = request.headers.get("Host")
        origin = request.headers.get("Origin")
        why = refusal(host, origin, served)
        if why is None:
            return inner(connection, request)
        return connection.respond(403, f"{why}\n")

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
