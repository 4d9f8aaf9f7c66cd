"""The options of ``canductor table`` for drives and nodes at a device, without a running machine."""

import argparse
from collections.abc import Iterable
from functools import partial
from typing import Final

from coordinator.tables.axis_table import AxisTable, Direction, TableError
from nodes.mt.device_job import BAUD, SHARE, DeviceJob, DeviceKind, Load
from nodes.mt.mt import AXLES
from nodes.support.can_protocol import MT_CAN_ID
from nodes.support.option_values import (
    UsageError,
    integer,
    options_from,
    parse_float,
    parse_hex,
    parse_int,
    parse_ratio,
)

_CAN_IDS: Final = 0x7FF
_NODE_IDS: Final = 255
STEPPERS: Final = len(AXLES) // 2


def declare_device(action: argparse.ArgumentParser, *, sends: bool, has_file: bool) -> None:
    """Add the options; SENDS: for actions that send, HAS_FILE: that send a table."""
    add = action.add_argument_group("drives and nodes, without a running machine").add_argument
    add(
        "--device",
        metavar="DEVICE",
        help="can0, virtual:PATH, INTERFACE:CHANNEL of python-can, a serial device or a pyserial URL",
    )
    add(
        "--axles",
        type=partial(_numbers, high=AXLES[-1]),
        default=(),
        metavar="N,…",
        help="axles of MT, 1 to 28",
    )
    add(
        "--stepper",
        dest="steppers",
        type=partial(_numbers, high=STEPPERS),
        default=(),
        metavar="K,…",
        help="both axles of a stepper: 2K-1 (forward) and 2K (reverse)",
    )
    if has_file:
        sides = [str(side) for side in Direction]
        add("--side", choices=sides, help="side of the table to send to --axles")
    if sends:
        add(
            "--delay",
            dest="delay_s",
            type=_delay_s,
            metavar="MS",
            help="send one word every MS milliseconds, for drives that poll a register",
        )
        add(
            "--share",
            type=partial(parse_ratio, high=1.0),
            default=SHARE,
            metavar="RATIO",
            help="ratio of the CAN bus to use",
        )
        add(
            "--can-id",
            type=partial(parse_hex, high=_CAN_IDS),
            default=MT_CAN_ID,
            metavar="ID",
            help=f"CAN id of the tables (default: {MT_CAN_ID:#x})",
        )
    add(
        "--node",
        dest="nodes",
        type=partial(_numbers, high=_NODE_IDS),
        default=(),
        metavar="ID,…",
        help="nodes on the CAN bus that keep tables, and confirm them",
    )
    add("--link", action="store_true", help="a node that keeps tables is at the other end of the serial line")
    add(
        "--baud",
        type=integer(50, 4_000_000),
        default=BAUD,
        metavar="BIT/S",
        help="baud rate of the serial line",
    )
    add(
        "--bitrate",
        type=integer(10_000, 8_000_000),
        metavar="BIT/S",
        help="bit rate of the CAN bus, if the interface does not know it",
    )
    add("--force", action="store_true", help="talk to nodes even if another program seems to use them")


def device_job(given: argparse.Namespace, table: AxisTable | None, *, sends: bool) -> DeviceJob:
    """Return the job: to send TABLE (None: an empty one), or only to query.

    Raises CanductorError, UsageError.
    """
    loads = _loads(given, table) if sends else ()
    asked = (*_of(given.steppers, *Direction), *given.axles)
    axles = tuple(dict.fromkeys(axle for load in loads for axle in load.axles)) or asked or tuple(AXLES)
    job = options_from(DeviceJob, given, loads=loads, axles=axles)
    _check(job)
    return job


def _check(job: DeviceJob) -> None:
    if job.kind is DeviceKind.CAN and job.link:
        raise UsageError("--link is for a serial line; nodes on a CAN bus are named by --node ID")
    if job.kind is DeviceKind.SERIAL and job.nodes:
        raise UsageError("--node is for a CAN bus; a serial line has one node, give --link")
    if job.kind is DeviceKind.SERIAL and job.link and "://" in job.device:
        raise UsageError(f"--link needs a serial device, not the URL '{job.device}'")
    if not job.share > 0:
        raise UsageError("--share is 0; tables need some of the bus")


def _delay_s(text: str) -> float:
    return parse_float(text, 0.1, 10_000, "ms") / 1e3


def _numbers(text: str, high: int) -> tuple[int, ...]:
    return tuple(dict.fromkeys(parse_int(word.strip(), 1, high) for word in text.split(",")))


def _of(steppers: Iterable[int], *sides: Direction) -> tuple[int, ...]:
    first = {Direction.FORWARD: 1, Direction.REVERSE: 0}
    return tuple(2 * k - first[side] for k in steppers for side in sides)


def _loads(given: argparse.Namespace, table: AxisTable | None) -> tuple[Load, ...]:
    """Return the transmissions: one for all axles with the same table, as MT intends."""
    axles, steppers = given.axles, given.steppers
    if bool(axles) == bool(steppers):
        raise UsageError("give either --axles or --stepper, the axles of MT that the table is for")
    if table is None:
        return (Load(axles or _of(steppers, *Direction), ()),)
    if axles:
        return (Load(axles, tuple(table.pairs(_side(given, table)))),)
    if given.side is not None:
        raise UsageError("--side goes with --axles; a stepper gets both sides")
    if table.symmetric:
        return (Load(_of(steppers, *Direction), tuple(table.pairs(Direction.FORWARD))),)
    return tuple(Load(_of(steppers, side), tuple(table.pairs(side))) for side in Direction)


def _side(given: argparse.Namespace, table: AxisTable) -> Direction:
    if given.side is None and not table.symmetric:
        raise TableError(
            f"the table of {given.file.name} differs by the direction of travel; say which the axles "
            "are for: --side forward or --side reverse"
        )
    return Direction(given.side or Direction.FORWARD)
