"""Access control over HTTP: programs on this computer with the token, and no web page."""

from __future__ import annotations

import hmac
from urllib.parse import urlsplit

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Receive, Scope, Send

from rotorwatch.errors import ConfigError
from rotorwatch.serve import security


def checked(host: str, token: str) -> str:
    """The token, if it is sufficient and the address is this computer's own. Raises ConfigError."""
    if not security.loopback(host):
        raise ConfigError(f"--host {host}: other computers can reach this address; give a loopback address such as 127.0.0.1.")
    if not token:
        raise ConfigError(
            "Over HTTP a token is required: set the environment variable ROTORWATCH_TOKEN, such as the output of `openssl rand -hex 16`."
        )
    return security.checked(host, token)


class Access:
    """Middleware around the whole application. token: required of every request."""

    def __init__(self, app: ASGIApp, token: str):
        self._app, self._token = app, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        refusal = self._refusal(Request(scope, receive)) if scope["type"] == "http" else None
        await (refusal or self._app)(scope, receive, send)

    def _refusal(self, request: Request) -> Response | None:
        """The answer to a refused request, or None for one with access."""
        headers = request.headers
        if len(headers.getlist("host")) != 1 or not _is_local(headers["host"]):
            return _refused(421, "This is not the server's address; use the one it printed.")
        if not security.from_here(headers):
            return _refused(403, "This request came from another site.")
        kind, _, token = headers.get("authorization", "").partition(" ")
        given = token.strip().encode("utf-8", "replace")
        if kind.lower() != "bearer" or not hmac.compare_digest(given, self._token.encode()):
            answer = _refused(401, security.WRONG if kind else security.NEEDED)
            answer.headers["WWW-Authenticate"] = "Bearer"
            return answer
        return None


def _is_local(host: str) -> bool:
    """True if a Host header names this computer alone: any other name points here by a foreign name server (DNS rebinding)."""
    try:
        parts = urlsplit(f"//{host}")
        return parts.username is None and security.loopback(parts.hostname or "") and (parts.port or 1) > 0
    except ValueError:
        return False


def _refused(code: int, why: str) -> Response:
    return JSONResponse({"error": why}, code)
