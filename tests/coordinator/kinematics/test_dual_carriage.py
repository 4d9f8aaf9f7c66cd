import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.kinematics.dual_carriage import Carriage, CarriageMode, CarriageState, DualCarriage

PRIMARY, COPY, MIRROR, INACTIVE = CarriageMode
IDEX = DualCarriage(
    0,
    (
        Carriage(-50, 300, -50, (("stepper_x", (1, 0, 0, 0)),)),
        Carriage(0, 350, 350, (("dual_carriage", (1, 1, 0, 0)),)),
    ),
    safe_distance=50,
)


def test_after_homing_the_first_carriage_is_the_head() -> None:
    home = IDEX.home
    assert (home.primary, home.position, home.at(100)) == (0, -50, (100, 350))
    assert IDEX.weights(home) == {"stepper_x": (1, 0, 0, 0), "dual_carriage": (0, 1, 0, 0)}
    assert IDEX.limits(home) == (-50, 300)


def test_the_other_carriage_takes_over_where_it_stands() -> None:
    state = IDEX.set_mode(IDEX.home, 120, 1, PRIMARY)
    assert state == CarriageState((INACTIVE, PRIMARY), (120, 350))
    assert (state.position, state.at(200)) == (350, (120, 200))
    assert IDEX.weights(state) == {"stepper_x": (0, 0, 0, 0), "dual_carriage": (1, 1, 0, 0)}
    assert IDEX.limits(state) == (170, 350)  # 50 mm beside the parked one


def test_copying_keeps_both_in_their_ranges() -> None:
    state = IDEX.set_mode(IDEX.set_mode(IDEX.set_mode(IDEX.home, 0, 1, PRIMARY), 150, 0, PRIMARY), 0, 1, COPY)
    assert state.at(60) == (60, 210)
    assert IDEX.limits(state) == (-50, 200)
    assert IDEX.weights(state)["dual_carriage"] == (1, 1, 0, 0)


def test_mirroring_keeps_them_apart() -> None:
    state = IDEX.set_mode(IDEX.home, 0, 1, MIRROR)
    assert state.at(60) == (60, 290)
    assert IDEX.limits(state) == (0, 150)  # 350 is the second one's end; they meet at 175
    assert IDEX.weights(state)["dual_carriage"] == (-1, 1, 0, 0)


def test_the_primary_cannot_follow_itself() -> None:
    with pytest.raises(ValueError, match="carriage 0 is the primary and cannot be COPY"):
        IDEX.set_mode(IDEX.home, 0, 0, COPY)


def test_too_close_to_copy() -> None:
    close = CarriageState((PRIMARY, INACTIVE), (100, 130))
    with pytest.raises(
        ValueError, match=r"cannot be COPY from where the carriages are \(100 and 130 mm\); move"
    ):
        IDEX.set_mode(close, 100, 1, COPY)


@given(st.data())
def test_within_the_limits_both_carriages_are_where_they_may_be(data: st.DataObject) -> None:
    state = IDEX.home
    for _ in range(data.draw(st.integers(1, 6))):
        low, high = IDEX.limits(state)
        position = data.draw(st.floats(low, high))
        one, two = state.at(position)
        assert -50 - 1e-9 <= one <= 300 + 1e-9
        assert -1e-9 <= two <= 350 + 1e-9
        assert two - one >= 50 - 1e-9
        before = state
        try:
            state = IDEX.set_mode(
                state, position, data.draw(st.integers(0, 1)), data.draw(st.sampled_from(CarriageMode))
            )
        except ValueError:
            continue
        assert state.positions == before.at(position)  # no carriage jumps
        assert state.modes.count(PRIMARY) == 1
