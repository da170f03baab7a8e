"""Endpoints for MAVLink: UDP, TCP, a serial port. Each receives bytes with the peer that sent them, and sends bytes."""

from __future__ import annotations

import os
import select
import socket
import time
from typing import Any

from rotorwatch.errors import LinkError

AGAIN_S = 1.0  # between two attempts to connect again
MOST = 65536
# Most recent addresses that get answers, and how long after their last packet they get broadcasts, so that nobody can be flooded.
ANSWERED, ANSWERED_S = 64, 10.0
KINDS = "udp:PORT, udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD"


def is_endpoint(text: str) -> bool:
    """True if a text names an endpoint, not a file."""
    return text.split(":", 1)[0].lower() in ("udp", "udpin", "udpout", "tcp", "serial") and ":" in text


def open_endpoint(text: str) -> Endpoint:
    """The endpoint that a text names. Raises LinkError with one sentence."""
    kind, _, rest = text.partition(":")
    kind, (where, _, number) = kind.lower(), rest.rpartition(":")
    if kind == "serial":
        if not where or not number.isdigit():
            raise LinkError(f"{text}: name the device and its speed, as in serial:/dev/ttyUSB0:57600.")
        return Serial(text, where, int(number))
    if not number.isdigit() or not 0 < int(number) < 65536:
        raise LinkError(f"{text}: not an endpoint; give {KINDS}.")
    if kind == "tcp":
        return Tcp(text, where or "127.0.0.1", int(number))
    return Udp(text, where, int(number), listens=kind != "udpout")


class Endpoint:
    """An endpoint. name: as given by the user. open: whether it can receive."""

    slow = False  # low bandwidth: request little

    def __init__(self, name: str):
        self.name, self.open, self._tried = name, False, -AGAIN_S

    def fileno(self) -> int:
        """For `select`."""
        raise NotImplementedError

    def receive(self, wait_s: float = 0.0) -> list[tuple[Any, bytes]]:
        """(peer, bytes) of everything received; waits up to wait_s."""
        if not self.open:
            time.sleep(wait_s)
            return []
        return self._read() if select.select([self], [], [], wait_s)[0] else []

    def _read(self) -> list[tuple[Any, bytes]]:
        raise NotImplementedError

    def send(self, data: bytes, peer: Any = None) -> None:
        """Send to one peer, or to all known ones. Failures are ignored, like losses on any link."""
        raise NotImplementedError

    def answers(self, peer: Any) -> None:
        """Mark a peer as a MAVLink sender, which may be sent to."""

    def close(self) -> None:
        self.open = False

    def again(self) -> None:
        """Try to reopen it after the other side closed it."""


class Udp(Endpoint):
    def __init__(self, name: str, host: str, port: int, listens: bool):
        super().__init__(name)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._peers: dict[Any, float] = {}
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 21)
            if listens:
                self._socket.bind((host, port))
            else:
                self._socket.connect((host, port))
                self._peers[None] = 0.0
        except (OSError, UnicodeError) as why:
            self._socket.close()
            reason = getattr(why, "strerror", None) or why
            raise LinkError(f"{name} cannot be opened ({reason}); is another program using this port?") from why
        self.open = True

    def fileno(self) -> int:
        return self._socket.fileno()

    def _read(self) -> list[tuple[Any, bytes]]:
        packets = []
        for _ in range(500):
            try:
                data, peer = self._socket.recvfrom(MOST)
            except (BlockingIOError, InterruptedError):
                break
            except OSError:  # port unreachable: nothing listens on the other side
                continue
            packets.append((peer, data))
        return packets

    def answers(self, peer: Any) -> None:
        if None not in self._peers:
            self._peers.pop(peer, None)
            self._peers[peer] = time.monotonic()
            if len(self._peers) > ANSWERED:
                del self._peers[next(iter(self._peers))]

    def send(self, data: bytes, peer: Any = None) -> None:
        for to in list(self._peers) if peer is None or None in self._peers else [peer]:
            try:
                if to is None:
                    self._socket.send(data)
                elif to in self._peers and (peer is not None or self._peers[to] > time.monotonic() - ANSWERED_S):
                    self._socket.sendto(data, to)
            except OSError:
                pass

    def close(self) -> None:
        super().close()
        self._socket.close()


