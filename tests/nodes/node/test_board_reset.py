"""Pulses of DTR and RTS, and the power of USB ports."""

import asyncio

import pytest

from nodes.node.board_reset import POWER_OFF_S, ResetMethod, power_cycle, pulse, reset_methods
from nodes.support.errors import CanductorError
from tests.nodes import virtual_time


def pulsed(method: ResetMethod) -> list[tuple[float, bool, bool]]:
    """Return the time (s) and the levels of DTR and RTS that METHOD sets."""
    levels: list[tuple[float, bool, bool]] = []

    async def main() -> None:
        began_s = asyncio.get_running_loop().time()

        def set_lines(dtr: bool, rts: bool) -> None:
            levels.append((round(asyncio.get_running_loop().time() - began_s, 6), dtr, rts))

        await pulse(method, set_lines)

    virtual_time.run(main())
    return levels


def test_arduinos_are_reset_by_the_rise_of_dtr_which_then_stays() -> None:
    assert pulsed(ResetMethod.ARDUINO) == [(0.0, False, True), (0.1, True, True)]


def test_cheetahs_have_rts_set_during_the_pulse_and_both_cleared_after_it() -> None:
    levels = pulsed(ResetMethod.CHEETAH)
    assert [(dtr, rts) for _, dtr, rts in levels] == [
        (False, True),
        (True, True),
        (False, True),
        (False, False),
    ]


def test_each_method_is_followed_by_the_command() -> None:
    assert reset_methods(ResetMethod.COMMAND) == ("command",)
    for method in (ResetMethod.ARDUINO, ResetMethod.CHEETAH, ResetMethod.RPI_USB):
        assert reset_methods(method) == (method, "command")


@pytest.mark.parametrize("fails", [False, True])
def test_power_comes_back_whatever_happens(*, fails: bool) -> None:
    switched: list[tuple[float, bool]] = []

    async def main() -> None:
        began_s = asyncio.get_running_loop().time()

        def set_power(on: bool) -> None:
            switched.append((round(asyncio.get_running_loop().time() - began_s, 6), on))
            if fails and not on:
                raise CanductorError("it is stuck")

        if fails:
            with pytest.raises(CanductorError, match="stuck"):
                await power_cycle(set_power)
        else:
            await power_cycle(set_power)

    virtual_time.run(main())
    assert switched == [(0.0, False), (0.0 if fails else POWER_OFF_S, True)]
