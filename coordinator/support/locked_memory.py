"""Keeps what this process uses in memory, however long it rests.

A system that is short of memory takes away pages that were not used for a while, code first, since that is
on the disk. Whoever needs them again waits for it, and an emergency stop was mostly not used for a while.
"""

import ctypes
import resource
from pathlib import Path
from typing import Final

_CURRENT: Final = 1
_FUTURE: Final = 2
_ON_FAULT: Final = 4
_MAY_LOCK_BIT: Final = 14
"""CAP_IPC_LOCK (capabilities(7))."""


def lock_memory() -> bool:
    """Keep pages in memory from when they are used on; return whether the system grants that (mlockall(2)).

    It does for root, or with LimitMEMLOCK=infinity. Where there is a limit it is not asked: what the program
    reserves counts in full, and what it reserves beyond the limit fails.
    """
    limit_bytes, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if limit_bytes != resource.RLIM_INFINITY and not _may_lock():
        return False
    return int(ctypes.CDLL(None).mlockall(_CURRENT | _FUTURE | _ON_FAULT)) == 0


def _may_lock() -> bool:
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("CapEff:"):
            return bool(int(line.split()[1], 16) >> _MAY_LOCK_BIT & 1)
    return False
