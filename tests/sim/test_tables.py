"""Axis tables of a machine in virtual time: accepted, brought to the nodes, in use, kept over restarts."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from coordinator.config.model import AxisTablesDescription, MachineDescription
from coordinator.ipc.protocol.methods import ApiError
from coordinator.simulate.scenario import load
from coordinator.simulate.stage import Stage
from coordinator.tables.axis_table import AxisTable
from coordinator.tables.store import TableStore
from tests.stages.served import Served, running

SCENARIOS = Path("coordinator/simulate/scenarios")
POINTS = 32
TABLE: dict[str, Any] = {
    "axis": "x",
    "positions": [0, 50, 100.5],
    "forward": [0, 0.01, 0.02],
    "reverse": [0.05, 0.06, 0.07],
}
SAME: dict[str, Any] = {**TABLE, "reverse": TABLE["forward"]}


def with_tables(world: Stage) -> MachineDescription:
    described = world.description
    return replace(described, axis_tables=AxisTablesDescription(POINTS, described.nodes[0].place))


class World:
    """A simulated machine with tables, that coordinators come and go at."""

    def __init__(self, folder: Path, scenario: str = "clean", machine: Path | None = None) -> None:
        found = load(SCENARIOS / f"{scenario}.toml")
        self.stage = Stage(found if machine is None else replace(found, machine=machine), 1)
        self.folder = folder
        self.tables = folder / "tables"

    def live(self, *acts: Callable[[Served], Awaitable[None]]) -> None:
        """Let a coordinator live for each of ACTS, one after the other."""

        async def go() -> None:
            for act in acts:
                served = Served(
                    self.folder, lambda: with_tables(self.stage), self.stage.host, tables=self.tables
                )
                async with running(served) as stage:
                    await act(stage)

        with asyncio.Runner(loop_factory=self.stage.make_loop) as runner:
            runner.run(go())


async def sides(served: Served, axis: str = "x") -> list[dict[str, Any]]:
    (found,) = [one for one in (await served.call("table.status"))["axes"] if one["axis"] == axis]
    nodes: list[dict[str, Any]] = found["nodes"]
    return nodes


async def in_use(served: Served, generation: int, points: int = 3) -> None:
    """Wait until the nodes of x use the table of GENERATION."""

    async def looks() -> bool:
        found = await sides(served)
        return bool(found) and all(
            (side["status"], side.get("generation"), side.get("points"), side.get("active"))
            == ("ok", generation, points, True)
            for side in found
        )

    async with asyncio.timeout(30):
        while not await looks():  # noqa: ASYNC110  virtual time
            await asyncio.sleep(0.1)


def test_a_table_is_kept_on_the_nodes_and_in_use(tmp_path: Path) -> None:
    world = World(tmp_path)

    async def act(served: Served) -> None:
        told = await served.call("table.send", **TABLE)
        (note,) = told["notes"]
        assert note.startswith("axis x travels from 0 to 250 mm, the table covers 0 to 100.5; beyond it")
        (axis,) = told["axes"]
        assert axis["table"]["greatest_backlash"] == pytest.approx(0.05)
        assert [one["axles"] for one in told["downloads"]] == [[1], [2]], "the sides differ"
        for one in told["downloads"]:
            assert one["broadcasts"] == 1
            assert one["elapsed_s"] > one["bound_s"] > 0
            assert "of which one takes at least" in one["summary"]
        assert {(s["direction"], s["axle"], s["status"], s["active"]) for s in axis["nodes"]} == {
            ("forward", 1, "ok", True),
            ("reverse", 2, "ok", True),
        }
        await in_use(served, 1)
        assert served.tree.get("tables.x.nodes_ok") == 2
        assert served.tree.get("tables.x.problem") == ""

    world.live(act)
    assert list(TableStore(world.tables).load()[0]) == ["x"]


def test_who_compensates_hears_of_every_change(tmp_path: Path) -> None:
    heard: list[tuple[str, AxisTable | None]] = []

    async def act(served: Served) -> None:
        served.service.tables.on_change.append(lambda axis, table: heard.append((axis, table)))
        await served.call("table.send", **{**SAME, "axis": "X"})
        (axis,) = (await served.call("table.remove", axis="X"))["axes"]
        assert axis["axis"] == "x"

    World(tmp_path).live(act)
    table = AxisTable(
        axis="x", positions=(0.0, 50.0, 100.5), forward=(0.0, 0.01, 0.02), reverse=(0.0, 0.01, 0.02)
    )
    assert heard == [("x", table), ("x", None)]


def test_a_removed_table_is_gone_everywhere(tmp_path: Path) -> None:
    world = World(tmp_path)

    async def act(served: Served) -> None:
        await served.call("table.send", **TABLE)
        gone = await served.call("table.remove", axis="x")
        assert [(one["axles"], one["words"]) for one in gone["downloads"]] == [([1, 2], 10)]
        found = await sides(served)
        assert [(side["points"], side["active"]) for side in found] == [(0, True)] * 2
        with pytest.raises(ApiError, match="axis x has no table"):
            await served.call("table.remove", axis="x")

    world.live(act)
    assert TableStore(world.tables).load() == ({}, [])


def test_a_new_coordinator_finds_the_tables_where_they_are(tmp_path: Path) -> None:
    async def first(served: Served) -> None:
        await served.call("table.send", **TABLE)

    async def second(served: Served) -> None:
        await in_use(served, 1)  # nothing was sent again

    World(tmp_path).live(first, second)


def test_nodes_that_lost_them_get_them_again(tmp_path: Path) -> None:
    world = World(tmp_path)

    async def first(served: Served) -> None:
        await served.call("table.send", **TABLE)
        await served.call("table.send", **{**TABLE, "forward": [0.01, 0, 0], "reverse": [0.05, 0.07, 0.06]})
        await in_use(served, 2)

    async def second(served: Served) -> None:
        await served.call("machine.emergency_stop")
        await served.until_state("shutdown")
        await served.call("machine.restart")  # a node that was shut down is configured anew
        await served.until_state("ready")
        await in_use(served, 1)

    world.live(first, second)


def test_what_a_client_breaks_off_arrives_all_the_same(tmp_path: Path) -> None:
    """It was accepted: whether its sender is still there makes no difference."""

    async def act(served: Served) -> None:
        sending = asyncio.ensure_future(served.call("table.send", **TABLE))
        await served.until(lambda: bool(served.service.tables.tables), "acceptance")
        await asyncio.sleep(0.002)
        sending.cancel()
        await asyncio.gather(sending, return_exceptions=True)
        assert sending.cancelled()
        await in_use(served, 1)

    World(tmp_path).live(act)


def test_tables_change_only_while_the_machine_stands(tmp_path: Path) -> None:
    async def act(served: Served) -> None:
        await served.call("gcode.run", script="G28\nG1 X20 F6000")
        busy = asyncio.ensure_future(served.call("move.by", x=100, speed_mm_s=50))
        motion = served.service.motion
        assert motion is not None
        await served.until(lambda: not motion.standing, "motion")
        for call in (served.call("table.send", **TABLE), served.call("table.remove", axis="x")):
            with pytest.raises(ApiError, match="the machine moves; tables change only while it stands"):
                await call
        await busy
        await served.until(lambda: motion.standing, "standstill")
        await served.call("table.send", **TABLE)

    World(tmp_path).live(act)


STEEP: dict[str, Any] = {
    "axis": "x",
    "positions": [0, 50, 100],
    "forward": [0, 0.5, 1.0],
    "reverse": [-0.25, 0.25, 0.75],
}


async def motor_mm(served: Served) -> float:
    """Return where the motor of X is, by its node, once all stands."""
    motion, machine = served.service.motion, served.service.machine
    assert motion is not None
    assert machine is not None
    await served.until(lambda: motion.standing, "standstill")
    (stepper,) = [s for s in machine.description.steppers if s.name == "stepper_x"]
    at: int = (await machine.query_stepper_counts())["stepper_x"]
    return at * stepper.step_distance


async def way_mm(served: Served, lines: str) -> float:
    """Return how far LINES move the motor of X, from standstill to standstill."""
    before = await motor_mm(served)
    await served.call("gcode.run", script=lines)
    return await motor_mm(served) - before


def shown(served: Served) -> tuple[Any, ...]:
    return tuple(served.tree.get(f"tables.x.{name}") for name in ("active", "side", "correction_um"))


def test_the_axis_is_corrected_when_it_is_homed_and_as_long_as_there_is_a_table(tmp_path: Path) -> None:
    exact = 0.03  # two steps

    async def first(served: Served) -> None:
        await served.call("table.send", **STEEP)
        assert shown(served)[0] is False, "not homed yet"
        await served.call("gcode.run", script="G28\nG1 X20 F6000")
        await motor_mm(served)
        await served.until(lambda: shown(served) == (True, "forward", 200), "use")
        assert await way_mm(served, "G1 X100") == pytest.approx(80.8, abs=exact)
        assert await way_mm(served, "G1 X40") == pytest.approx(-60.6 - 0.25, abs=exact)
        await served.until(lambda: shown(served) == (True, "reverse", 150), "the other side")
        await served.call("table.remove", axis="x")
        await served.until(lambda: shown(served)[:2] == (False, ""), "removal")
        assert served.tree.get("tables.x.taking_up_um") == 150
        assert await way_mm(served, "G1 X80") == pytest.approx(40 - 0.15, abs=exact)
        assert await way_mm(served, "G1 X40") == pytest.approx(-40, abs=exact)
        await served.until(lambda: shown(served) == (False, "", 0), "nothing to be left")
        await served.call("table.send", **STEEP)
        await served.until(lambda: shown(served) == (True, "reverse", 0), "use again")
        assert await way_mm(served, "G1 X80") == pytest.approx(40.8, abs=exact)

    async def second(served: Served) -> None:
        await served.call("gcode.run", script="G28\nG1 X20 F6000")
        assert await way_mm(served, "G1 X100") == pytest.approx(80.8, abs=exact)

    World(tmp_path).live(first, second)


def test_homing_another_axis_leaves_the_correction_where_it_is(tmp_path: Path) -> None:
    async def act(served: Served) -> None:
        await served.call("table.send", **STEEP)
        await served.call("gcode.run", script="G28\nG1 X100 F6000")
        assert await way_mm(served, "G28 Y") == 0
        assert await way_mm(served, "G1 Y10 F6000") == 0
        assert await way_mm(served, "G1 X50") == pytest.approx(-50.5 - 0.25, abs=0.03)
        await served.until(lambda: shown(served) == (True, "reverse", 250), "it")

    World(tmp_path).live(act)


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"axis": "w"}, "axis w cannot have a table; axes with tables are x, y, z"),
    ({"positions": [0, 50]}, "has 2 positions, 3 forward"),
    ({"positions": [0, True, 100]}, "positions must be numbers"),
    ({"positions": [500, 550, 600]}, "covers 500 to 600 mm, but the axis travels from 0 to 250 mm"),
    ({"forward": [0, float("nan"), 1]}, "not finite"),
    ({"forward": [0, 2**2000, 1]}, "forward has a number that is too large"),
    (
        {"positions": [0.001 * i for i in range(POINTS + 1)]}
        | {name: [0] * (POINTS + 1) for name in ("forward", "reverse")},
        "has 33 points, and there is room for 32",
    ),
    ({"unit": "deg"}, "axis x is not corrected: its table is in degrees, the axis moves in mm"),
]
ON_TOWERS = {
    "a": "axis a is not corrected: that is for x, y and z of machines whose steppers move in proportion",
    "x": "axis x cannot have a table; tables are for x, y and z of machines whose steppers move in",
}


def test_what_cannot_be_accepted(tmp_path: Path) -> None:
    async def act(served: Served) -> None:
        for changes, problem in REFUSED:
            with pytest.raises(ApiError, match=problem):
                await served.call("table.send", **{**TABLE, **changes})

    world = World(tmp_path)
    world.live(act)
    assert not world.tables.exists()


def test_towers_take_no_tables(tmp_path: Path) -> None:
    """But one that was kept for a tower can be taken away."""
    world = World(tmp_path, machine=Path("config/delta.cfg"))
    TableStore(world.tables).save(AxisTable(axis="b", positions=(0, 1), forward=(0, 0), reverse=(0, 0)))

    async def act(served: Served) -> None:
        for axis, problem in ON_TOWERS.items():
            with pytest.raises(ApiError, match=problem):
                await served.call("table.send", **{**TABLE, "axis": axis})
        await served.call("table.remove", axis="b")

    world.live(act)
    assert TableStore(world.tables).load() == ({}, [])


def test_a_machine_without_the_section_has_no_tables(tmp_path: Path) -> None:
    stage = Stage(load(SCENARIOS / "clean.toml"), 1)

    async def act() -> None:
        async with running(Served(tmp_path, lambda: stage.description, stage.host)) as served:
            assert (await served.call("table.status"))["axes"] == []
            with pytest.raises(ApiError, match=r"axis x cannot have a table; add \[axis_tables\]"):
                await served.call("table.send", **TABLE)

    with asyncio.Runner(loop_factory=stage.make_loop) as runner:
        runner.run(act())


def test_damaged_and_oversized_tables_do_not_keep_the_machine_from_starting(tmp_path: Path) -> None:
    world = World(tmp_path)
    many = tuple(float(i) for i in range(POINTS + 1))
    store = TableStore(world.tables)
    store.save(
        AxisTable(axis="x", positions=many, forward=many[:1] * len(many), reverse=many[:1] * len(many))
    )
    (world.tables / "y.table.json").write_text("{")

    async def act(served: Served) -> None:
        await served.until(lambda: bool(served.tree.get("tables.x.problem")), "x")
        assert any("y.table.json is no kept table" in line for line in served.lines)
        assert any(
            "a table did not arrive: stepper_x forward has room for 32" in line for line in served.lines
        )
        assert str(served.service.state) == "ready"

    world.live(act)


def test_a_lossy_machine(tmp_path: Path) -> None:
    async def act(served: Served) -> None:
        for axis in ("x", "y", "z"):
            told = await served.call("table.send", **{**TABLE, "axis": axis})
            assert all(side["status"] == "ok" and side["active"] for side in told["axes"][0]["nodes"])

    World(tmp_path, "loss_1_percent").live(act)
