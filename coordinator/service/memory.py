"""What the process does about memory, where it is all the service's own."""

import ctypes
import gc


def pass_by_what_stays() -> None:
    """Have the garbage collector look no more at what there is by now: it held the loop up for 30 to 50 ms.

    What a machine before this one left goes first.
    """
    gc.unfreeze()
    gc.collect()
    gc.freeze()


def give_back() -> None:
    """Return to the system what is free: after many messages of all sizes the allocator keeps pieces of it.

    It takes milliseconds: for a machine that stands. Only glibc knows how; elsewhere nothing happens.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
