"""``canductor demo``: print on virtual nodes in real time, then prove every step against the plan."""

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from coordinator.assembly.load import load_machine
from coordinator.demo.report import DemoReport, report_of
from coordinator.front_ends.outputs import is_behind, outputs_in_threads
from coordinator.gcode.program import Program
from coordinator.runtime.host import Computer
from coordinator.runtime.linux_host import LinuxHost
from coordinator.runtime.machine import Machine
from coordinator.service.core.job_runner import OnProgress, run_job
from coordinator.streaming.pipeline import PlanRecord
from coordinator.support.examples import DEMO_GCODE, DEMO_MACHINE
from coordinator.support.interrupts import run_to_end
from coordinator.support.progress import ProgressDisplay
from coordinator.support.quoting import shown_path
from coordinator.verification.hardware import Hardware
from coordinator.verification.heat_proof import HeatWatch, not_steady, prove_heat
from coordinator.verification.prover import Prover
from coordinator.virtual_machine.virtual_machine import VirtualMachine, VirtualMachineOptions
from nodes.support.errors import CanductorError


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoOptions(VirtualMachineOptions):
    """``canductor demo``."""

    machine: Path = DEMO_MACHINE
    """Configuration file whose nodes are played by virtual ones."""
    gcode: Path = DEMO_GCODE
    keep: Path | None = None
    """Folder that keeps step logs and captures; None: they are removed at the end."""
    json: bool = False
    """Show no progress."""


def run_demo(options: DemoOptions) -> DemoReport:
    """Run the demo; raises CanductorError when it cannot be brought to its end."""
    description = load_machine(str(options.machine))
    with ExitStack() as stack:
        folder = stack.enter_context(_folder(options.keep))
        program = stack.enter_context(Program.open(options.gcode))
        stage = stack.enter_context(VirtualMachine(description, options, folder))
        stack.enter_context(outputs_in_threads())
        display = stack.enter_context(
            ProgressDisplay(f"printing {program.name}", quiet=options.json, is_behind=is_behind)
        )
        return print_and_prove(stage, program, LinuxHost(), display.update)


def print_and_prove(
    hardware: Hardware, program: Program, host: Computer, on_progress: OnProgress | None = None
) -> DemoReport:
    """Print PROGRAM on HARDWARE, which HOST reaches, and prove every step; raises CanductorError."""
    description = hardware.description
    record = PlanRecord((0.0, 0.0, 0.0, 0.0))
    output: list[str] = []
    both_edges: dict[str, bool] = {}
    claimed: dict[str, list[str]] = {}
    warmth = HeatWatch()

    def ready(machine: Machine) -> None:
        claimed.update({name: machine.modules.pins.claimed(name) for name in machine.nodes})
        both_edges.update({name: s.steps_on_both_edges for name, s in machine.devices.steppers.items()})
        warmth.attach(machine)

    outcome = run_to_end(
        lambda: run_job(
            description,
            program,
            on_progress,
            record=record,
            on_output=lambda event: output.append(event.text),
            on_ready=ready,
            host=host,
        ),
        host.make_loop,
    )
    figures = hardware.stop_nodes()
    prover = Prover(description, hardware.edge_log, outcome, record, both_edges=both_edges, claimed=claimed)
    heat = [
        proof
        for node in description.nodes
        for proof in prove_heat(warmth.states, node.name, hardware.plant_log(node.name))
    ]
    notices = [*map(str, description.unsupported), *description.notes, *output]
    if (sentence := not_steady(warmth.heaters, heat)) is not None:
        notices.append(sentence)
    return report_of(prover, hardware, figures, outcome, notices, heat=heat)


@contextmanager
def _folder(keep: Path | None) -> Iterator[Path]:
    """Give the folder KEEP, else a temporary one; raises CanductorError."""
    if keep is not None:
        try:
            keep.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise CanductorError(
                f"cannot keep the step logs in {shown_path(str(keep))}: {error.strerror}; name another folder"
                " with --keep"
            ) from None
        yield keep
        return
    with tempfile.TemporaryDirectory(prefix="canductor-demo-") as folder:
        yield Path(folder)
