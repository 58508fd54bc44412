"""Which browsers may use the page: only those that show the page itself.

Any web page that the user visits can open a connection to a server on this machine, and could press "stop". A browser
reports the page that opens a connection in the header Origin, and the name that the user typed in the header Host.
"""

from __future__ import annotations

import contextlib
import inspect
import ipaddress
import logging
import socket
from collections.abc import Callable, Iterator, Mapping
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

from linkpose.page.client import adapted

# Browsers open connections in advance and close them unused, which websockets logs as an error with a traceback. It is
# printed only where the program that uses linkpose has asked for logs.
_LOG = logging.getLogger("linkpose.page")
_LOG.addHandler(logging.NullHandler())


def is_own(headers: Mapping[str, str], host: str) -> bool:
    """Whether a request comes from the page itself, or from a program that is no browser.

    `host` is the address of the server. A Host that is neither this nor an address, `localhost` or this machine's name
    is refused too: a foreign page may have bound its own name to this machine's address (DNS rebinding).
    """
    asked = urlsplit(f"//{headers.get('Host', '')}")
    origin = headers.get("Origin")
    if origin is not None and urlsplit(origin).netloc != asked.netloc:
        return False
    name = (asked.hostname or "").lower()
    machine = socket.gethostname().lower()
    return name in {host.lower(), "localhost", machine, f"{machine}.local"} or _is_address(name)


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _adapted(answer: Any) -> Any:
    """An answer of viser's server; the page among them becomes linkpose's."""
    if answer is not None and answer.headers.get("Content-Type", "").startswith("text/html"):
        answer.body = adapted(answer.body.decode()).encode()
        del answer.headers["Content-Length"]
        answer.headers["Content-Length"] = str(len(answer.body))
    return answer


@contextlib.contextmanager
def own_requests_only(host: str) -> Iterator[None]:
    """A server that viser starts within this context answers only requests that `is_own` allows; others get 403."""
    import websockets.asyncio.server as websockets

    serve: Callable[..., Any] = websockets.serve

    def checked_serve(*args: Any, process_request: Callable[..., Any] | None = None, **options: Any) -> Any:
        async def process(connection: Any, request: Any) -> Any:
            if not is_own(request.headers, host):
                return connection.respond(HTTPStatus.FORBIDDEN, "This page is not open to other pages.\n")
            request.headers.pop("Accept-Encoding", None)  # `_adapted` needs the page's text
            answer = process_request(connection, request) if process_request is not None else None
            return _adapted(await answer if inspect.isawaitable(answer) else answer)

        return serve(*args, process_request=process, logger=_LOG, **options)

    setattr(websockets, "serve", checked_serve)  # noqa: B010  # viser has no parameter for it
    try:
        yield
    finally:
        setattr(websockets, "serve", serve)  # noqa: B010
