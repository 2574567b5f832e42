"""Which requests the viewer's server answers: viser itself answers any web page."""

import ipaddress
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any
from urllib.parse import urlsplit


def refusal(host: str | None, origin: str | None, served: str) -> str | None:
    """Why a request is refused, or None.

    Convention: a browser says in ``Origin`` which page opens a connection, so other pages are
    refused. A page whose own domain name points at this machine (DNS rebinding) has the same
    origin, but its name as ``Host``: that must be an address, localhost or a name of this machine.
    Programs other than browsers send no origin.

    Args:
        host, origin: the request's headers.
        served: the option ``host``.
    """
    name = urlsplit(f"//{host}").hostname or ""
    try:
        ipaddress.ip_address(name)
    except ValueError:
        if name not in ("localhost", served.lower(), socket.gethostname().lower()):
            return "open the viewer by the address that it prints"
    if origin is not None and origin.partition("://")[2] != host:
        return "only the viewer's own page may connect"
    return None


@contextmanager
def guarded(served: str) -> Iterator[None]:
    """Servers that viser starts inside refuse requests as `refusal` does, with status 403.

    Args:
        served: the option ``host``.
    """
    from websockets.asyncio import server  # viser's

    def check(inner: Any, connection: Any, request: Any) -> Any:
        host = request.headers.get("Host")
        origin = request.headers.get("Origin")
        why = refusal(host, origin, served)
        return (
            inner(connection, request)
            if why is None
            else connection.respond(403, f"{why}\n")
        )

    def serve(*args: Any, process_request: Any, **options: Any) -> Any:
        return original(
            *args, process_request=partial(check, process_request), **options
        )

    original = server.serve
    server.serve = serve  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        server.serve = original  # type: ignore[misc]
