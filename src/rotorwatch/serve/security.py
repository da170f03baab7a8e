"""Access control: token, host and origin of a request, and security headers of the answers."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import ipaddress
import socket
from urllib.parse import parse_qs, urlencode, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rotorwatch.errors import ConfigError
from rotorwatch.serve.connections import LET_IN

# The page runs its own files alone: nothing inline, nothing of another host, in no frame.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; form-action 'self'; "
    "base-uri 'none'; frame-ancestors 'none'"
)
ALWAYS = {"X-Content-Type-Options": "nosniff", "X-Frame-Options": "DENY"} | dict.fromkeys(
    ("Referrer-Policy", "Cross-Origin-Resource-Policy", "Cross-Origin-Opener-Policy"), "same-origin"
)
LEAST = 16  # letters of a token, too many to guess over a network
MOST_FORM, FORM_S = 4096, 10.0  # bytes of the login form; s for sending it
NEEDED, WRONG = (f"{what}: give the one rotorwatch was started with." for what in ("A token is needed", "Wrong token"))
OPEN = ("/static/page.css", "/static/serve.css")  # the login form looks like the page


def loopback(host: str) -> bool:
    """True if only this computer can reach that address."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def checked(host: str, token: str) -> str:
    """The token, if it is sufficient for a server on that host. Raises ConfigError."""
    if token and (len(token) < LEAST or not token.isascii() or not token.isprintable()):
        raise ConfigError(f"--token: give at least {LEAST} plain letters and digits, for instance what `openssl rand -hex 16` prints.")
    if not token and not loopback(host):
        raise ConfigError(
            f"--host {host}: other computers can reach this address; set a token (--token, or the environment "
            "variable ROTORWATCH_TOKEN), or omit --host."
        )
    return token


class Guard:
    """Middleware around the whole application. host: that it listens on; token: empty where none is required."""

    def __init__(self, app: ASGIApp, host: str, token: str):
        self._app, self._token = app, token
        self._names = {"localhost", host.lower(), socket.gethostname().lower(), f"{socket.gethostname().lower()}.local"}
        self._secret = hmac.new(token.encode(), b"rotorwatch page", hashlib.sha256).hexdigest()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.setdefault("Content-Security-Policy", POLICY)
                headers.setdefault("Cache-Control", "no-store")
                headers.update(ALWAYS)
            await send(message)

        answer = await self._refusal(Request(scope, receive))
        scope[LET_IN] = answer is None
        await (answer or self._app)(scope, receive, guarded)

    async def _refusal(self, request: Request) -> Response | None:
        """The answer to a refused request, or None for one with access."""
        headers = request.headers
        if len(headers.getlist("host")) != 1 or not self._own_host(headers["host"]):
            why = "This is not the server's address; use the name or address it was started with."
            return refused(request, 421, why)
        if request.method not in ("GET", "HEAD") and not from_here(headers):
            return refused(request, 403, "This request came from another site; open rotorwatch's own page.")
        if not self._token:
            return RedirectResponse("/", 303) if request.url.path == "/login" else None
        form = request.method == "POST" and not request.url.path.startswith("/api/")
        if form and (request.url.path == "/login" or not self._may(request)):
            return await self._login(request)
        if self._may(request) or request.url.path in OPEN:
            return None
        token = request.query_params.get("token")
        if token is not None and self._same(token):
            if request.method != "GET":  # of a program; a browser gets a cookie
                return None
            return self._let_in(request)
        return refused(request, 401, WRONG if token is not None or "authorization" in headers else NEEDED)

    def _own_host(self, host: str) -> bool:
        """True if the host is an address, or a name of this computer. Any other name points here by a foreign name server (DNS
        rebinding)."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
            urlsplit(f"//{host}").port  # noqa: B018 - raises for what is no port
        except ValueError:
            return False
        if any(c in host for c in "/\\@?# \t"):
            return False
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return name in self._names
        return True

    def _same(self, token: str) -> bool:
        return hmac.compare_digest(token.encode("utf-8", "replace"), self._token.encode())

    def _may(self, request: Request) -> bool:
        kind, _, token = request.headers.get("authorization", "").partition(" ")
        if kind.lower() == "bearer":
            return self._same(token.strip())
        cookie = request.cookies.get(_cookie(request), "").encode("utf-8", "replace")
        return hmac.compare_digest(cookie, self._secret.encode())

    async def _login(self, request: Request) -> Response:
        try:
            body = await asyncio.wait_for(_form(request), FORM_S)
        except asyncio.TimeoutError:
            return refused(request, 408, "The request was too slow; try again on a better connection.")
        if len(body) > MOST_FORM:
            return refused(request, 413, "This is too long for a token.")
        token = parse_qs(body.decode("utf-8", "replace")).get("token", [""])[0].strip()
        if not self._same(token):
            return refused(request, 401, WRONG)
        return self._let_in(request)

    def _let_in(self, request: Request) -> Response:
        """Redirect to the requested page. Browsers keep the part behind a #, which no server sees."""
        rest = urlencode([(k, v) for k, v in request.query_params.multi_items() if k != "token"])
        path = "/" if request.url.path == "/login" else request.url.path + (f"?{rest}" if rest else "")
        answer = RedirectResponse("/" + path.lstrip("/\\"), 303)
        secure = request.url.scheme == "https"
        # Lax, not strict: links from reports (in a sandbox, of no origin) and from mails lead in. No GET changes anything.
        answer.set_cookie(_cookie(request), self._secret, httponly=True, samesite="lax", secure=secure)
        return answer


async def _form(request: Request) -> bytes:
    """The body, as far as it is no longer than a form."""
    body = b""
    async for piece in request.stream():
        body += piece
        if len(body) > MOST_FORM:
            break
    return body


def _cookie(request: Request) -> str:
    """Name of the cookie, by port, as browsers send cookies to all ports of a host."""
    return f"rotorwatch-{request.url.port or 80}"


def from_here(headers: Headers) -> bool:
    """True if a request that changes something was not made by the page of another site."""
    origin = headers.get("origin")
    if headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
        return False
    try:
        return origin is None or urlsplit(origin).netloc.lower() == headers.get("host", "").lower()
    except ValueError:  # not an address
        return False


def refused(request: Request, code: int, why: str) -> Response:
    """An answer with one sentence: JSON for programs, a page for people, with a form where a token is required."""
    if request.url.path.startswith("/api/") or request.method not in ("GET", "HEAD", "POST") or code == 413:
        return JSONResponse({"error": why}, code)
    from rotorwatch.serve.pages import message

    return HTMLResponse(message(why, code == 401), code)
