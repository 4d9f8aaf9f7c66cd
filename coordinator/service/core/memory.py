"""What the process does about memory, where it is all the service's own."""

import ctypes
import gc
from typing import Final

_TRIM_THRESHOLD: Final = -1
_MMAP_THRESHOLD: Final = -3
_ARENA_MAX: Final = -8
"""Parameters of glibc's mallopt(3)."""
LARGE_BYTES: Final = 128 << 10
"""What is this large has memory of its own, which goes back whole. By itself glibc raises the limit to the
largest piece that was ever freed, and cuts what is smaller out of what the small ones use."""
SPARE_BYTES: Final = 256 << 10
ARENAS: Final = 2
"""Pools of memory that threads share; one for each thread would keep what each of them once needed."""


def keep_small() -> None:
    """Have the allocator hold about what is in use. Only glibc knows how; elsewhere nothing happens."""
    libc = ctypes.CDLL(None)
    if hasattr(libc, "mallopt"):
        for parameter, value in (
            (_MMAP_THRESHOLD, LARGE_BYTES),
            (_TRIM_THRESHOLD, SPARE_BYTES),
            (_ARENA_MAX, ARENAS),
        ):
            libc.mallopt(parameter, value)


def collect_garbage() -> None:
    """Free what a machine has left; it takes 30 to 150 ms, in which no thread of Python goes on."""
    gc.unfreeze()
    gc.collect()
    gc.freeze()


def pass_by_what_stays() -> None:
    """Have the garbage collector look no more at what there is by now: it would take as long, at any time."""
    gc.freeze()


def give_back() -> None:
    """Return to the system what is free: after many messages of all sizes the allocator keeps pieces of it.

    It takes milliseconds: for a machine that stands. Only glibc knows how; elsewhere nothing happens.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
