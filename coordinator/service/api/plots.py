"""``motion.dump``: what was planned and sent within the last seconds, for plotting."""

import asyncio
from collections.abc import Iterator, Sequence
from itertools import islice
from operator import attrgetter
from typing import Any, Final

from coordinator.ipc.protocol.methods import ApiError, Caller, Kind, Method, Param, Scope
from coordinator.motion.moves import Move
from coordinator.service.core.machine_service import MachineService
from coordinator.service.core.motion import Motion
from coordinator.service.state.sent_commands import read_batch
from coordinator.service.state.trace import KEEP_S
from coordinator.support.values import Value
from nodes.dictionary.dictionary import Dictionary

POINTS_AT_ONCE: Final = 4000
MOVES_MAX: Final = 4000
COMMANDS_MAX: Final = 4000
"""Of each moving node."""
_COLUMNS: Final = ("print_time", "accel_s", "cruise_s", "decel_s", "start_v", "cruise_v", "accel", "line")
REST: Final = 4.0
"""A dump keeps the interpreter busy for some 50 ms; for so many times as long there is no other."""
ROWS_AT_A_TIME: Final = 50
"""Takes half a millisecond."""


def plot_methods(service: MachineService) -> Iterator[Method]:
    """Return them."""
    dumping = asyncio.Lock()
    rest_until_s = 0.0

    async def dump(_caller: Caller, params: dict[str, Any]) -> Value:
        nonlocal rest_until_s
        motion, machine = service.ready_motion(), service.up_machine()
        clock_s = asyncio.get_running_loop().time
        if dumping.locked() or clock_s() < rest_until_s:
            raise ApiError("busy", "another dump is being made, or was just now; ask again in a moment")
        async with dumping:
            now_s = motion.now_s
            since_s = now_s - params["seconds"]
            senders = [
                _Sender(node.name, node.dictionary, motion, index)
                for index, node in enumerate(machine.moving)
            ]
            names = {
                (s.node, machine.devices.steppers[s.name].oid): s.name for s in machine.description.steppers
            }
            moves = motion.trace.moves(since_s)
            begun_s = clock_s()
            made = await _dump(now_s, since_s, moves, senders, names)
            rest_until_s = begun_s + (1 + REST) * (clock_s() - begun_s)
            return made

    def path(_caller: Caller, params: dict[str, Any]) -> Value:
        motion = service.motion or service.ready_motion()  # also of a machine that has stopped
        toolpath = motion.toolpath
        first = params["first"] if params["generation"] == toolpath.generation else 0
        corners = toolpath.after(first, POINTS_AT_ONCE)
        return {
            "generation": toolpath.generation,
            "first": first,
            "count": len(toolpath),
            "x": corners.x,
            "y": corners.y,
            "z": corners.z,
            "print_time_s": corners.time_s,
            "extrudes": corners.extrudes,
        }

    yield Method(
        "motion.path",
        Scope.WATCH,
        f"Return corners of the tool's path since the job began, planned ones too; at most {POINTS_AT_ONCE}.",
        path,
        params=(
            Param("generation", Kind.INT, "of the points known", required=False, default=0, low=0),
            Param("first", Kind.INT, "number of the first one wanted", required=False, default=0, low=0),
        ),
        returns=(
            Param("generation", Kind.INT, "another one than known: what was known is void"),
            Param("first", Kind.INT, "number of the first point returned"),
            Param("count", Kind.INT, "of all points"),
            *(Param(axis, Kind.LIST, "of each point, in the machine's frame", "mm") for axis in "xyz"),
            Param("print_time_s", Kind.LIST, "when the tool is there", "s"),
            Param("extrudes", Kind.LIST, "whether it extrudes on the way there"),
        ),
    )
    yield Method(
        "motion.dump",
        Scope.WATCH,
        "Return the trajectory and the step queues from SECONDS ago to what is planned ahead.",
        dump,
        params=(Param("seconds", Kind.FLOAT, "", "s", required=False, default=5.0, low=0.0, high=KEEP_S),),
        returns=(
            Param("now_s", Kind.FLOAT, "present print time", "s"),
            Param("moves", Kind.MAP, "columns: " + ", ".join(_COLUMNS) + ", start and ratio (X Y Z E)"),
            Param("queues", Kind.LIST, "by moving node: columns stepper, due_s, interval_s, count and add_s"),
            Param("truncated", Kind.BOOL, "whether the oldest were left out"),
        ),
    )


class _Sender:
    """What was sent to one node, and how to read it; made on the control loop, read elsewhere."""

    def __init__(self, name: str, dictionary: Dictionary, motion: Motion, index: int) -> None:
        self.name = name
        self.dictionary = dictionary
        self.batches = motion.trace.batches(index)
        self.piece = motion.streamer.worker.maps[index].last

    def print_time(self, ticks: int) -> float:
        """Return the print time of TICKS, good for seconds around the present."""
        return self.piece.print_time + (ticks - self.piece.ticks) / self.piece.ticks_per_s


async def _dump(
    now_s: float,
    since_s: float,
    moves: Sequence[Move],
    senders: Sequence[_Sender],
    names: dict[tuple[str, int | None], str],
) -> Value:
    kept = moves[-MOVES_MAX:]
    queues = [await _queue(sender, since_s, names) for sender in senders]
    columns: dict[str, Value] = {name: list(map(attrgetter(name), kept)) for name in _COLUMNS}
    columns |= {name: [list(getattr(move, name)) for move in kept] for name in ("start", "ratio")}
    truncated = len(kept) < len(moves) or any(full for _, full in queues)
    return {
        "now_s": now_s,
        "moves": columns,
        "queues": [queue for queue, _ in queues],
        "truncated": truncated,
    }


async def _queue(
    sender: _Sender, since_s: float, names: dict[tuple[str, int | None], str]
) -> tuple[dict[str, Value], bool]:
    """Return the newest queue_step commands of one node, and whether older ones were left out."""
    found = []
    # Reading commands one by one takes Python a while. In a thread it would take the interpreter from the
    # control loop at each of its calls to a socket, for 5 ms; so the loop does it, some at a time.
    for row in islice(_newest_first(sender, since_s), COMMANDS_MAX + 1):
        found.append(row)
        if len(found) % ROWS_AT_A_TIME == 0:
            await asyncio.sleep(0)
    full = len(found) > COMMANDS_MAX
    rows = found[:COMMANDS_MAX][::-1]
    per_tick_s = 1 / sender.piece.ticks_per_s
    columns: dict[str, Value] = {
        "node": sender.name,
        "stepper": [names.get((sender.name, row[1]), "") for row in rows],
        "due_s": [round(row[0], 6) for row in rows],
        "interval_s": [row[2] * per_tick_s for row in rows],
        "count": [row[3] for row in rows],
        "add_s": [row[4] * per_tick_s for row in rows],
    }
    return columns, full


def _newest_first(sender: _Sender, since_s: float) -> Iterator[tuple[float, int, int, int, int]]:
    """Yield print time, oid, interval, count and add of every queue_step, back to SINCE_S."""
    for batch in reversed(sender.batches):
        for due, command in reversed(read_batch(batch)):
            due_s = sender.print_time(due)
            if due_s < since_s:
                return
            for message in sender.dictionary.decode_commands(command) or ():
                if message.name == "queue_step":
                    oid, interval, count, add = (
                        message.integer(name) for name in ("oid", "interval", "count", "add")
                    )
                    yield due_s, oid, interval, count, add
