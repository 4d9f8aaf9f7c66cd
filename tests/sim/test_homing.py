"""Homing on simulated boards: steppers here, the endstop there; what the host believes against the truth."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import numpy as np
import pytest

from coordinator.modules.module_set import build_modules
from coordinator.runtime.machine import Machine
from coordinator.runtime.moves.homing import (
    CYCLE_S,
    TIMEOUT_S,
    HomingError,
    HomingMove,
    HomingResult,
    Overshoot,
    _Leg,
    _overshoot,
    _way,
)
from coordinator.runtime.moves.single import Ramp, SingleMove, ratio_of
from coordinator.simulate import scenario as scenarios
from coordinator.simulate.stage import Stage
from nodes.link import Link
from nodes.support.errors import CanductorError
from tests.profiles import examples
from tests.stages.motor_switches import MotorSwitch, place_switches
from tests.stages.printer_text import MCU, TOOLHEAD, printer_section, section, stepper_section

if TYPE_CHECKING:
    from coordinator.config.model import StepperDescription

ON_UART = section("mcu toolhead", serial="/dev/ttyTool", baud=250000)
ENDS = {"position_endstop": 0, "position_max": 250}
PS_PER_US = 1_000_000
SWITCH_AT = -1600
"""Steps from where the axis begins to where the switch is: 20 mm."""
STEPS_PER_MM = 80


@dataclass
class Home:
    """One homing move of X on a simulated machine."""

    folder: Path
    toolhead: str = TOOLHEAD
    kinematics: str = "cartesian"
    endstop: str = "^toolhead:PC5"
    y_node: str = ""
    settings: str = ""
    switch_at: int | None = SWITCH_AT
    direction: int = -1
    first_mm: float = 0.0
    """The axis goes so far away from the switch before."""
    way_mm: float = 40.0
    speed: float = 50.0
    seed: int = 0
    during: Callable[[Stage], None] | None = None
    """What happens half a second after the move began."""
    told: list[str] = field(default_factory=list)
    known_after_s: float = 0.0
    """How long after the trigger the result was there."""
    looks_on: bool = True
    """Whether the node still looks at the endstop when homing has failed."""
    since_begin_s: float = 0.0
    """How long after the call it failed."""
    task: "asyncio.Task[object] | None" = None

    def run(self) -> HomingResult:
        y = self.y_node
        machine = (
            MCU
            + self.toolhead
            + printer_section(self.kinematics, max_z_velocity=20, max_z_accel=500)
            + stepper_section("stepper_x", "PB0", "PB1", endstop_pin=self.endstop, homing_speed=50, **ENDS)
            + stepper_section("stepper_y", f"{y}PB3", f"!{y}PB4", **ENDS)
            + stepper_section("stepper_z", "PB6", "PB7", rotation_distance=8, **ENDS)
        )
        (self.folder / "home.cfg").write_text(machine)
        text = f'about = "Homing."\nmachine = "home.cfg"\n{self.settings}'
        (self.folder / "home.toml").write_text(text)
        self.stage = Stage(scenarios.find(str(self.folder / "home.toml")), self.seed)
        switch = MotorSwitch(
            "PB0",
            "PB1",
            node="toolhead" if "toolhead" in self.endstop else "mcu",
            pin="PC5",
            at=self.switch_at if self.switch_at is not None else self.direction * 10**6,
            direction=self.direction,
        )
        self.plants = place_switches(self.stage, [switch])
        with asyncio.Runner(loop_factory=self.stage.make_loop) as runner:
            return runner.run(self._main())

    async def _main(self) -> HomingResult:
        machine = Machine(
            self.stage.description,
            self.stage.host,
            build_modules(self.stage.description),
            on_notice=self.told.append,
        )
        self.machine = machine
        await machine.start()
        began_s = asyncio.get_running_loop().time()
        try:
            rail = self.stage.description.rails[0]
            if self.first_mm:
                away = Ramp(self.first_mm, self.speed, 3000.0)
                await SingleMove(machine, away, ratio_of("x", 1)).run()
            move = HomingMove(
                machine,
                [rail],
                axis="x",
                direction=self.direction,
                way_mm=self.way_mm,
                speed=self.speed,
                accel=3000.0,
            )
            self.task = asyncio.current_task()
            if self.during is not None:
                asyncio.get_running_loop().call_later(0.5, self.during, self.stage)
            try:
                (result,) = await move.run()
            except HomingError:
                node = machine.nodes[machine.devices.endstop_node(rail)]
                self.looks_on = (await machine.devices.endstops["x"].state(node)).homing
                raise
            ended_s = machine.time_base().print_time_at(machine.host.now())
            self.known_after_s = ended_s - result.triggered_at_s
            return result
        finally:
            self.since_begin_s = asyncio.get_running_loop().time() - began_s
            await machine.close()

    def steps(self, node: str = "mcu", pin: str = "PB0") -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        """Return the true times (µs) of a stepper's steps."""
        edges = self.stage._boards[node].node.edges()
        chosen = (edges["pin"] == self.stage.pins(node)[pin]) & (edges["level"] == 1)
        return np.asarray(edges["true_ps"][chosen] // PS_PER_US, np.int64)

    def position(self) -> int:
        return self.plants["mcu"].page.motors["PB0"].count

    def microseconds_to_stop(self) -> int:
        """Return the true time from the switch to the last step behind it."""
        steps = self.steps()
        return int(steps[-1] - steps[abs(SWITCH_AT) - 1])


def check_position(home: Home, result: HomingResult) -> None:
    """Compare what the host believes with the truth."""
    assert result.moved["stepper_x"] == home.position()
    beyond = abs(home.position()) - abs(SWITCH_AT)
    assert result.way_mm == pytest.approx(abs(home.position()) / STEPS_PER_MM, abs=1e-9)
    # The switch closes with a step; a look is taken every 50 µs, 2.5 µm of way, and clocks differ by less.
    assert result.way_to_trigger_mm == pytest.approx(abs(SWITCH_AT) / STEPS_PER_MM, abs=1.5 / STEPS_PER_MM)
    (overshoot,) = [o for o in result.overshoots if o.stepper == "stepper_x"]
    assert abs(overshoot.steps - beyond) <= 1
    assert abs(overshoot.steps - overshoot.distance_mm * STEPS_PER_MM) <= 0.5 + 1e-6
    assert result.beyond_trigger_mm == pytest.approx(overshoot.distance_mm, abs=1e-9)


@pytest.mark.parametrize("seed", range(examples(2)))
def test_a_trigger_group_stops_another_node_within_300_us_on_a_busy_bus(tmp_path: Path, seed: int) -> None:
    home = Home(tmp_path, settings="[buses.can0]\nload = 0.7\n", seed=seed)
    result = home.run()
    assert result.through_group
    assert home.microseconds_to_stop() < 300
    check_position(home, result)


def test_an_axis_goes_up_to_its_switch_as_well(tmp_path: Path) -> None:
    home = Home(tmp_path, switch_at=-SWITCH_AT, direction=1)
    check_position(home, home.run())


@pytest.mark.parametrize("silent", [False, True])
def test_a_homing_that_is_cancelled_stops_at_once(tmp_path: Path, silent: bool) -> None:
    """Also when another node does not answer any more, which is not known yet."""
    cancelled_us: list[int] = []

    def cancel() -> None:
        cancelled_us.append(home.stage.now_ns() // 1000)
        assert home.task is not None
        home.task.cancel()

    def during(stage: Stage) -> None:
        if silent:
            cut(stage)
        asyncio.get_running_loop().call_later(0.02, cancel)

    home = Home(tmp_path, way_mm=200.0, switch_at=None, during=during)
    with pytest.raises(asyncio.CancelledError):
        home.run()
    assert len(home.steps()) > 0
    assert home.steps()[-1] - cancelled_us[0] < 1000


def test_a_machine_that_is_stopped_ends_its_homing(tmp_path: Path) -> None:
    home = Home(tmp_path, way_mm=200.0, switch_at=None, during=lambda _: home.machine.stop("it burns"))
    with pytest.raises(CanductorError, match="it burns"):
        home.run()
    assert home.since_begin_s < 1.0


def test_what_an_overshoot_is_where_a_motor_goes_half_as_far_as_the_axis() -> None:
    stepper = cast("StepperDescription", SimpleNamespace(name="belt", node="mcu", step_distance=0.125))
    for along, planned, moved, steps, distance_mm in (
        (0.5, 10.75, 14, 3, 0.8125),
        (-0.5, -10.75, -14, 3, 0.8125),
        (-0.5, -10.25, -8, -2, -0.5625),
        (0.5, 10.5, 11, 0, 0.125),
    ):
        way = SimpleNamespace(along=lambda _, a=along: a, planned_steps=lambda _, mm, p=planned: p + 0 * mm)
        found = _overshoot(cast("SingleMove", way), stepper, moved, 1.0)
        assert found == Overshoot("belt", "mcu", steps, distance_mm)
        leg = cast("_Leg", SimpleNamespace(steppers=[stepper]))
        assert _way(leg, cast("SingleMove", way), {"belt": moved}) == moved * 0.125 / along


def test_frames_that_get_lost_cost_overshoot_but_no_position(tmp_path: Path) -> None:
    found = []
    for seed in range(8):
        home = Home(tmp_path, settings="[buses.can0]\nloss = 0.02\n", seed=seed)
        check_position(home, home.run())
        found.append(home.microseconds_to_stop())
    assert sorted(found)[len(found) // 2] < 300
    assert max(found) < TIMEOUT_S * 1e6


def test_the_host_relays_for_a_board_without_groups(tmp_path: Path) -> None:
    home = Home(tmp_path, settings="[nodes.toolhead]\nlegacy = true\n")
    result = home.run()
    assert not result.through_group
    assert home.microseconds_to_stop() < 20_000
    check_position(home, result)


def test_the_host_relays_from_a_uart_to_a_bus(tmp_path: Path) -> None:
    home = Home(tmp_path, toolhead=ON_UART)
    result = home.run()
    assert not result.through_group
    assert home.microseconds_to_stop() < 20_000
    check_position(home, result)


def test_an_endstop_on_the_node_of_its_stepper_needs_nobody(tmp_path: Path) -> None:
    home = Home(tmp_path, endstop="^PC5")
    result = home.run()
    assert not result.through_group
    assert home.microseconds_to_stop() < 150
    check_position(home, result)


def test_the_result_is_there_at_once_whatever_the_phase_of_the_hosts_cycle(tmp_path: Path) -> None:
    for switch_at in range(-1600, -1720, -30):
        home = Home(tmp_path, switch_at=switch_at)
        assert home.run().moved["stepper_x"] == home.position()
        assert home.known_after_s < 0.25 * CYCLE_S


def test_all_motors_of_a_corexy_stop(tmp_path: Path) -> None:
    home = Home(tmp_path, kinematics="corexy", y_node="toolhead:")
    result = home.run()
    assert {o.stepper for o in result.overshoots} == {"stepper_x", "stepper_y"}
    assert result.moved["stepper_x"] == home.position()
    assert result.moved["stepper_y"] == pytest.approx(home.position(), abs=25)
    assert home.steps("toolhead", "PB3")[-1] - home.steps()[abs(SWITCH_AT) - 1] < 300
    assert result.way_to_trigger_mm == pytest.approx(20.0, abs=0.02)


def test_a_switch_that_never_closes_is_told(tmp_path: Path) -> None:
    home = Home(tmp_path, switch_at=None)
    with pytest.raises(HomingError, match="axis x moved 40 mm and its endstop did not switch; check"):
        home.run()
    assert home.position() == -40 * STEPS_PER_MM
    assert not home.looks_on


def test_a_switch_that_is_pressed_already_is_told_before_anything_moves(tmp_path: Path) -> None:
    home = Home(tmp_path, switch_at=0)
    with pytest.raises(HomingError, match="the endstop of axis x is pressed before the move"):
        home.run()
    assert len(home.steps()) == 0


def acknowledge_late(monkeypatch: pytest.MonkeyPatch, *waits_s: float) -> None:
    """Have the first moves' nodes armed so late, for all the host knows: the first one by half a second."""
    drained = Link.drained
    waits, moves = list(waits_s or (0.5,)), list[Link]()

    async def late(self: Link) -> None:
        moves.append(self)
        if len(moves) % 2 and waits:  # there are two nodes to be armed for each
            await asyncio.sleep(waits.pop(0))
        await drained(self)

    monkeypatch.setattr(Link, "drained", late)


def test_a_move_whose_nodes_were_armed_too_late_is_begun_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The acknowledgements come half a second late: the first steps are made, stopped, and counted."""
    acknowledge_late(monkeypatch)
    home = Home(tmp_path)
    result = home.run()
    check_position(home, result)
    gaps = np.diff(home.steps())
    assert gaps[:-1].max() > 0.5e6, "it stood still in between"


def test_nodes_that_are_armed_just_when_the_move_begins_are_in_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drained, now = Link.drained, SingleMove.print_time_now
    armed: list[Link] = []

    async def note(self: Link) -> None:
        armed.append(self)
        await drained(self)

    def at_the_begin(self: SingleMove) -> float:
        if len(armed) == 2:  # the look behind both nodes; the looks to come tell the time
            armed.append(armed[0])
            return self.begin_s
        return now(self)

    monkeypatch.setattr(Link, "drained", note)
    monkeypatch.setattr(SingleMove, "print_time_now", at_the_begin)
    home = Home(tmp_path)
    check_position(home, home.run())
    assert len(armed) == 3, "nothing was armed again"


def test_the_third_try_has_the_longest_time_and_is_the_last_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Moves begin 0.4 s, 0.8 s and 1.6 s ahead. What was made before does not count."""
    acknowledge_late(monkeypatch, 0.5, 0.9, 1.0)
    home = Home(tmp_path, first_mm=5.0)
    result = home.run()
    assert result.moved["stepper_x"] == home.position() - 5 * STEPS_PER_MM
    assert result.way_to_trigger_mm == pytest.approx(25.0, abs=1.5 / STEPS_PER_MM)
    acknowledge_late(monkeypatch, 0.5, 0.9, 1.7)
    with pytest.raises(
        HomingError, match="axis x was not homed: arming its nodes took too long; check the bus"
    ):
        Home(tmp_path).run()


def test_ways_count_from_where_the_move_began(tmp_path: Path) -> None:
    home = Home(tmp_path, first_mm=5.0)
    result = home.run()
    assert result.moved["stepper_x"] == home.position() - 5 * STEPS_PER_MM
    assert result.way_to_trigger_mm == pytest.approx(25.0, abs=1.5 / STEPS_PER_MM)
    (overshoot,) = result.overshoots
    assert abs(overshoot.steps - (abs(home.position()) - abs(SWITCH_AT))) <= 1


def test_an_overshoot_is_told_in_steps_and_mm() -> None:
    told = str(Overshoot("stepper_x", "mcu", 3, 0.0375))
    assert told == "stepper_x on mcu: overshoot 3 steps (0.0375 mm)"


@pytest.mark.parametrize("endstop", ["^PC5", "^toolhead:PC5"])
def test_an_endstop_that_switched_before_its_move_counted_as_late_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, endstop: str
) -> None:
    """As at a second approach: it is pressed when the move would be begun again."""
    acknowledge_late(monkeypatch)
    home = Home(tmp_path, endstop=endstop, switch_at=-160, speed=25.0)
    result = home.run()
    assert result.moved["stepper_x"] == home.position()
    assert result.way_to_trigger_mm == pytest.approx(2.0, abs=1.5 / STEPS_PER_MM)
    assert np.diff(home.steps()).max() < 0.5e6, "it went there at once"


def cut(stage: Stage) -> None:
    controller = stage._boards["toolhead"].node.controller
    assert controller is not None
    controller.cut(1)


def stall(stage: Stage) -> None:
    stage._world.stall(0.6)


def test_a_node_that_is_alone_bears_a_host_that_is_busy_for_long(tmp_path: Path) -> None:
    """The switch closes while the host stands still for longer than several nodes would wait."""
    home = Home(tmp_path, endstop="^PC5", during=lambda stage: stage._world.stall(TIMEOUT_S + 0.2))
    check_position(home, home.run())


@pytest.mark.parametrize("settings", ["", "[nodes.toolhead]\nlegacy = true\n"])
@pytest.mark.parametrize(
    ("during", "cause"),
    [(cut, "lost node toolhead"), (stall, r"did not hear from the host for 0\.25 s and stopped by itself")],
)
def test_whoever_is_left_alone_while_homing_stops_in_time(
    tmp_path: Path, settings: str, during: Callable[[Stage], None], cause: str
) -> None:
    home = Home(tmp_path, settings=settings, way_mm=200.0, switch_at=-(10**6), during=during)
    with pytest.raises(CanductorError, match=cause):
        home.run()
    # It began 0.25 s after the call, was left alone 0.25 s later, and has a quarter of a second's patience.
    assert home.steps()[-1] - home.steps()[0] < (0.25 + TIMEOUT_S + 0.1) * 1e6
