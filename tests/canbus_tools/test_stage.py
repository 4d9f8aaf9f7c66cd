"""The stage itself: six nodes, each in the state that the tools are to find it in."""

from collections import Counter

import pytest

from nodes.support.can_protocol import ADMIN_ID, ADMIN_RESPONSE_ID
from nodes.transport import CanFrame
from tests.stages.can_stage import BED, BOOT, MAIN, MAIN_ID, TOOL_ID, TWIN, SixNodes, set_nodeid


@pytest.mark.parametrize(
    ("question", "wanted"),
    [
        (0x00, {f"20{BED}01": 1, f"20{TWIN}01": 2, f"20{BOOT}11": 1}),
        (0x41, {f"21{MAIN}{MAIN_ID:02x}": 1}),
    ],
    ids=["four wait and say what they are", "only ours say that they are here"],
)
def test_answers(six: SixNodes, question: int, wanted: dict[str, int]) -> None:
    with six.stage.user() as host:
        host.send(CanFrame(ADMIN_ID, bytes([question])))
        six.stage.world.run_for(0.1)
        answers = Counter(f.data.hex() for f in host.frames if f.id == ADMIN_RESPONSE_ID)
    # Twins answer alike and at once: on a CAN bus that is one frame, or two.
    twins = f"20{TWIN}01"
    assert wanted.get(twins, 0) >= answers[twins] >= bool(wanted.get(twins))
    assert {a: n for a, n in answers.items() if a != twins} == {a: n for a, n in wanted.items() if a != twins}


def test_one_is_in_shutdown(six: SixNodes) -> None:
    stage = six.stage
    with stage.user() as host:
        set_nodeid(host, BED, TOOL_ID + 1)
    assert [stage.is_shut_down(nodeid) for nodeid in (MAIN_ID, TOOL_ID, TOOL_ID + 1)] == [False, True, False]
    with stage.user() as host:
        host.send(CanFrame(0x010, bytes(6)))  # which Klipper-type boards do not know
    assert [stage.is_shut_down(nodeid) for nodeid in (MAIN_ID, TOOL_ID + 1)] == [True, False]
