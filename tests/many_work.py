"""Work for tests of many processes: it succeeds, fails, dies or is slow, as asked. Light to load in a new process."""

import os
import signal
import time
import warnings
from pathlib import Path

from rotorwatch.errors import FirstUse, LogError


class Unfriendly(Exception):
    """Cannot be packed: it is made of more than its text."""

    def __init__(self, a, b):
        super().__init__(f"{a} and {b}")


def work(item):
    """What an item asks for; notes in a file that it was begun."""
    folder, what, number = item
    with open(Path(folder) / "begun.txt", "a") as file:
        file.write(f"{number}\n")
    if what == "error":
        raise LogError(f"{number}: no log")
    if what == "unfriendly":
        raise Unfriendly(number, "more")
    if what == "die once" and not (once := Path(folder) / f"died-{number}").exists():
        once.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "die":
        os._exit(7)
    if what == "slow":
        time.sleep(0.1)
    return lambda: None if what == "unpackable" else number


def number(item):
    return work(item)() if item[1] != "unpackable" else work(item)


def building(item):
    warnings.warn("Building something.", FirstUse, stacklevel=1)
    warnings.warn("Noise.", RuntimeWarning, stacklevel=1)
