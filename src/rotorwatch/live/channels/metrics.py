"""The state of each vehicle, for Prometheus: https://prometheus.io/docs/instrumenting/exposition_formats/

The loop stores a snapshot of all vehicles once a second; a scrape, in a thread of its own, only reads the last one.
"""

from __future__ import annotations

import threading
import time
from collections import Counter as Count
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from rotorwatch.base.optional import library
from rotorwatch.errors import ConfigError
from rotorwatch.live.channels import Option

if TYPE_CHECKING:
    from rotorwatch.live.snapshot import Snapshot
    from rotorwatch.live.watch import Source

EVERY_S = 1.0
CONNECTIONS, ASKS_S = 32, 10.0  # at once, the oldest is closed for a new one; between two bytes of a request
STATES = ("LOST", "FAULT", "MAYBE", "OK", "GROUND", "BLIND", "SILENT", "ERROR")


OPTION = Option("--metrics", "Metrics for Prometheus, at http://HOST:PORT/metrics.", "[HOST:]PORT")


def opened(value: str, notify: Callable[[str], None]) -> Metrics:
    """The page. Raises ConfigError."""
    return Metrics(value)


class Metrics:
    """A page of metrics at http://HOST:PORT/metrics."""

    def __init__(self, where: str):
        """where: [HOST:]PORT; without a host only this computer can read it. Raises ConfigError."""
        host, _, number = where.rpartition(":")
        if not number.isdigit() or int(number) > 65535:
            raise ConfigError(f"--metrics {where}: give a port, or HOST:PORT, as in 9110 or 0.0.0.0:9110.")
        host, port = host.strip("[]") or "127.0.0.1", int(number)
        prometheus = library("prometheus_client", "--metrics")
        registry = prometheus.CollectorRegistry()
        registry.register(self)
        self._snapshots: tuple[Snapshot, ...] = ()
        self._taken = 0.0
        try:
            self._server = _server(host, port, prometheus.make_wsgi_app(registry))
        except (OSError, UnicodeError) as why:
            reason = getattr(why, "strerror", None) or why
            raise ConfigError(f"--metrics {where} cannot be opened ({reason}); is another program using this port?") from why
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()
        self.port: int = self._server.server_port

    def take(self, alert: dict) -> None:
        """Alerts are not counted here, but by the valid events."""

    def step(self, sources: Sequence[Source]) -> None:
        """Store a snapshot of all vehicles, when due."""
        from rotorwatch.live import snapshot

        now = time.monotonic()
        if now - self._taken >= EVERY_S:
            self._taken = now
            self._snapshots = tuple(snapshot.taken(*pair) for source in sources for pair in source.shown())

    def leave(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(2.0)

    def describe(self) -> list[Any]:
        """An empty list: registration collects nothing."""
        return []

    def collect(self) -> Iterator[Any]:
        """The metrics of the last snapshot."""
        from prometheus_client.core import CounterMetricFamily as Counter
        from prometheus_client.core import GaugeMetricFamily as Gauge

        now, snapshots, by_name = time.monotonic(), self._snapshots, ["vehicle"]
        state = Gauge("rotorwatch_state", "1 for the state a vehicle is in, 0 for the others.", labels=["vehicle", "state"])
        columns = [
            Gauge(f"rotorwatch_rotor_loss{part}", text, labels=["vehicle", "rotor"])
            for part, text in (
                ("", "Share of a rotor's effectiveness that is lost."),
                ("_lower", "Lower end of the 95 % interval of the loss."),
                ("_upper", "Upper end of the 95 % interval of the loss."),
            )
        ]
        events = Gauge("rotorwatch_events", "Active events.", labels=["vehicle", "kind"])
        ticks = Counter("rotorwatch_ticks_assessed", "Assessed ticks.", labels=by_name)
        taken = Counter("rotorwatch_messages", "Received messages.", labels=by_name)
        lost = Counter("rotorwatch_messages_lost", "Messages missing by their sequence numbers.", labels=by_name)
        share = Gauge("rotorwatch_link_loss", "Share of the messages that were lost on the link.", labels=by_name)
        age = Gauge("rotorwatch_message_age_seconds", "Time since the last message.", labels=by_name)
        for one in snapshots:
            for name in STATES:
                state.add_metric([one.name, name], float(one.state == name))
            for number, bounds in enumerate(one.rotors, 1):
                for column, value in zip(columns, bounds):
                    column.add_metric([one.name, str(number)], value)
            for kind, count in Count(event.kind for event in one.events).items():
                events.add_metric([one.name, kind], count)
            ticks.add_metric([one.name], one.ticks)
            taken.add_metric([one.name], one.taken)
            lost.add_metric([one.name], one.lost)
            share.add_metric([one.name], one.lost / max(one.lost + one.taken, 1))
            age.add_metric([one.name], max(now - one.last_frame, 0.0))
        yield from (state, *columns, events, ticks, taken, lost, share, age)


def _server(host: str, port: int, page: Any) -> Any:
    """A threaded server of a WSGI application, with a limit on idle connections. Raises OSError, UnicodeError."""
    import socket
    from socketserver import ThreadingMixIn
    from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

    class Handler(WSGIRequestHandler):
        timeout = ASKS_S

        def log_message(self, format: str, *args: Any) -> None:
            """Keep standard error for the watch."""

    class Server(ThreadingMixIn, WSGIServer):
        daemon_threads = True
        request_queue_size = 128  # backlog: with 5, some connections waited for seconds
        address_family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]

        def __init__(self) -> None:
            self._open: dict[socket.socket, None] = {}
            self._lock = threading.Lock()
            super().__init__((host, port), Handler)

        def process_request(self, request: Any, client_address: Any) -> None:
            with self._lock:
                self._open[request] = None
                if len(self._open) > CONNECTIONS:
                    with suppress(OSError):  # ends its thread
                        oldest = next(iter(self._open))
                        del self._open[oldest]
                        oldest.shutdown(socket.SHUT_RDWR)
            super().process_request(request, client_address)

        def shutdown_request(self, request: Any) -> None:
            with self._lock:
                self._open.pop(request, None)
            super().shutdown_request(request)

        def handle_error(self, request: Any, client_address: Any) -> None:
            """Ignore broken connections."""

    server = Server()
    server.set_app(page)
    return server
