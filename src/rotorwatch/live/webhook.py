"""Alerts posted to a web address, as they come, by a thread of its own: what is slow or unreachable there never holds up the judging.

The standard library's client: an alert is one POST a few times a minute, and what matters here - a queue with an end, growing pauses - a
library would not bring.
"""

from __future__ import annotations

import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from collections import deque
from collections.abc import Callable

from rotorwatch.base.files import public
from rotorwatch.errors import ConfigError
from rotorwatch.live.guard import as_json

MOST = 1000  # alerts that wait; beyond, the oldest go
TIMEOUT_S = 10.0
FIRST_S, LONGEST_S = 1.0, 60.0  # pauses between attempts: doubled each time
AGAIN = (408, 425, 429)  # answers of the kind "you are wrong" that mean "later"
LAST_S = 5.0  # at the end for what has not been sent


def checked(url: str) -> str:
    """Whom an address is of, with nothing that only its owner may know. Raises ConfigError for what is no address."""
    try:
        where = urllib.parse.urlsplit(url)
        host = (where.hostname or "").encode("idna").decode()
        name = f"{where.scheme}://{host}" + (f":{where.port}" if where.port else "")
    except ValueError:
        host = name = ""
    if not host or not name.startswith(("http://", "https://")):
        raise ConfigError(f"--webhook {public(url)}: give an address that begins with http:// or https://.")
    return name


class _Here(urllib.request.HTTPRedirectHandler):
    """A redirection would make a GET of a POST: it is an answer like any other."""

    def redirect_request(self, req, fp, code, msg, headers, newurl):
        return None


class Webhook:
    """POST of each alert as JSON to `url`. notify: called by `step` with a sentence when it begins to fail, and when it works again.

    sent, refused, dropped: alerts that were taken by the other side, that it refused for good, and that gave way to newer ones."""

    def __init__(self, url: str, notify: Callable[[str], None] = lambda text: None, pause_s: float = FIRST_S):
        """Raises ConfigError for what is no address."""
        self.name = checked(url)
        self._url, self._notify, self._pause_s = url, notify, pause_s
        self.sent = self.refused = self.dropped = 0
        self._queue: deque[bytes] = deque()
        self._change = threading.Condition()
        self._notices: deque[str] = deque(maxlen=100)
        self._ends: float | None = None
        self._open = urllib.request.build_opener(_Here)
        self._start()

    def _start(self) -> None:
        self._thread = threading.Thread(target=self._work, name="webhook", daemon=True)
        self._thread.start()

    def take(self, alert: dict) -> None:
        """One alert more; returns at once."""
        with self._change:
            if len(self._queue) >= MOST:
                self._queue.popleft()
                self.dropped += 1
            self._queue.append(as_json(alert).encode())
            self._change.notify()

    def step(self, sources=()) -> None:
        """Report what has happened; called by the loop, so that one thread reports it all."""
        if self._ends is None and not self._thread.is_alive():
            self._start()
            self._notices.append(
                f"{self.name}: sending alerts stopped after an internal error and restarts; please report it"
            )
        while self._notices:
            self._notify(self._notices.popleft())

    def leave(self) -> None:
        """Send what waits, for LAST_S at most."""
        with self._change:
            self._ends = time.monotonic() + LAST_S
            self._change.notify()
        self._thread.join(LAST_S + 1.0)
        with self._change:
            left = len(self._queue)
        if left:
            self._notices.append(
                f"{self.name}: {left} alert{'s' if left > 1 else ''} could not be sent before shutdown"
            )
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
                    if self.dropped == dropped:  # else this one has gone already
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
        """Why it could not be sent, to be tried again; empty when it was, or was refused for good."""
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
                    self._notices.append(
                        f"{self.name} refuses alerts ({code} {reason}); check the address of --webhook"
                    )
                return ""
            return f"{code} {reason}"
        except Exception as why:  # whatever a network does
            reason = getattr(why, "reason", None) or why
            return " ".join(str(getattr(reason, "strerror", None) or reason).split())[:120] or type(why).__name__
