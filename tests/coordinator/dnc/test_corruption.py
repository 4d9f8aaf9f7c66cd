"""One fault costs the file at most, but for one; ``python -m tests.coordinator.dnc.corruption`` plays all."""

import pytest

from tests.coordinator.dnc.corruption import TELLING, Fault, faults, play


@pytest.mark.parametrize("control_sends", [True, False])
def test_every_fault_of_an_answer_or_end(control_sends: bool) -> None:
    """All but one: an ACK that becomes a NAK asks for a line again, which cannot be told from a new one."""
    sound = play(None, control_sends=control_sends, paced=True)
    assert sound.verdict == "same"
    verdicts = set()
    for fault in faults(sound.sent, TELLING, answers=True):
        verdict = play(fault, control_sends=control_sends, paced=True).verdict
        was = sound.sent[fault.who][fault.at]
        if verdict == "doubled":
            assert (fault.kind, was, fault.value) == ("replace", 0x06, 0x15)
        else:
            assert verdict in ("same", "none"), fault
        verdicts.add(verdict)
    assert verdicts == {"same", "none", "doubled"}


@pytest.mark.parametrize("kind", ["insert", "noise at once", "noise"])
@pytest.mark.parametrize("paced", [True, False])
def test_an_ack_that_noise_makes_loses_no_block(kind: str, paced: bool) -> None:
    """Wherever it comes, also on a line whose pace is not known."""
    sound = play(None, control_sends=True, paced=paced)
    verdicts = [
        play(Fault(who, at, kind, value), control_sends=True, paced=paced).verdict
        for who in (0, 1)
        for at in range(len(sound.sent[who]))
        for value in (0x06, 0x15)
    ]
    assert set(verdicts) <= {"same", "none"}
