"""Work that never ends, wants all memory, dies, or finds the disk full: for tests of guards. Light to load in a new process."""

import errno
import os
import time
from pathlib import Path


def endless(what):
    while True:
        time.sleep(0.01)


def greedy(what):
    return bytearray(3 << 30)


def while_full(what):
    """Assesses at once, but for a page that cannot be written while there is a file `full` in its folder."""
    from rotorwatch.fleet.store import Entry

    log, page = what
    if (Path(page).parent / "full").exists():
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), page)
    return Entry(log.digest, "", log.name, log.size)


def dies_once(what):
    """The process is gone the first time that a page of that name is asked for."""
    from rotorwatch.fleet.store import Entry

    log, page = what
    if not Path(page).exists():
        Path(page).touch()
        os._exit(1)
    return Entry(log.digest, "", log.name, log.size)
