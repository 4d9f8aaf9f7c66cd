"""``canductor`` for tests in real time, on a computer that is busy with other tests: it has more time.

While an axis homes, a node stops that does not hear from its host for a quarter of a second, and a motion
begins a quarter of a second after a standstill; here both have more time, as much as there may be: a motion
nearly as much as steps are sent ahead, and homing moves send theirs as far ahead as all others. That a node
stops, and when, and how soon a motion begins, is tested in virtual time.
"""

import sys
from collections.abc import Callable

from coordinator import homing, motion_worker, single_move, streamer
from coordinator.cli import main

START_LEAD_S = 1.1
PATIENCE = (
    (homing, "TIMEOUT_S", 2.0),
    (homing, "LEADS_S", homing.LEADS_S[1:]),
    (motion_worker, "START_LEAD_S", START_LEAD_S),
    (single_move, "SEND_AHEAD_S", motion_worker.SEND_AHEAD_S),
    (streamer, "START_LEAD_S", START_LEAD_S),
    (streamer, "BUSY_START_LEAD_S", START_LEAD_S),
)


def be_patient(put: Callable[[object, str, object], None] = setattr) -> None:
    """Take more time, by PUT."""
    for module, name, value_s in PATIENCE:
        put(module, name, value_s)


if __name__ == "__main__":
    be_patient()
    sys.exit(main())
