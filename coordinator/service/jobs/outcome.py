"""The result of a job, as the host and the counters of its nodes report it."""

from dataclasses import dataclass

from coordinator.runtime.machine import Machine, link_of
from coordinator.runtime.timebase import ClockMap
from coordinator.service.core.motion import Motion
from coordinator.service.jobs.jobs import JobRun
from coordinator.streaming.streamer import Streamer
from coordinator.support.progress import NodeFigures, Progress
from nodes.link import LinkStats
from nodes.node.states import NodeState
from nodes.support.errors import CanductorError


@dataclass(frozen=True, slots=True)
class NodeOutcome:
    """A node after a job."""

    name: str
    link: LinkStats
    clock_error_s: float
    """Upper bound, as the clock estimator states it."""

    def to_text(self) -> str:
        """Return the figures as one line."""
        link = self.link
        lead = "no motion" if link.min_lead_s is None else f"lead at least {link.min_lead_s * 1e3:.0f} ms"
        return (
            f"node {self.name}: {link.bytes_sent:,} bytes sent, {link.bytes_repeated:,} of them again, "
            f"{lead}, round trip {link.srtt_s * 1e3:.2f} ms, clock known to {self.clock_error_s * 1e6:.1f} µs"
        )


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of a job that was carried out to its end."""

    moves: int
    print_time_s: float
    span: tuple[float, float]
    """Print times of start and end."""
    steps: int
    queue_steps: int
    positions: dict[str, int]
    """By stepper: steps that the job moved it by, as its node counts them."""
    issued: dict[str, int]
    """By stepper: sum of the steps in the host's commands."""
    maps: dict[str, ClockMap]
    """By moving node: print time to ticks."""
    nodes: tuple[NodeOutcome, ...]


async def outcome_of(machine: Machine, streamer: Streamer) -> Outcome:
    """Return the result of what STREAMER, which has ended, did on MACHINE; raises CanductorError."""
    ended_at = await machine.query_stepper_counts()
    stats = streamer.worker.steps.stats()
    return Outcome(
        moves=streamer.worker.pipeline.moves,
        print_time_s=streamer.ended_s - streamer.began_s,
        span=(streamer.began_s, streamer.ended_s),
        steps=sum(s.steps for s in stats.steppers),
        queue_steps=sum(s.queue_steps for s in stats.steppers),
        positions={name: ended_at[name] - began for name, began in streamer.worker.began_at.items()},
        issued={s.name: s.issued for s in stats.steppers},
        maps={node.name: m for node, m in zip(machine.moving, streamer.worker.maps, strict=True)},
        nodes=tuple(
            NodeOutcome(node.name, link_of(node).stats(), node.clock_error_s or 0.0)
            for node in machine.nodes.values()
            if node.state is NodeState.READY  # an optional one may be absent
        ),
    )


def job_progress(machine: Machine, motion: Motion, job: JobRun, now_s: float) -> Progress:
    """Return how far JOB is carried out at NOW_S of the host's time, and how the links to its nodes do."""
    return Progress(
        done=job.done_bytes,
        total=job.size_bytes,
        print_time_s=motion.streamer.executed_s,
        wall_time_s=now_s - job.began_s,
        nodes=tuple(_node_figures(machine, name) for name in machine.nodes),
    )


def _node_figures(machine: Machine, name: str) -> NodeFigures:
    node = machine.nodes[name]
    try:
        stats = link_of(node).stats()
    except CanductorError:
        return NodeFigures(name=name)
    return NodeFigures(
        name=name,
        round_trip_ms=stats.srtt_s * 1e3,
        retransmitted_bytes=stats.bytes_repeated,
        queue_depth=stats.motion_commands,
        lead_ms=None if stats.min_lead_s is None else stats.min_lead_s * 1e3,
        clock_error_us=None if node.clock_error_s is None else node.clock_error_s * 1e6,
    )
