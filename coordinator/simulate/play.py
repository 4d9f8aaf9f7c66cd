"""One seed of one scenario: runs it on its stage, then checks the result."""

import asyncio
import contextlib
import hashlib
import time
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any, Final

from coordinator.config.model import StepperDescription
from coordinator.gcode.program import Program
from coordinator.runtime.machine import Machine, link_of
from coordinator.service.core.job_runner import run_job
from coordinator.service.jobs.outcome import Outcome
from coordinator.simulate import checker, truth
from coordinator.simulate.checker import Ending, OutputTruth, QueueDepth, StepperTruth, Violation
from coordinator.simulate.program import make_program
from coordinator.simulate.result import Result
from coordinator.simulate.scenario import OutputSetting, Scenario
from coordinator.simulate.stage import Stage
from coordinator.streaming.pipeline import PlanRecord
from coordinator.support.toml_values import ScenarioError
from nodes.link import Link
from nodes.support.errors import CanductorError

LIMIT_S: Final = 90.0
"""Simulated time after which a run hangs."""
AFTERWARDS_S: Final = 2.0
"""How long the boards run after the end, so that a board that still steps is detected."""
LINK_CONTROL_BYTES: Final = 1 << 15
LINK_MOTION_BYTES: Final = 1 << 20
"""Bounds of the queues of a link."""
BY_THE_USER: Final = "stopped by the user"


def play(scenario: Scenario, seed: int) -> Result:
    """Run SEED of SCENARIO and return the result; exceptions of the code under test pass through."""
    began_s = time.process_time()
    stage = Stage(scenario, seed)
    run = _Run(stage)
    run.perform()
    return _judge(stage, run, began_s)


