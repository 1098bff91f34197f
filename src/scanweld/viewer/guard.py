"""Who may look: a server that answers on this machine alone, or to those who know a token.

viser answers whoever asks. A page from anywhere that is open in the same browser could therefore connect to it and
take the camera's pictures. Here each request, that of the web socket included, has to come to a name of this machine
(no other name can be bent to point here), from a page of the same server, and, where it listens to others, with the
token of the address that was printed. A cookie carries it from there on.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import http
import io
import ipaddress
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from scanweld.errors import InvalidInputError, MissingDependencyError

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 8080

_EVERYWHERE = ("0.0.0.0", "::")

_starting = threading.Lock()


def is_loopback(host: str) -> bool:
    """Whether a host name or address is that of this machine, as it calls itself."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class Guard:
    """Decides about requests by their headers; see the module."""

    def __init__(self, host: str) -> None:
        self.open_to_others = not is_loopback(host)
        self.token = secrets.token_urlsafe(18) if self.open_to_others else ""
        self._cookie = "scanweld-" + hashlib.sha256(self.token.encode()).hexdigest()[:8]

    def refusal(self, path: str, headers: Any) -> str:
        """Return why a request is refused, "" for one that is not."""
        host = headers.get("Host") or ""
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            name = ""
        if not self.open_to_others and not is_loopback(name):
            return "this view is for the machine that it runs on"
        origin = headers.get("Origin")
        if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
            return "a page of another server asks"
        if self.token and not (self._in_query(path) or self._in_cookie(headers)):
            return "the address needs its token; it was printed where the view was started"
        return ""

    def cookie(self, path: str) -> str | None:
        """Return the cookie to set for a request that named the token."""
        if self.token and self._in_query(path):
            return f"{self._cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"
        return None

    def _in_query(self, path: str) -> bool:
        named = parse_qs(urlsplit(path).query).get("token", ())
        return any(token.isascii() and hmac.compare_digest(token, self.token) for token in named)

    def _in_cookie(self, headers: Any) -> bool:
        for header in headers.get_all("Cookie"):
            try:
                found = SimpleCookie(header).get(self._cookie)
            except CookieError:
                continue
            if found is not None and found.value.isascii() and hmac.compare_digest(found.value, self.token):
                return True
        return False


def start_server(host: str = DEFAULT_HOST, port: int = DEFAULT_PORT, *, label: str = "") -> tuple[Any, str]:
    """Start a viser server that answers as :class:`Guard` says; return it and the address for a browser.

    Where the port is taken, the next that is free is used; 0 is any.

    Raises
    ------
    MissingDependencyError
        When viser is not installed.
    InvalidInputError
        When the host is none of this machine.
    """
    try:
        import viser
    except ImportError:
        raise MissingDependencyError("viser", "view") from None
    try:
        family = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:  # viser would look for a free port for ever
            probe.bind((host, 0))
    except OSError as error:
        raise InvalidInputError(f"view host {host!r}: nothing can listen there: {error}") from None
    guard = Guard(host)
    with _starting, _guarded(guard) as installed, contextlib.redirect_stdout(io.StringIO()):  # viser prints a table
        server = viser.ViserServer(host, port, label=label or "scanweld", verbose=False)
    if not installed():
        stop_server(server)
        raise MissingDependencyError("a viser that can be guarded (1.1 can)", "view")
    # A button of the page would make the scene public by a tunnel over a server of viser's authors.
    server.request_share_url = lambda verbose=True: None
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    shown = socket.gethostname() if host in _EVERYWHERE else f"[{host}]" if ":" in host else host
    query = f"/?token={guard.token}" if guard.token else "/"
    return server, f"http://{shown}:{server.get_port()}{query}"


def stop_server(server: Any) -> None:
    """Stop a server, without its words."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


@contextlib.contextmanager
def _guarded(guard: Guard) -> Iterator[Callable[[], bool]]:
    """Put a guard before the servers that are started meanwhile; yields whether there was one.

    viser offers no place for it, but starts its server by this one call of websockets.
    """
    import websockets.asyncio.server as module

    serve = module.serve
    seen = []

    def guarded_serve(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            why = guard.refusal(request.path, request.headers)
            if why:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"scanweld: {why}\n")
            response = process_request(connection, request) if process_request else None
            cookie = guard.cookie(request.path)
            if response is not None and cookie is not None:
                response.headers["Set-Cookie"] = cookie
            return response

        seen.append(True)
        return serve(*arguments, process_request=process, **options)

    module.serve = guarded_serve  # type: ignore[assignment,misc]
    try:
        yield lambda: bool(seen)
    finally:
        module.serve = serve  # type: ignore[misc]
