"""How long this process may compute before it is another one's turn, where several want a processor.

Linux gives the processor first to whoever has the earliest deadline: the time slice after it became ready. So
a thread with short slices runs sooner, with the same share of processor time (sched(7), sched_setattr(2)).
"""

import ctypes
import os
import platform
import sys
from typing import Final

SLICE_NS: Final = 100_000
"""The shortest that Linux grants."""
_CALLS: Final = {"x86_64": (314, 315), "aarch64": (274, 275), "riscv64": (274, 275)}
"""Numbers of sched_setattr and sched_getattr for programs of 64 bits; glibc has functions since 2.41."""


class _Attributes(ctypes.Structure):
    """``struct sched_attr`` as of its first version."""

    _fields_ = (
        ("size", ctypes.c_uint32),
        ("policy", ctypes.c_uint32),
        ("flags", ctypes.c_uint64),
        ("nice", ctypes.c_int32),
        ("priority", ctypes.c_uint32),
        ("runtime_ns", ctypes.c_uint64),
        ("deadline_ns", ctypes.c_uint64),
        ("period_ns", ctypes.c_uint64),
    )


def shorten_time_slice(slice_ns: int = SLICE_NS) -> None:
    """Have this thread, and those that it begins from now on, ask for slices of SLICE_NS.

    Nothing happens on other computers than those of ``_CALLS``, nor where somebody has chosen another policy
    than the usual one; Linux before 6.12 accepts the request and ignores it.
    """
    set_number, _ = _numbers()
    attributes = slice_attributes()
    if attributes is not None and attributes.policy == os.SCHED_OTHER:
        attributes.runtime_ns = slice_ns
        ctypes.CDLL(None).syscall(set_number, 0, ctypes.byref(attributes), 0)


def slice_attributes() -> _Attributes | None:
    """Return what the system says about this thread; None: it does not."""
    _, get_number = _numbers()
    found = _Attributes()
    if not get_number:
        return None
    failed = ctypes.CDLL(None).syscall(get_number, 0, ctypes.byref(found), ctypes.sizeof(found), 0)
    return None if failed else found


def _numbers() -> tuple[int, int]:
    return _CALLS.get(platform.machine(), (0, 0)) if sys.maxsize > 2**32 else (0, 0)
