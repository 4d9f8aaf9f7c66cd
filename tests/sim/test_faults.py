"""Faults: drawn from the seed alone, in true time; who can be reached in spite of them."""

import dataclasses
from collections.abc import Callable

from coordinator.simulate import scenario
from coordinator.simulate.faults import NS, Faults, ScenarioFault
from coordinator.simulate.scenario import FaultSetting
from coordinator.support.toml_values import Dice, Range

BUS_OF = {"mcu": "can0", "toolhead": "can0", "zboard": "/dev/ttyUSB0"}


class Actor:
    """Keeps what it is asked to do."""

    def __init__(self) -> None:
        self.now = 5 * NS
        self.acted: list[ScenarioFault] = []
        self.calls: list[int] = []

    def now_ns(self) -> int:
        return self.now

    def act(self, fault: ScenarioFault) -> None:
        self.acted.append(fault)

    def call(self, at_ns: int, what: Callable[[], object]) -> None:
        self.calls.append(at_ns)


def faults(*settings: FaultSetting, seed: int = 1) -> tuple[Faults, Actor]:
    actor = Actor()
    entry = dataclasses.replace(scenario.find("clean"), faults=settings)
    return Faults(entry, Dice("clean", seed), actor, BUS_OF), actor


def fault(kind: str, at_s: float, for_s: float = 0.0, **more: object) -> FaultSetting:
    settings = FaultSetting(kind=kind, at_s=Range(at_s, at_s), for_s=Range(for_s, for_s))
    return dataclasses.replace(settings, **more)  # type: ignore[arg-type]


def begin(planned: Faults, since: str = "job") -> None:
    planned.begin(since, lambda: None)


def test_each_begins_where_it_counts_from() -> None:
    planned, actor = faults(
        fault("cut", 1, 2, node="toolhead"), fault("reset", 0.5, node="mcu", since="start")
    )
    begin(planned, "start")
    assert [(f.kind, f.begin_ns) for f in actor.acted] == [("reset", 5 * NS + NS // 2)]
    actor.now = 8 * NS
    begin(planned)
    assert (actor.acted[1].begin_ns, actor.acted[1].end_ns) == (9 * NS, 11 * NS)


def test_a_seed_draws_the_same_again_and_others_something_else() -> None:
    setting = FaultSetting(kind="cut", node="toolhead", at_s=Range(0, 5), times=Range(1, 5))

    def drawn(seed: int) -> list[ScenarioFault]:
        planned, actor = faults(setting, seed=seed)
        begin(planned)
        return actor.acted

    assert drawn(1) == drawn(1)
    assert len({tuple(drawn(seed)) for seed in range(20)}) == 20
    assert {len(drawn(seed)) for seed in range(40)} == {1, 2, 3, 4, 5}


def test_repeated_ones_come_evenly() -> None:
    planned, actor = faults(fault("stall", 1, 0.25, node="host", times=Range(3, 3), every_s=Range(0.5, 0.5)))
    begin(planned)
    assert [f.begin_ns for f in actor.acted] == [6 * NS, 6 * NS + NS // 2, 7 * NS]
    actor.now = 6 * NS
    assert planned.happened() == 1


def test_ctrl_c_goes_to_the_loop() -> None:
    planned, actor = faults(fault("interrupt", 2))
    begin(planned)
    assert actor.acted == []
    assert actor.calls == [7 * NS]


def test_who_can_be_reached() -> None:
    planned, _ = faults(fault("cut", 1, 1, node="toolhead"))
    begin(planned)
    assert planned.can_reach("mcu", 6 * NS, 7 * NS)
    assert not planned.can_reach("toolhead", 6 * NS, 7 * NS)
    assert planned.can_reach("toolhead", 5 * NS, 6 * NS - 1)
    assert planned.can_reach("toolhead", 7 * NS + 1, 8 * NS)


def test_a_stalled_host_reaches_nobody_and_a_babbling_node_blocks_its_bus() -> None:
    planned, _ = faults(fault("stall", 1, 1, node="host"))
    begin(planned)
    assert not any(planned.can_reach(node, 6 * NS, 6 * NS) for node in BUS_OF)
    planned, _ = faults(fault("babble", 1, 1, node="mcu"))
    begin(planned)
    assert [planned.can_reach(node, 6 * NS, 6 * NS) for node in BUS_OF] == [False, False, True]


def test_steps_due_before_the_first_fault_of_the_job_must_be_made() -> None:
    planned, _ = faults(fault("cut", 2, 1, node="mcu"), fault("reset", 1, node="mcu", since="start"))
    begin(planned, "start")
    begin(planned)
    assert planned.sound_until_ns(job_ns=6 * NS + 1, stopped_ns=20 * NS) == 7 * NS
    assert planned.sound_until_ns(job_ns=6 * NS + 1, stopped_ns=NS) == NS
