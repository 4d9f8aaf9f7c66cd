from coordinator.service.motion_lead import SETTLED_S, MotionLead


def seen(lead: MotionLead) -> list[float | None]:
    return [lead.now_s, lead.least_s]


def test_the_least_lead_is_that_of_settled_motion() -> None:
    lead = MotionLead()
    lead.look(10.0, 10.25, comes_to_rest=False)  # at the start it must be small
    assert seen(lead) == [0.25, None]
    lead.look(10.0 + SETTLED_S, 12.0, comes_to_rest=False)
    assert seen(lead) == [1.0, None]
    lead.look(12.0, 13.25, comes_to_rest=False)
    lead.look(13.0, 13.5, comes_to_rest=False)
    lead.look(14.0, 15.0, comes_to_rest=False)
    assert seen(lead) == [1.0, 0.5]
    lead.look(15.0, 15.0, comes_to_rest=True)  # what is not planned is not late
    assert seen(lead) == [None, 0.5]
    lead.look(20.0, 20.25, comes_to_rest=False)
    lead.look(20.5, 20.75, comes_to_rest=False)
    assert seen(lead) == [0.25, 0.5]
