"""Fills the state tree: reads counters that are there anyway, asks no node, and takes a millisecond.

docs/run.md lists the fields; names end in their unit.
"""

import re
from collections import deque
from collections.abc import Iterator
from typing import Final

from coordinator.ipc.server.state import StateTree
from coordinator.motion.planner.planner import AXIS_LETTERS, Position
from coordinator.runtime.machine import Machine, link_of
from coordinator.service.core.interface import ServiceInterface
from coordinator.service.core.motion import Motion
from coordinator.service.jobs.jobs import JobRun
from coordinator.support.values import Value
from nodes.link import BusLoad, IOStats, LinkStats
from nodes.node.node import Node
from nodes.node.states import NodeState
from nodes.support.errors import CanductorError

RECENT_S: Final = 0.95
"""A lead is recent for so long, or since the last look where that is longer ago."""
LOOKS_MAX: Final = 32
"""That are kept within that time."""
_NOT_IN_A_PATH = re.compile(r"[^A-Za-z0-9_-]")


def field_name(name: str) -> str:
    """Return NAME as part of a path: what could be read as more than one part becomes ``_``."""
    return _NOT_IN_A_PATH.sub("_", name)


class Figures:
    """Shows a service in TREE."""

    def __init__(self, tree: StateTree) -> None:
        self._tree = tree
        self._leads: dict[str, _RecentLead] = {}
        self._shown: set[str] = set()
        """Prefixes of the nodes and buses shown, to be taken away with them."""

    def show(self, service: ServiceInterface) -> None:
        """Bring the tree up to date."""
        for _ in self.parts(service):
            pass

    def parts(self, service: ServiceInterface) -> Iterator[None]:
        """Do the same in parts of some 0.2 ms, so that others get their turn between two of them."""
        self._tree.update("job", job_figures(service.job, service.now_s))
        if service.motion is not None and service.machine is not None and service.machine.stopped is None:
            self._tree.update("position", position_figures(service.motion))
            waiting: Value = service.motion.streamer.held
            self._tree.set("machine.waits_for", waiting)
            self._tree.update("machine", lead_figures(service.motion))
        else:
            self._tree.update("position", {"moving": False, "velocity_mm_s": 0.0, "homed": ""})
            self._tree.set("machine.lead_ms", None)
        if service.confirmed_s:
            confirmed: Value = {name: round(s * 1e3, 1) for name, s in service.confirmed_s.items()}
            self._tree.set("machine.stop_confirmed_ms", confirmed)
        yield
        if service.machine is not None:
            machine = service.machine
            for _ in self._machine_parts(machine):
                yield
                if service.machine is not machine:
                    return  # it is closed

    def _machine_parts(self, machine: "Machine") -> Iterator[None]:
        shown: set[str] = set()
        for name, node in list(machine.nodes.items()):  # they are added meanwhile, at a start
            prefix = f"nodes.{field_name(name)}"
            shown.add(prefix)
            recent = self._leads.setdefault(name, _RecentLead())
            self._tree.update(prefix, node_figures(machine, node, recent))
            yield
        for name, stats in machine.bus_stats().items():
            prefix = f"buses.{field_name(name)}"
            shown.add(prefix)
            self._tree.update(prefix, bus_figures(name, stats))
        for name, status in machine.modules.status().items():
            prefix = f"modules.{field_name(name)}"
            shown.add(prefix)
            self._tree.update(prefix, status)
        for prefix in self._shown - shown:
            self._tree.remove(prefix)
        self._shown = shown


# ------------------------------------------------------------------------------------------- machine, job


def job_figures(job: "JobRun | None", now_s: float) -> dict[str, Value]:
    """Return what there is to say of a job."""
    if job is None:
        return {"state": "none", "file": None, "progress": 0.0}
    return {
        "state": str(job.phase),
        "file": job.file,
        "size_bytes": job.size_bytes,
        "done_bytes": job.done_bytes,
        "read_bytes": job.read_bytes,
        "progress": round(job.progress, 4),
        "line": job.line,
        "lines_read": job.lines_read,
        "lines_fed": job.lines_fed,
        "print_time_s": round(job.print_time_s, 1),
        "elapsed_s": round((job.ended_s or now_s) - job.began_s, 1),
        "message": job.message,
    }


def position_figures(motion: "Motion") -> dict[str, Value]:
    """Return where the machine is, in all frames; mm, program units for ``gcode``."""
    moment, state = motion.moment(), motion.planned.state
    return {
        "commanded": axes(moment.position),
        "planned": axes(state.toolhead_position),
        "gcode": axes(state.gcode_position),
        "origin": axes(state.gcode_base),
        "velocity_mm_s": round(moment.velocity_mm_s, 3),
        "moving": not motion.standing,
        "homed": state.homed,
        "speed_factor": state.speed_factor,
        "extrude_factor": state.extrude_factor,
        "print_time_s": round(motion.now_s, 3),
    }


def lead_figures(motion: "Motion") -> dict[str, Value]:
    """Return how far ahead commands are made, in ms."""
    lead = motion.lead
    return {"lead_ms": _ms(lead.now_s), "lead_min_ms": _ms(lead.least_s)}


def _ms(seconds: float | None) -> float | None:
    return None if seconds is None else round(seconds * 1e3, 1)


