"""Who may see the lab's web page: an ASGI layer around the page that lets in the holder of a cookie only."""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from collections.abc import Awaitable, Callable, Mapping, MutableMapping, Sequence
from typing import Any
from urllib.parse import parse_qs

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Any]]
Send = Callable[[Any], Awaitable[None]]

ENTRY = b'<!doctype html><meta http-equiv="refresh" content="0;url=/"><title>Hannes</title><p><a href="/">Go on</a>'
"""Not a redirection: a link that was followed from another site would be refused the cookie."""

REFUSAL = b"Refused. Open the page by the link on the terminal where `hannes page` runs; a link works once.\n"

PRIVATE = [
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cross-origin-opener-policy", b"same-origin"),
]
"""Headers of every answer."""


class Guard:
    """Lets in who holds the cookie, which the link of the terminal is exchanged for; everybody else gets 403.

    Host must name this machine, so that no foreign name can be pointed at it (DNS rebinding); Origin must be the page's
    own, so that no foreign page can act through the user's browser.
    """

    def __init__(
        self,
        app: Any,
        *,
        port: int,
        names: Sequence[str] = (),
        any_address: bool = False,
        used: Callable[[], None] | None = None,
    ) -> None:
        """Guard an ASGI application.

        names        names and addresses beside those of the loopback by which it may be called
        any_address  any numeric address is right: a foreign name is none
        used         is called when a link was used; the next one is `link_token`
        """
        self.app = app
        self.cookie = f"hannes_page_{port}"  # cookies of one host are shared by its ports
        self.link_token = secrets.token_urlsafe(32)
        self._sessions: set[str] = set()
        self._names = {"localhost", "127.0.0.1", "::1", *(n.lower() for n in names)}
        self._any_address = any_address
        self._used = used

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        headers: dict[str, list[str]] = {}
        for name, value in scope["headers"]:
            headers.setdefault(name.decode("latin-1").lower(), []).append(value.decode("latin-1"))
        if not self._at_home(scope, headers):
            await _refuse(scope, send)
        elif self._known(headers):
            await self._pass(scope, receive, _with_headers(send, headers["host"][0]))
        elif self._enters(scope):
            session = secrets.token_urlsafe(32)
            self._sessions.add(session)
            self.link_token = secrets.token_urlsafe(32)
            cookie = f"{self.cookie}={session}; Path=/; HttpOnly; SameSite=Strict"
            await _answer(send, 200, ENTRY, b"text/html; charset=utf-8", [(b"set-cookie", cookie.encode())])
            if self._used:
                self._used()
        else:
            await _refuse(scope, send)

    async def _pass(self, scope: Scope, receive: Receive, send: Send) -> None:
        gone = False

        async def noted() -> Any:
            nonlocal gone
            message = await receive()
            gone = gone or message["type"] == "http.disconnect"
            return message

        try:
            await self.app(scope, noted, send)
        except (RuntimeError, KeyError):
            if not gone:  # a browser that has left before it was answered is no error
                raise

    def _at_home(self, scope: Scope, headers: Mapping[str, list[str]]) -> bool:
        host, origin = headers.get("host", []), headers.get("origin", [])
        if len(host) != 1 or len(origin) > 1 or not self._named(host[0]):
            return False
        if not origin:  # browsers send none with what only reads
            return scope["type"] == "http" and scope["method"] in ("GET", "HEAD")
        return origin[0].lower() in (f"http://{host[0].lower()}", f"https://{host[0].lower()}")

    def _named(self, host: str) -> bool:
        name, colon, port = host.lower().rpartition(":")
        if not colon or not port.isdecimal():
            name = host.lower()
        name = name.removeprefix("[").removesuffix("]")
        return name in self._names or (self._any_address and address_of(name) is not None)

    def _known(self, headers: Mapping[str, list[str]]) -> bool:
        # by hand: http.cookies stops at the first odd cookie, which another program of this host may have set
        pairs = (
            part.strip().partition("=") for line in headers.get("cookie", []) for part in line.split(";")
        )
        given = [value.encode() for name, _, value in pairs if name == self.cookie]
        return any(hmac.compare_digest(one, session.encode()) for one in given for session in self._sessions)

    def _enters(self, scope: Scope) -> bool:
        if scope["type"] != "http" or scope["method"] != "GET" or scope["path"] != "/":
            return False
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        return hmac.compare_digest(given.encode(), self.link_token.encode())


def _with_headers(send: Send, host: str) -> Send:
    """Answers that the browser may use for this page only, and which may load nothing from elsewhere."""
    policy = (
        "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
        f"img-src 'self' data:; font-src 'self' data:; connect-src 'self' ws://{host} wss://{host}; "
        "object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
    )

    async def add(message: Any) -> None:
        if message["type"] == "http.response.start":
            own = (b"content-security-policy", policy.encode("latin-1"))
            message["headers"] = [*message.get("headers", []), *PRIVATE, own]
        await send(message)

    return add


async def _answer(
    send: Send, status: int, body: bytes, kind: bytes, more: Sequence[tuple[bytes, bytes]] = ()
) -> None:
    length = str(len(body)).encode()
    headers = [
        (b"content-type", kind),
        (b"content-length", length),
        (b"cache-control", b"no-store"),
        *PRIVATE,
        *more,
    ]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})


async def _refuse(scope: Scope, send: Send) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008})  # before it is accepted: the server answers 403
    else:
        await _answer(send, 403, REFUSAL, b"text/plain; charset=utf-8")


def address_of(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """The address that a text is; None for a name."""
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None