class Stream(Endpoint):
    """A connected endpoint with a single peer, reconnected when lost."""

    def _connect(self, wait_s: float) -> None:
        """Connect, waiting up to wait_s. Raises OSError."""
        raise NotImplementedError

    def _received(self) -> tuple[Any, bytes]:
        """The peer and the received bytes: none when it has disconnected."""
        raise NotImplementedError

    def _read(self) -> list[tuple[Any, bytes]]:
        if self.fileno() < 0:
            return []
        try:
            peer, data = self._received()
        except (BlockingIOError, InterruptedError):
            return []
        except OSError:
            peer, data = None, b""
        if not data:
            self.close()
            return []
        return [(peer, data)]

    def again(self) -> None:
        if self.open or time.monotonic() - self._tried < AGAIN_S:
            return
        self._tried = time.monotonic()
        try:
            self._connect(0.05)
        except OSError:
            pass


class Tcp(Stream):
    def __init__(self, name: str, host: str, port: int):
        super().__init__(name)
        self._address, self._socket = (host, port), None
        try:
            self._connect(5.0)
        except (OSError, UnicodeError) as why:
            reason = getattr(why, "strerror", None) or why
            raise LinkError(f"{name} cannot be reached ({reason}); is the other side listening?") from why

    def _connect(self, wait_s: float) -> None:
        self._socket = socket.create_connection(self._address, wait_s)
        self._socket.setblocking(False)
        self.open = True

    def fileno(self) -> int:
        return -1 if self._socket is None else self._socket.fileno()

    def _received(self) -> tuple[Any, bytes]:
        assert self._socket is not None
        return self._address, self._socket.recv(MOST)

    def send(self, data: bytes, peer: Any = None) -> None:
        if self._socket is not None:
            try:
                self._socket.send(data)
            except OSError:
                pass

    def close(self) -> None:
        super().close()
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class Serial(Stream):
    slow = True

    def __init__(self, name: str, device: str, baud: int):
        super().__init__(name)
        self._device, self._baud, self._file = device, baud, -1
        try:
            self._connect(0.0)
        except FileNotFoundError:
            raise LinkError(f"{device}: no such device; is it plugged in?") from None
        except PermissionError:
            raise LinkError(f"{device}: permission denied; join the group that owns it (often dialout) and log in again.") from None
        except OSError as why:
            raise LinkError(f"{device} cannot be opened as a serial port ({why.strerror or why}).") from why

    def _connect(self, wait_s: float) -> None:
        try:
            import termios
            import tty
        except ImportError:
            raise LinkError("Serial ports can be watched on Linux and macOS only; forward the link to UDP and give udp:PORT.") from None
        speed = getattr(termios, f"B{self._baud}", None)
        if speed is None:
            raise LinkError(f"{self.name}: {self._baud} is not a baud rate of this computer's serial ports; 57600 and 115200 are usual.")
        file = os.open(self._device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            tty.setraw(file)
            mode = termios.tcgetattr(file)
            mode[2] |= termios.CLOCAL | termios.CREAD
            mode[4] = mode[5] = speed
            termios.tcsetattr(file, termios.TCSANOW, mode)
        except (termios.error, OSError) as why:
            os.close(file)
            raise OSError(0, "it is not a terminal device") from why
        self._file, self.open = file, True

    def fileno(self) -> int:
        return self._file

    def _received(self) -> tuple[Any, bytes]:
        return self._device, os.read(self._file, MOST)

    def send(self, data: bytes, peer: Any = None) -> None:
        try:
            os.write(self._file, data)
        except OSError:
            pass

    def close(self) -> None:
        super().close()
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
