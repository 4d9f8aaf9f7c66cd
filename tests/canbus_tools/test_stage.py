"""The stage itself: six nodes, each in the state that the tools are to find it in."""

from collections import Counter
from contextlib import closing

from nodes.assign import ADMIN_ID, ADMIN_RESPONSE_ID
from nodes.transport import CanFrame
from tests.canbus_tools.stage import BED, BOOT, MAIN, MAIN_ID, PATIENCE_S, TOOL_ID, TWIN, Stage, set_nodeid


def answers(stage: Stage, question: int, count: int) -> Counter[str]:
    """Return what the first COUNT answers to an admin question say."""
    said: Counter[str] = Counter()
    with closing(stage.place.open()) as host:
        host.send(CanFrame(ADMIN_ID, bytes([question])))
        while said.total() < count:
            frame = host.receive(PATIENCE_S)
            assert frame is not None, f"only {said} answered"
            if frame.id == ADMIN_RESPONSE_ID:
                said[frame.data.hex()] += 1
    return said


def test_four_wait_and_say_what_they_are(stage: Stage) -> None:
    assert answers(stage, 0x00, 4) == {f"20{BED}01": 1, f"20{TWIN}01": 2, f"20{BOOT}11": 1}


def test_only_ours_say_that_they_are_here(stage: Stage) -> None:
    assert answers(stage, 0x41, 1) == {f"21{MAIN}{MAIN_ID:02x}": 1}


def test_one_is_in_shutdown(stage: Stage) -> None:
    with closing(stage.place.open()) as host:
        set_nodeid(host, BED, TOOL_ID + 1)
        host.send(CanFrame(0x010, b"\x00\x00"))  # which Klipper-type boards do not know
    ends = {name: getattr(stage, name).stop()["is_shutdown"] for name in ("main", "tool", "bed")}
    assert ends["tool"]
    assert not ends["bed"]