@dataclass(slots=True)
class _Run:
    """The run of the coordinator, and what was recorded of it."""

    stage: Stage
    record: PlanRecord = field(default_factory=lambda: PlanRecord((0.0, 0.0, 0.0, 0.0)))
    outcome: Outcome | None = None
    cause: str | None = None
    stopped_ns: int | None = None
    job_ns: int = 0
    ready_s: float = 0.0
    links: dict[str, Link] = field(default_factory=dict)
    both_edges: dict[str, bool] = field(default_factory=dict)
    found: list[Violation] = field(default_factory=list)
    watch: asyncio.Task[None] | None = None
    """Keeps the task that notes the stop alive."""

    def perform(self) -> None:
        """Connect, run the job, and keep the boards running for a while afterwards."""
        with asyncio.Runner(loop_factory=self.stage.make_loop) as runner:
            runner.get_loop().set_exception_handler(self._exception)
            try:
                self.outcome = runner.run(self._main())
            except ScenarioError:
                raise  # an error in the file, not of the machine
            except CanductorError as error:
                self.cause = str(error)
            except asyncio.CancelledError:
                self.cause = BY_THE_USER
            except TimeoutError:
                self.found.append(Violation("exception", f"not over after {LIMIT_S:g} simulated seconds"))
            if self.cause is not None and self.stopped_ns is None:
                self.stopped_ns = self.stage.now_ns()
            runner.run(asyncio.sleep(AFTERWARDS_S))

    async def _main(self) -> Outcome:
        self.stage.faults.begin("start", self._interrupt())
        text = make_program(self.stage.scenario.program, self.stage.dice)
        program = Program(BytesIO(text.encode()), "job")
        async with asyncio.timeout(LIMIT_S):
            return await run_job(
                self.stage.description,
                program,
                record=self.record,
                on_output=lambda _: None,
                on_ready=self._ready,
                host=self.stage.host,
            )

    def _interrupt(self) -> Any:
        task = asyncio.current_task()
        assert task is not None
        return task.cancel

    def _ready(self, machine: Machine) -> None:
        self.job_ns = self.stage.now_ns()
        self.ready_s = self.stage.elapsed_s()
        for name, node in machine.nodes.items():
            with contextlib.suppress(CanductorError):  # an optional node may be absent
                self.links[name] = link_of(node)
        self.both_edges = {name: s.steps_on_both_edges for name, s in machine.devices.steppers.items()}
        self.stage.faults.begin("job", self._interrupt())
        self.watch = asyncio.get_running_loop().create_task(self._note_stop(machine))

    async def _note_stop(self, machine: Machine) -> None:
        await machine.wait_stopped()
        self.stopped_ns = self.stage.now_ns()

    def _exception(self, _: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        error = context.get("exception")
        self.found.append(Violation("exception", f"{context['message']}: {type(error).__name__}: {error}"))


# ---------------------------------------------------------------------------------------------- judgement


def _judge(stage: Stage, run: _Run, began_s: float) -> Result:
    scenario = stage.scenario
    ending = _ending(stage, run)
    found = [*run.found, *checker.check_ending(scenario.expect, scenario.causes, ending)]
    steppers = [_stepper(stage, run, ending, stepper) for stepper in stage.description.steppers]
    for stepper in steppers:
        found += checker.check_stepper(stepper, stage.print_time, ending)
    for name, setting in scenario.outputs.items():
        found += checker.check_output(_output(stage, ending, name, setting), ending)
    found += checker.check_queues([*_link_queues(run), *stage.queues()])
    errors_us = {s.stepper: checker.worst_error_s(s, stage.print_time) * 1e6 for s in steppers}
    primary = stage.description.nodes[0].name
    return Result(
        scenario=scenario.given,
        seed=stage.seed,
        violations=tuple(found),
        cause=run.cause,
        steps=sum(len(s.executed.at_ns) for s in steppers),
        planned=sum(len(s.planned.print_time) for s in steppers),
        virtual_s=stage.elapsed_s(),
        ready_s=run.ready_s,
        faults=stage.fault_count(),
        worst_primary_us=max((errors_us[s.stepper] for s in steppers if s.node == primary), default=0.0),
        worst_secondary_us=max((errors_us[s.stepper] for s in steppers if s.node != primary), default=0.0),
        trace=_trace(stage, run, steppers),
        events=stage.events(),
        cpu_s=time.process_time() - began_s,
    )


def _ending(stage: Stage, run: _Run) -> Ending:
    if run.cause is None:
        return Ending()
    assert run.stopped_ns is not None
    return Ending(
        cause=run.cause,
        stopped_ns=run.stopped_ns,
        complete_until_ns=stage.faults.sound_until_ns(run.job_ns, run.stopped_ns),
        stop_s=stage.scenario.bounds.stop_s,
    )


def _stepper(stage: Stage, run: _Run, ending: Ending, stepper: StepperDescription) -> StepperTruth:
    node, bounds = stepper.node, stage.scenario.bounds
    primary = node == stage.description.nodes[0].name
    allowed_s = checker.STEP_BAND_S + checker.ROUNDING_TICKS / stage.clock_hz(node) + bounds.late_us * 1e-6
    executed = truth.executed(
        stage.board(node),
        stepper,
        stage.pins(node),
        both_edges=run.both_edges.get(stepper.name, False),
        since_ns=run.job_ns,
    )
    return StepperTruth(
        stepper=stepper.name,
        node=node,
        planned=truth.planned(run.record, stepper),
        executed=executed,
        allowed_s=allowed_s if primary else allowed_s + bounds.clock_error_us * 1e-6,
        counted=None if run.outcome is None else run.outcome.positions[stepper.name],
        reachable=_can_reach(stage, ending, node),
    )


def _can_reach(stage: Stage, ending: Ending, node: str) -> bool:
    """Return whether nothing kept a stop from NODE."""
    return ending.stopped_ns is None or stage.faults.can_reach(
        node, ending.stopped_ns, ending.stopped_ns + round(ending.stop_s * 1e9)
    )


def _output(stage: Stage, ending: Ending, name: str, setting: OutputSetting) -> OutputTruth:
    pins = stage.pins(setting.node)
    if setting.pin not in pins:
        raise ScenarioError(f"{stage.scenario.name}: [outputs.{name}]: node '{setting.node}' has no such pin")
    board = stage.board(setting.node)
    own = board.pin == pins[setting.pin]
    end_ns = stage.now_ns() if ending.stopped_ns is None else ending.stopped_ns
    cold = [
        (fault.begin_ns + round(setting.cold_s * 1e9), min(fault.end_ns, end_ns))
        for fault in stage.faults.begun
        if fault.kind == "sensor" and fault.node == setting.node and setting.cold_s
    ]
    return OutputTruth(
        name=name,
        node=setting.node,
        at_ns=board.at_ns[own],
        level=board.level[own],
        stopped=setting.stopped,
        reachable=_can_reach(stage, ending, setting.node),
        cold_ns=[(begin_ns, until_ns) for begin_ns, until_ns in cold if begin_ns < until_ns],
    )


def _link_queues(run: _Run) -> list[QueueDepth]:
    depths = []
    for name, link in run.links.items():
        stats = link.stats()
        depths.append(
            QueueDepth(f"control queue of node {name}", stats.control_bytes_max, LINK_CONTROL_BYTES)
        )
        depths.append(QueueDepth(f"motion queue of node {name}", stats.motion_bytes_max, LINK_MOTION_BYTES))
    return depths


def _trace(stage: Stage, run: _Run, steppers: list[StepperTruth]) -> str:
    """Return a hash of what happened: the world's events, every step, and how it ended."""
    digest = hashlib.sha256(f"{stage.trace()} {run.cause} {run.stopped_ns} {run.job_ns}".encode())
    for stepper in steppers:
        digest.update(stepper.executed.at_ns.tobytes() + stepper.executed.direction.tobytes())
    return digest.hexdigest()[:16]