def axes(position: Position) -> Value:
    """Return a position by axis letter, to the nanometre."""
    return {letter.lower(): round(value, 6) for letter, value in zip(AXIS_LETTERS, position, strict=True)}


# ----------------------------------------------------------------------------------------- nodes, buses


class _RecentLead:
    """The smallest lead of the last second, from two histograms."""

    def __init__(self) -> None:
        self._seen: deque[tuple[float, tuple[int, ...]]] = deque(maxlen=LOOKS_MAX)

    def look(self, histogram: tuple[int, ...], now_s: float) -> float | None:
        """Take the newest histogram; return where the lowest bin that grew begins, ms.

        None: no motion command was acknowledged.
        """
        while len(self._seen) > 1 and self._seen[1][0] <= now_s - RECENT_S:
            self._seen.popleft()
        before = self._seen[0][1] if self._seen else histogram
        self._seen.append((now_s, histogram))
        if len(before) != len(histogram):
            return None
        grown = (k for k, (a, b) in enumerate(zip(before, histogram, strict=True)) if b > a)
        lowest = next(grown, None)
        return None if lowest is None else lead_edge_ms(lowest)


def lead_edge_ms(index: int) -> float:
    """Return where bin INDEX of a lead histogram begins, ms; -1 for late ones."""
    return -1.0 if index == 0 else 0.0 if index == 1 else float(2 ** (index - 2))


def node_figures(machine: "Machine", node: Node, recent: _RecentLead) -> dict[str, Value]:
    """Return what the host knows of a node without asking it."""
    bus, nodeid, uuid = machine.address(node)
    figures: dict[str, Value] = {
        "name": node.name,
        "bus": bus,
        "nodeid": nodeid,
        "uuid": uuid,
        "state": node.state.name.lower(),
        "state_text": node.state.value,
        "failure": str(node.failure) if node.failure is not None else None,
        "policy": machine.policies[node.name].value,
    }
    if node.state not in (NodeState.CONNECTING, NodeState.IDENTIFYING):
        figures |= _firmware(node)
    figures |= _clock(node)
    load = node.load
    figures["load_awake"] = None if load is None else round(load.awake, 4)
    figures["load_task_us"] = None if load is None else round(load.task_s * 1e6, 2)
    try:
        stats = link_of(node).stats()
    except CanductorError:
        return figures  # as it was last seen
    return figures | _link(stats, recent, machine.host.now() * 1e-9)


def _firmware(node: Node) -> dict[str, Value]:
    dictionary = node.dictionary
    try:
        return {
            "mcu": dictionary.str_constant("MCU", "unknown"),
            "firmware": dictionary.app,
            "firmware_version": dictionary.version,
            "clock_freq_hz": dictionary.clock_freq_hz,
            "move_count": node.move_count,
        }
    except CanductorError:  # lost before it was known
        return {"mcu": "unknown", "firmware_version": ""}


def _clock(node: Node) -> dict[str, Value]:
    error_s = node.clock_error_s
    try:
        clock_freq_hz = node.clock_freq_hz
    except CanductorError:  # it is brought back, and its dictionary is not known yet
        error_s = None
    if error_s is None:
        return {"clock_error_us": None, "clock_drift_ppm": None, "clock_offset_s": None, "clock_source": None}
    estimate = node.clock.estimate()
    drift = estimate.freq_hz / clock_freq_hz - 1.0
    offset_s = estimate.at_ticks / clock_freq_hz - estimate.at_ns * 1e-9
    return {
        "clock_error_us": round(error_s * 1e6, 2),
        "clock_drift_ppm": round(drift * 1e6, 3),
        "clock_offset_s": round(offset_s, 7),
        "clock_source": node.clock_source,
    }


def _link(stats: LinkStats, recent: _RecentLead, now_s: float) -> dict[str, Value]:
    histogram: Value = list(stats.lead_histogram)
    return {
        "round_trip_ms": round(stats.srtt_s * 1e3, 3),
        "queue_commands": stats.motion_commands,
        "queue_commands_max": stats.motion_commands_max,
        "control_commands": stats.control_commands,
        "commands_sent": stats.commands_sent,
        "bytes_sent": stats.bytes_sent,
        "retransmitted_blocks": stats.blocks_repeated,
        "retransmitted_bytes": stats.bytes_repeated,
        "invalid_bytes": stats.bytes_invalid,
        "lead_ms": recent.look(stats.lead_histogram, now_s),
        "lead_min_ms": _ms(stats.min_lead_s),
        "lead_histogram": histogram,
    }


def bus_figures(name: str, stats: IOStats) -> dict[str, Value]:
    """Return how a bus does."""
    return {
        "name": name,
        "bitrate": stats.bitrate,
        "frames_sent": stats.frames_sent,
        "frames_received": stats.frames_received,
        "frames_malformed": stats.frames_malformed,
        "frames_dropped": stats.frames_dropped,
        "bytes_sent": stats.bytes_sent,
        "bytes_received": stats.bytes_received,
        "send_waits": stats.waits,
        **load_figures(stats.load),
    }


def load_figures(load: BusLoad) -> dict[str, Value]:
    """Return shares of the bit rate within the last second, by class."""
    shares = {
        "motion": load.motion,
        "control": load.control,
        "bulk": load.bulk,
        "acks": load.acks,
        "data": load.data,
        "weak": load.weak,
        "total": load.total,
    }
    return {f"load_{name}": round(share, 4) for name, share in shares.items()}
