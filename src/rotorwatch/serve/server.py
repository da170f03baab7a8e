"""The server: everything is opened and checked before the first page is served."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import threading
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rotorwatch.base import checks, optional
from rotorwatch.errors import ConfigError, LinkError

GIVE_UP_S = 2  # for open connections when the server is stopped


def serve(
    endpoints: Sequence[str] = (),
    host: str = "127.0.0.1",
    port: int = 8000,
    token: str | None = None,
    store: str | os.PathLike | None = None,
    max_upload: float = 512.0,
    speed: float = 1.0,
    vehicle: Any = None,
    record: str | os.PathLike | None = None,
    listen_only: bool = False,
    max_seconds: float = 120.0,
    max_memory: int = 4000,
    jobs: int = 1,
    allow_delete: bool = False,
    ready: Callable[[str], None] | None = None,
) -> None:
    """Serve the page until interrupted: vehicles at `endpoints` while they fly, uploaded logs, and the list of flights.

    endpoints: those of `rotorwatch watch`, or recorded logs. speed: of replayed logs, relative to real time. host: to listen on; any but a
    loopback address needs a token. token: 16 letters or more; default: the environment variable ROTORWATCH_TOKEN. port: 0 for any that is
    free. store: of the fleet, a SQLite file or a URL. max_upload [MB], max_seconds [s], max_memory [MB]: limits of each uploaded log; jobs:
    logs assessed at once. allow_delete: whether users of the page may delete flights. vehicle: a Vehicle, or a vehicle file, of all that
    are watched; record: folder to record links in; listen_only: nothing is sent to vehicles. ready: called with the page's address once it
    can be opened; every RotorwatchError is raised before that."""
    for name in ("starlette", "uvicorn"):
        optional.library(name, "The page")
    from rotorwatch.serve import security
    from rotorwatch.serve.app import application
    from rotorwatch.serve.flights import Flights
    from rotorwatch.serve.live import Feed
    from rotorwatch.serve.uploads import Limits
    from rotorwatch.witnesses.healthy.baselines import vehicle_of

    checked_token = security.checked(host, os.environ.get("ROTORWATCH_TOKEN", "") if token is None else token)
    most = int(checks.positive("max_upload", max_upload) * 2**20)
    assess_s, memory_mb = checks.positive("max_seconds", max_seconds), checks.positive("max_memory", max_memory)
    limits = Limits(most, assess_s, memory_mb, max(int(jobs), 1))
    listening = listen(host, port)
    feed = Feed()
    try:
        flights = Flights(None if store is None else os.fspath(store))
        craft = vehicle_of(vehicle)
        for endpoint in endpoints:
            feed.open(os.fspath(endpoint), craft, speed, None if record is None else Path(record), listen_only)
        # When listening on all addresses, the page's address has this computer's name.
        name = socket.gethostname() if host in ("0.0.0.0", "::", "") else f"[{host}]" if ":" in host else host
        address = f"http://{name}:{listening.getsockname()[1]}/"
        app = application(feed, flights, limits, host, checked_token, allow_delete)
        server = http_server(app, lambda: ready(address) if ready else None, feed.hub.close)
        asyncio.run(server.serve([listening]))
        if not server.started:
            raise ConfigError("The server did not start; run it with --debug to see why.")
        flights.close()
        if feed.failed:
            raise LinkError(feed.failed)
    finally:
        feed.stop()
        listening.close()


def listen(host: str, port: int) -> socket.socket:
    """A listening socket. Raises ConfigError with a sentence, as for a port in use."""
    try:
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        family, kind, proto, _, address = addresses[0]
    except (OSError, UnicodeError) as why:
        reason = getattr(why, "strerror", None) or why
        raise ConfigError(f"--host {host}: not an address of this computer ({reason}).") from None
    sock = socket.socket(family, kind, proto)
    try:
        if os.name == "posix":
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind(address)
        sock.listen(128)
    except (OSError, OverflowError) as why:
        sock.close()
        import errno

        reason = getattr(why, "errno", None)
        known = {
            errno.EADDRINUSE: "another program uses this port; stop it, or give another port (0: any)",
            errno.EACCES: "ports below 1024 are the system's; give a higher one, such as 8000",
        }
        if reason in known:
            raise ConfigError(f"--port {port}: {known[reason]}.") from None
        text = getattr(why, "strerror", None) or why
        raise ConfigError(f"--host {host} --port {port}: cannot listen there ({text}).") from None
    return sock


def http_server(app: Any, ready: Callable[[], None], stopping: Callable[[], None] = lambda: None) -> Any:
    """A server of an ASGI application, with the limits of connections.py. ready: called when it serves; stopping: when a signal ends it."""
    import uvicorn

    from rotorwatch.serve.connections import Connection

    class Server(uvicorn.Server):
        """uvicorn's server with callbacks when it is ready and when it is stopped."""

        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets)
            if self.started:
                ready()

        @contextmanager
        def capture_signals(self):
            """A signal is the normal end: it is not raised again afterwards."""
            if threading.current_thread() is not threading.main_thread():
                yield
                return
            before = {sig: signal.signal(sig, self.handle_exit) for sig in (signal.SIGINT, signal.SIGTERM)}
            try:
                yield
            finally:
                for sig, handler in before.items():
                    signal.signal(sig, handler)

        def handle_exit(self, sig: int, frame: Any) -> None:
            stopping()
            super().handle_exit(sig, frame)

    config = uvicorn.Config(
        app, log_level="critical", access_log=False, server_header=False, proxy_headers=False, ws="none", http=Connection,
        lifespan="on", timeout_graceful_shutdown=GIVE_UP_S,
    )  # fmt: skip
    return Server(config)
