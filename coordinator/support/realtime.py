"""Real-time priority is the service's own (docs/run.md); what it starts does not come before others.

A process that is started inherits it, and one that computes would take turns with the control loop, a tenth
of a second each.
"""

import contextlib
import os
from typing import Final

_REALTIME: Final = (os.SCHED_FIFO, os.SCHED_RR)


def end_realtime(pid: int) -> None:
    """Have the process PID, just started, compete for the processor as programs usually do."""
    with contextlib.suppress(OSError):  # it has ended already, or a sandbox forbids it
        if os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK in _REALTIME:
            os.sched_setscheduler(pid, os.SCHED_OTHER, os.sched_param(0))
