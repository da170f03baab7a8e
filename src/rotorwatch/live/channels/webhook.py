"""Alerts posted to a web address by a thread of its own: a slow or unreachable server never delays the evaluation.

Uses the standard library's client: an alert is one POST a few times a minute, and a library would not provide the bounded queue and the
growing pauses.
"""

from __future__ import annotations

import threading
import time
import urllib.parse
from collections import deque
from collections.abc import Callable
from typing import Any

from rotorwatch.base.files import public
from rotorwatch.errors import ConfigError
from rotorwatch.live.channels import Option
from rotorwatch.live.guard import as_json

OPTION = Option("--webhook", "POST every alert as JSON to this address.", "URL", "ROTORWATCH_WEBHOOK")
MOST = 1000  # waiting alerts; beyond, the oldest are dropped
TIMEOUT_S = 10.0
FIRST_S, LONGEST_S = 1.0, 60.0  # pauses between attempts, doubled each time
AGAIN = (408, 425, 429)  # client errors that mean "later"
LAST_S = 5.0  # at the end, for unsent alerts


def opened(value: str, notify: Callable[[str], None]) -> Webhook:
    """The sender. Raises ConfigError."""
    return Webhook(value, notify)


def checked(url: str) -> str:
    """The host of an address, without private parts, for display. Raises ConfigError for an invalid address."""
    try:
        where = urllib.parse.urlsplit(url)
        host = (where.hostname or "").encode("idna").decode()
        name = f"{where.scheme}://{host}" + (f":{where.port}" if where.port else "")
    except ValueError:
        host = name = ""
    if not host or not name.startswith(("http://", "https://")):
        raise ConfigError(f"--webhook {public(url)}: give an address that begins with http:// or https://.")
    return name


def _client() -> Any:
    """A client that follows no redirection, which would turn a POST into a GET: it is an answer like any other."""
    import urllib.request

    class Here(urllib.request.HTTPRedirectHandler):
        def redirect_request(self, req, fp, code, msg, headers, newurl):
            return None

    return urllib.request.build_opener(Here)


class Webhook:
    """POST of each alert as JSON to `url`. notify: called by `step` with a sentence when it begins to fail, and when it works again.

    sent, refused, dropped: alerts accepted by the other side, refused for good, and dropped for newer ones."""

    def __init__(self, url: str, notify: Callable[[str], None] = lambda text: None, pause_s: float = FIRST_S):
        """Raises ConfigError for an invalid address."""
        self.name = checked(url)
        self._url, self._notify, self._pause_s = url, notify, pause_s
        self.sent = self.refused = self.dropped = 0
        self._queue: deque[bytes] = deque()
        self._change = threading.Condition()
        self._notices: deque[str] = deque(maxlen=100)
        self._ends: float | None = None
        self._open = _client()
        self._start()

    def _start(self) -> None:
        self._thread = threading.Thread(target=self._work, name="webhook", daemon=True)
        self._thread.start()

    def take(self, alert: dict) -> None:
        """Queue an alert without blocking."""
        with self._change:
            if len(self._queue) >= MOST:
                self._queue.popleft()
                self.dropped += 1
            self._queue.append(as_json(alert).encode())
            self._change.notify()

    def step(self, sources=()) -> None:
        """Report changes; called by the loop, so that one thread does all reporting."""
        if self._ends is None and not self._thread.is_alive():
            self._start()
            self._notices.append(f"{self.name}: sending alerts stopped after an internal error and restarts; please report it")
        while self._notices:
            self._notify(self._notices.popleft())

    def leave(self) -> None:
        """Send waiting alerts, for up to LAST_S."""
        with self._change:
            self._ends = time.monotonic() + LAST_S
            self._change.notify()
        self._thread.join(LAST_S + 1.0)
        with self._change:
            left = len(self._queue)
        if left:
            self._notices.append(f"{self.name}: {left} alert{'s' if left > 1 else ''} could not be sent before shutdown")
        self.step()

    def _work(self) -> None:
        pause, failing = self._pause_s, False
        while True:
            with self._change:
                while not self._queue and self._ends is None:
                    self._change.wait()
                if not self._queue or (self._ends is not None and time.monotonic() > self._ends):
                    return
                body, dropped = self._queue[0], self.dropped
            why = self._post(body)
            with self._change:
                if not why:
                    if failing:
                        self._notices.append(f"{self.name} accepts alerts again")
                    failing, pause = False, self._pause_s
                    if self.dropped == dropped:  # else this one was dropped already
                        self._queue.popleft()
                    continue
                if not failing:
                    failing = True
                    self._notices.append(f"{self.name} does not accept alerts ({why}); they are queued and sent again")
                self._change.wait_for(self._ended, min(pause, self._left()))
                pause = min(2.0 * pause, LONGEST_S)

    def _ended(self) -> bool:
        return self._ends is not None and time.monotonic() > self._ends

    def _left(self) -> float:
        return LONGEST_S if self._ends is None else max(self._ends - time.monotonic(), 0.0)

    def _post(self, body: bytes) -> str:
        """The reason why it could not be sent, for a retry; empty when it was, or was refused for good."""
        import urllib.error
        import urllib.request

        headers = {"Content-Type": "application/json", "User-Agent": "rotorwatch"}
        try:
            request = urllib.request.Request(self._url, body, headers, method="POST")
            with self._open.open(request, timeout=min(TIMEOUT_S, max(self._left(), 0.1))) as answer:
                answer.read(1024)
            self.sent += 1
            return ""
        except urllib.error.HTTPError as why:
            code, reason = why.code, why.reason
            why.close()
            if 300 <= code < 500 and code not in AGAIN:
                self.refused += 1
                if self.refused == 1:
                    self._notices.append(f"{self.name} refuses alerts ({code} {reason}); check the address of --webhook")
                return ""
            return f"{code} {reason}"
        except Exception as why:  # any network error
            reason = getattr(why, "reason", None) or why
            return " ".join(str(getattr(reason, "strerror", None) or reason).split())[:120] or type(why).__name__
