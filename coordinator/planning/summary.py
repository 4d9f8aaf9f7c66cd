"""From a finished plan to its report, and to the files that keep it."""

import json
import math
import resource
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from coordinator.config.model import CanConnection, MachineDescription
from coordinator.motion.specs import NodeStreamSpec, StepperSpec
from coordinator.planning.figures import Bus, Peak, PlanFigures, WatchedNode
from coordinator.planning.options import PlanOptions
from coordinator.planning.plot import draw
from coordinator.planning.report import AxisReport, BusReport, NodeReport, PlanReport, StepperReport, Timeline
from coordinator.planning.warnings import (
    CEILING,
    NodeClock,
    bus_warnings,
    queue_warnings,
    slowed_warnings,
    step_rate_warnings,
)
from coordinator.streaming.pipeline import Pipeline
from nodes.support.errors import CanductorError


def watched_nodes(
    description: MachineDescription, streams: Sequence[NodeStreamSpec], can_bitrate: int
) -> list[WatchedNode]:
    """Return the nodes of STREAMS with the buses they are on."""
    connections = {node.name: node.connection for node in description.nodes}
    result = []
    for stream in streams:
        at = connections[stream.name]
        on_can = isinstance(at, CanConnection)
        result.append(
            WatchedNode(
                name=stream.name,
                bus=at.interface if isinstance(at, CanConnection) else at.path,
                bitrate=can_bitrate if isinstance(at, CanConnection) else at.baud,
                is_serial=not on_can,
                clock_freq=stream.clock_freq,
                queue_step_id=stream.queue_step_id,
            )
        )
    return result


