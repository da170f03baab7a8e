"""Work that never ends, and work that wants all memory: for tests of what guards against both. Light to load in a new process."""

import time


def endless(what):
    while True:
        time.sleep(0.01)


def greedy(what):
    return bytearray(3 << 30)
