from coordinator.service.core.motion_lead import SETTLED_S, MotionLead


def seen(lead: MotionLead) -> list[float | None]:
    return [lead.now_s, lead.least_s]


def test_the_least_lead_is_what_was_left_in_settled_motion() -> None:
    lead = MotionLead()
    lead.look(10.0, 10.25, comes_to_rest=False)
    assert seen(lead) == [None, None]
    lead.look(10.0 + SETTLED_S, 12.25, comes_to_rest=False)  # at the start it must be small
    assert seen(lead) == [-0.75, None]
    lead.look(11.25, 12.5, comes_to_rest=False)
    assert seen(lead) == [1.0, 1.0]
    lead.look(12.25, 13.5, comes_to_rest=False)  # held up for a second, made good at once
    assert seen(lead) == [0.25, 0.25]
    lead.look(12.5, 13.75, comes_to_rest=False)
    assert seen(lead) == [1.0, 0.25]
    lead.look(13.75, 13.75, comes_to_rest=True)  # what is not planned is not late
    assert seen(lead) == [None, 0.25]
    lead.look(20.0, 20.25, comes_to_rest=False)
    lead.look(20.25, 20.5, comes_to_rest=False)
    assert seen(lead) == [0.0, 0.25]
