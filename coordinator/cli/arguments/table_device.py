"""The words of ``canductor table`` that go to a device instead of a machine that runs."""

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from coordinator.tables.axis_table import AxisTable, Direction, TableError
from nodes.mt.device_job import BAUD, DeviceJob, DeviceKind, Load
from nodes.mt.mt import AXLES
from nodes.support.can_protocol import MT_CAN_ID
from nodes.support.option_values import UsageError, number, share, whole

SHARE: Final = 0.2
"""Of a CAN bus, if not given: what a coordinator takes for tables, too."""
_CAN_IDS: Final = 0x7FF
_NODE_IDS: Final = 255
STEPPERS: Final = len(AXLES) // 2


def declare_device(action: argparse.ArgumentParser, *, sends: bool, has_file: bool) -> None:
    """Add the options; SENDS: of actions that send, HAS_FILE: a table."""
    add = action.add_argument_group("to drives and nodes, without a machine that runs").add_argument
    add(
        "--device",
        metavar="DEVICE",
        help="can0, virtual:PATH, INTERFACE:CHANNEL of python-can, a serial device or a pyserial URL",
    )
    add("--axles", metavar="N,…", help="of MT, 1..28")
    add("--stepper", metavar="K,…", help="its axles: 2K-1 for forward, 2K for reverse")
    if has_file:
        add("--side", choices=[str(side) for side in Direction], help="of the table, for --axles")
    if sends:
        add("--delay", metavar="MS", help="T: one word at a time, for drives that poll a register")
        add("--share", default=str(SHARE), help="of the CAN bus; 20%% if not given")
        add("--can-id", default=hex(MT_CAN_ID), metavar="ID", help=f"{MT_CAN_ID:#x} if not given")
    add("--node", metavar="ID,…", help="of nodes on the CAN bus that keep tables, and confirm")
    add("--link", action="store_true", help="such a node is at the other end of the serial line")
    add("--baud", default=str(BAUD), help=f"of the serial line; {BAUD} if not given")
    add("--bitrate", metavar="BIT/S", help="of the CAN bus, where the interface does not know it")
    add("--force", action="store_true", help="talk to nodes to which another program seems to talk")


def device_job(given: argparse.Namespace, table: AxisTable | None, *, sends: bool) -> DeviceJob:
    """Return what was asked for: TABLE (None: an empty one), or just a question. Raises CanductorError."""
    loads = _loads(given, table) if sends else ()
    asked = _axles(given)
    job = DeviceJob(
        device=given.device,
        loads=loads,
        axles=tuple(dict.fromkeys(axle for load in loads for axle in load.axles)) or asked or tuple(AXLES),
        delay_s=_delay_s(given) if sends else None,
        nodes=_numbers("--node", given.node, _NODE_IDS),
        link=given.link,
        force=given.force,
        baud=whole("--baud", given.baud, 50, 4_000_000),
        bitrate=None if given.bitrate is None else whole("--bitrate", given.bitrate, 10_000, 8_000_000),
        share=share("--share", given.share, 1.0) if sends else SHARE,
        can_id=_can_id(given.can_id) if sends else MT_CAN_ID,
    )
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


def _delay_s(given: argparse.Namespace) -> float | None:
    return None if given.delay is None else number("--delay", given.delay, 0.1, 10_000, "ms") / 1e3


def _can_id(text: str) -> int:
    try:
        found = int(text, 0)
    except ValueError:
        found = -1
    if not 0 <= found <= _CAN_IDS:
        raise UsageError(f"--can-id is '{text}', must be a number from 0 to 0x7ff")
    return found


def _numbers(option: str, text: str | None, high: int) -> tuple[int, ...]:
    words = [] if text is None else text.split(",")
    return tuple(dict.fromkeys(whole(option, word.strip(), 1, high) for word in words))


def _axles(given: argparse.Namespace) -> tuple[int, ...]:
    steppers = _numbers("--stepper", given.stepper, STEPPERS)
    return (*_numbers("--axles", given.axles, AXLES[-1]), *_of(steppers, *Direction))


def _of(steppers: "Iterable[int]", *sides: Direction) -> tuple[int, ...]:
    first = {Direction.FORWARD: 1, Direction.REVERSE: 0}
    return tuple(2 * k - first[side] for k in steppers for side in sides)


def _loads(given: argparse.Namespace, table: AxisTable | None) -> tuple[Load, ...]:
    """Return the transmissions: one for axles with the same table, as MT is meant."""
    axles = _numbers("--axles", given.axles, AXLES[-1])
    steppers = _numbers("--stepper", given.stepper, STEPPERS)
    if bool(axles) == bool(steppers):
        raise UsageError("give either --axles or --stepper: which of MT's axles the table is for")
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
            f"the table of {Path(given.file).name} differs by the direction of travel; say which the axles "
            "are for: --side forward or --side reverse"
        )
    return Direction(given.side or Direction.FORWARD)