@dataclass(frozen=True, slots=True)
class PlanResult:
    """A plan that is finished."""

    description: MachineDescription
    pipeline: Pipeline
    figures: PlanFigures
    streams: Sequence[NodeStreamSpec]
    specs: Sequence[StepperSpec]
    chips: Mapping[str, str]
    """Constant MCU by node."""
    notices: list[str]
    print_time_s: float

    def report(self) -> PlanReport:
        """Return the report; CPU time and memory are as of now."""
        stats = self.pipeline.steps.stats()
        usage = resource.getrusage(resource.RUSAGE_SELF)
        steppers, nodes, buses = self._steppers(), self._nodes(), self.figures.buses()
        bus_reports = tuple(self._bus(bus) for bus in buses)
        flow = self.figures.flow
        return PlanReport(
            gcode=self.pipeline.job.name,
            moves=self.pipeline.moves,
            print_time_s=self.print_time_s,
            steps=sum(s.steps for s in stats.steppers),
            queue_steps=sum(s.queue_steps for s in stats.steppers),
            bytes_to_nodes=sum(n.framed_bytes for n in stats.nodes),
            cpu_s=usage.ru_utime + usage.ru_stime,
            peak_rss_mb=_peak_rss_mb(),
            path_speed=self.figures.path_speed,
            flow=replace(flow, value=flow.value * self._filament_mm2),
            axes=tuple(
                AxisReport(name, self.figures.axis_speed(i), self.figures.axis_accel(i))
                for i, name in enumerate("XYZE")
            ),
            steppers=steppers,
            nodes=nodes,
            buses=bus_reports,
            slowed=self.pipeline.planner.slowed,
            timeline=Timeline(
                bin_s=self.figures.bin_s,
                speed_mm_s=_rounded(self.figures.speeds()),
                flow_mm3_s=_rounded(tuple(v * self._filament_mm2 for v in self.figures.flows())),
                bus_load={bus.name: _rounded(bus.load) for bus in buses},
            ),
            warnings=tuple(self._warnings(steppers, nodes, bus_reports)),
            notices=tuple(self.notices),
            unsupported=tuple(str(entry) for entry in self.description.unsupported),
            written=(),
        )

    @property
    def _filament_mm2(self) -> float:
        extruder = self.description.extruder
        return math.pi / 4 * extruder.filament_diameter**2 if extruder else 0.0

    def _steppers(self) -> tuple[StepperReport, ...]:
        result = []
        for spec, stats in zip(self.specs, self.pipeline.steps.stats().steppers, strict=True):
            rate = self.figures.step_rate(spec.node, spec.oid)
            result.append(
                StepperReport(
                    name=spec.name,
                    node=self.streams[spec.node].name,
                    steps=stats.steps,
                    queue_steps=stats.queue_steps,
                    max_step_rate=rate.value,
                    max_step_rate_line=rate.line,
                    worst_error_us=stats.worst_error_s * 1e6,
                )
            )
        return tuple(result)

    def _nodes(self) -> tuple[NodeReport, ...]:
        bus_of = {n.name: n for n in watched_nodes(self.description, self.streams, 1)}
        return tuple(
            NodeReport(
                name=stats.name,
                bus=bus_of[stats.name].bus,
                commands=stats.commands,
                bytes=stats.framed_bytes,
                max_step_rate=max(self.figures.node_steps(index), default=0.0),
                max_slots=stats.max_slots,
                move_count=self.streams[index].move_count,
                late_slots=stats.late_slots,
            )
            for index, stats in enumerate(self.pipeline.steps.stats().nodes)
        )

    def _bus(self, bus: Bus) -> BusReport:
        peak = self._busiest(bus.load)
        return BusReport(
            name=bus.name,
            kind=bus.kind,
            bitrate=bus.bitrate,
            bits=bus.bits,
            mean_load=bus.bits / bus.bitrate / self.print_time_s if self.print_time_s > 0 else 0.0,
            peak_load=peak.value,
            peak_print_time_s=peak.print_time_s,
            peak_line=peak.line,
            over_ceiling_s=sum(load > CEILING for load in bus.load) * self.figures.bin_s,
        )

    def _busiest(self, bins: Sequence[float]) -> Peak:
        if not bins:
            return Peak(0.0, 0.0, 0)
        at = max(range(len(bins)), key=bins.__getitem__)
        # The middle of the bin: its border may round into the bin before.
        return Peak(bins[at], at * self.figures.bin_s, self.figures.line((at + 0.5) * self.figures.bin_s))

    def _warnings(
        self,
        steppers: tuple[StepperReport, ...],
        nodes: tuple[NodeReport, ...],
        buses: tuple[BusReport, ...],
    ) -> list[str]:
        program = self.pipeline.job.name
        warnings = [*bus_warnings(program, buses), *queue_warnings(program, nodes)]
        warnings += slowed_warnings(program, self.pipeline.planner.slowed)
        for index, stream in enumerate(self.streams):
            together = self._busiest(self.figures.node_steps(index))
            mine = [s for s in steppers if s.node == stream.name]
            clock = NodeClock(stream.name, self.chips.get(stream.name, ""), stream.clock_freq)
            warnings += step_rate_warnings(program, clock, together, mine)
        return warnings


def _rounded(values: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(float(f"{value:.5g}") for value in values)


def write_files(options: PlanOptions, report: PlanReport) -> PlanReport:
    """Write the plot and, next to the streams, the report; return it with their names. CanductorError."""
    paths = [options.output / f"{node.name}.batch" for node in report.nodes] if options.output else []
    plots = [options.plot] if options.plot else []
    if options.output:
        plots.append(options.output / "plan.svg")
    if not plots:
        return report
    picture = draw(report.gcode, report.timeline)
    for path in plots:
        _write(path, picture)
    paths += plots
    if options.output:
        paths.append(options.output / "plan.json")
        _write(paths[-1], json.dumps({"ok": True, **report.to_json()}, indent=1, allow_nan=False) + "\n")
    return replace(report, written=tuple(map(str, paths)))


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise CanductorError(f"cannot write {path}: {error.strerror}; name another file") from None


def _peak_rss_mb() -> float:
    """Return the most memory that this process had. getrusage includes that of the parent process."""
    with Path("/proc/self/status").open(encoding="ascii", errors="replace") as status:
        return next(int(line.split()[1]) / 1024 for line in status if line.startswith("VmHWM:"))
