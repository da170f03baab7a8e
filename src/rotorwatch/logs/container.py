"""Opening a log file: plain files are mapped into memory, .xz, .gz and .bz2 are decompressed, recognised by content."""

from __future__ import annotations

import bz2
import lzma
import mmap
import zlib
from pathlib import Path

from rotorwatch.base import incoming
from rotorwatch.errors import LogError

SLACK, SHRINKS = 256 << 20, 16
"""Logs shrink to a third to a sixth; what decompresses to more than so many bytes, and so many times its size, is made to fill memory."""
_CHUNK, _HEAD = 1 << 20, 1 << 16
_MAGIC = {
    b"\xfd7zXZ\x00": (".xz", lambda: lzma.LZMADecompressor(memlimit=SLACK)),
    b"\x1f\x8b": (".gz", lambda: _Gzip()),
    b"BZh": (".bz2", bz2.BZ2Decompressor),
}
_REFUSED = {b"\x28\xb5\x2f\xfd": ("zstd", "unzstd"), b"PK\x03\x04": ("zip", "unzip"), b"7z\xbc\xaf\x27\x1c": ("7-zip", "7z x")}
PACKED = tuple(suffix for suffix, _ in _MAGIC.values())
REFUSED = (".zst", ".zip", ".7z")
"""Endings of names: of what is unpacked here, and of what is not."""


class _Gzip:
    """zlib's decompressor with the interface of the other two."""

    def __init__(self):
        self._inner, self._rest = zlib.decompressobj(31), b""

    def decompress(self, data, max_length):
        out = self._inner.decompress(self._rest + data, max_length)
        self._rest = self._inner.unconsumed_tail
        return out

    eof = property(lambda self: self._inner.eof)
    unused_data = property(lambda self: self._inner.unused_data)
    needs_input = property(lambda self: not self._rest)


def ordinary(path: Path) -> None:
    """Raise LogError for a pipe, a socket or a device, whose opening may block for ever; OSError where nothing is."""
    if not path.is_file() and not path.is_dir() and path.stat():
        raise LogError(f"{path}: is a pipe, a socket or a device, not a file; give a flight log")


def open_log(path: Path, progress=None, limit: int = incoming.MOST):
    """The content of a log file: (bytes-like data, name without the compression suffix, list of warnings).

    A truncated or damaged compressed stream gives its readable part and a warning.
    Raises LogError when the file is missing, unreadable, empty, or holds, unpacked or as it is, more than `limit` bytes."""
    try:
        ordinary(path)
        with path.open("rb") as file:
            size = path.stat().st_size
            if size == 0:
                raise LogError(f"{path}: the file is empty; copy the log from the vehicle again")
            if size > limit:
                raise LogError(f"{path}: holds more than {limit >> 20} MB, which no flight log does")
            head = file.read(16)
            for magic, (kind, tool) in _REFUSED.items():
                if head.startswith(magic):
                    raise LogError(f"{path}: {kind} archives are not supported; unpack it first, for instance with '{tool}'")
            for magic, (suffix, decoder) in _MAGIC.items():
                if head.startswith(magic):
                    file.seek(0)
                    data, warnings = _unfold(file, size, decoder, path, progress, limit)
                    name = path.name[: -len(suffix)] if path.name.lower().endswith(suffix) else path.name
                    return data, name, warnings
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ), path.name, []
    except FileNotFoundError:
        raise LogError(f"{path}: no such file or folder") from None
    except (OSError, ValueError) as error:
        raise LogError(f"{path}: cannot be opened ({error})") from None


def most(size: int, limit: int = incoming.MOST) -> int:
    """Limit in bytes of the unpacked content of a file of `size` bytes, for any compression; never more than `limit`."""
    return min(limit, SLACK + SHRINKS * size)


def too_much(limit: int, where: str = "") -> LogError:
    """The error of a log that decompresses to more than `limit` bytes."""
    return LogError(f"{where}decompresses to more than {limit >> 20} MB, which no flight log does")


def head(path: Path, count: int) -> tuple[bytes, str]:
    """The first `count` unpacked bytes of a log file, and its name without the compression suffix; no bytes where it cannot be opened or
    unpacked, and of a pipe."""
    try:
        if not path.is_file():
            return b"", path.name
        with path.open("rb") as file:
            data = file.read(_HEAD)
        for magic, (suffix, decoder) in _MAGIC.items():
            if data.startswith(magic):
                name = path.name[: -len(suffix)] if path.name.lower().endswith(suffix) else path.name
                return decoder().decompress(data, count), name
    except (OSError, ValueError, EOFError, lzma.LZMAError, zlib.error):
        return b"", path.name
    return data[:count], path.name


def _unfold(file, size, decoder, path, progress, limit):
    """Decompress stream after stream. Returns (bytes, warnings)."""
    limit = most(size, limit)
    pieces, total, warnings = [], 0, []
    stream, data = decoder(), file.read(_CHUNK)
    try:
        while True:
            piece = stream.decompress(data, _CHUNK)
            pieces.append(piece)
            total += len(piece)
            if total > limit:
                raise too_much(limit, f"{path}: ")
            if stream.eof:
                data = stream.unused_data.lstrip(b"\0") or file.read(_CHUNK)
                if not data:
                    break
                stream = decoder()
            else:
                data = file.read(_CHUNK) if stream.needs_input else b""
                if not data and stream.needs_input:
                    raise EOFError
            if progress:
                progress(0.5 * file.tell() / size)
    except EOFError:
        warnings.append(f"the compressed file ends early; {total} bytes of it could be read")
    except (lzma.LZMAError, zlib.error, OSError) as error:
        warnings.append(f"the compressed file is damaged ({error}); {total} bytes of it could be read")
    if total == 0:
        raise LogError(f"{path}: nothing could be decompressed; copy the log from the vehicle again")
    return b"".join(pieces), warnings
