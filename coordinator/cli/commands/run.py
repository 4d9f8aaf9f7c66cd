"""``canductor run``: start a machine; serve it, or print a file or what comes on standard input."""

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from coordinator.assembly.load import load_machine
from coordinator.cli.arguments.serving import (
    declare_serving,
    is_asked_to_serve,
    refuse_serving_options,
    serving_options,
)
from coordinator.config.model import MachineDescription
from coordinator.front_ends.outputs import is_behind, outputs_in_threads
from coordinator.front_ends.serve import serve_machine
from coordinator.gcode.program import Program
from coordinator.runtime.host import Computer
from coordinator.runtime.linux_host import LinuxHost
from coordinator.service.core.job_runner import run_job
from coordinator.service.jobs.outcome import NodeOutcome, Outcome
from coordinator.support.examples import machine_name
from coordinator.support.interrupts import run_to_end
from coordinator.support.locked_memory import lock_memory
from coordinator.support.progress import Progress, ProgressDisplay
from coordinator.support.report import Report
from coordinator.support.time_slice import shorten_time_slice
from coordinator.tables.store import table_folder
from nodes.dictionary.cache import DictionaryCache
from nodes.support.option_values import UsageError, add_command, existing_file, options_from
from nodes.support.terminal import show


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions:
    """``canductor run`` of one program."""

    config: Path
    gcode: Path | None = None
    """Printed once the machine is ready; None: commands come from standard input."""
    json: bool = False
    """Show no progress."""


def add_to(commands: Any) -> None:
    """Add the command."""
    add_command(commands, "run", "bring up the machine of a configuration file", _declare, _run)


def _declare(command: argparse.ArgumentParser) -> None:
    command.add_argument("config", type=existing_file, help="configuration file")
    command.add_argument(
        "--gcode", type=existing_file, metavar="FILE", help="print this G-code file and exit"
    )
    declare_serving(command)


def _run(given: argparse.Namespace) -> Report:
    asked = is_asked_to_serve(given)
    if asked and given.gcode is not None:
        raise UsageError("--gcode prints a file and exits; leave it out to serve front ends")
    if asked or (given.gcode is None and sys.stdin is not None and sys.stdin.isatty()):
        return serve_machine(serving_options(given, given.config))
    refuse_serving_options(given, "give --ipc, --klippy-api, --pty, --tcp, --web or --metrics")
    return run_machine(options_from(RunOptions, given))


@dataclass(frozen=True, slots=True)
class RunReport:
    """The result of a job; ``ok`` only when every node counted the steps that it was sent."""

    gcode: str
    outcome: Outcome

    @property
    def ok(self) -> bool:
        """Whether every stepper stands where its commands add up to."""
        return not self._astray()

    def _astray(self) -> list[str]:
        outcome = self.outcome
        return [name for name, steps in outcome.positions.items() if steps != outcome.issued[name]]

    def to_json(self) -> Mapping[str, object]:
        """Return the figures by name."""
        outcome = self.outcome
        return {
            "gcode": self.gcode,
            "moves": outcome.moves,
            "print_time_s": round(outcome.print_time_s, 3),
            "steps": outcome.steps,
            "queue_steps": outcome.queue_steps,
            "bytes_to_nodes": sum(node.link.bytes_sent for node in outcome.nodes),
            "retransmitted_bytes": sum(node.link.bytes_repeated for node in outcome.nodes),
            "steppers": {
                name: {"steps_moved": steps, "steps_sent": outcome.issued[name]}
                for name, steps in outcome.positions.items()
            },
            "nodes": {node.name: _node_json(node) for node in outcome.nodes},
        }

    def to_text(self) -> str:
        """Return the same for a reader."""
        outcome = self.outcome
        moved = f"{outcome.moves:,} moves in {outcome.print_time_s:.1f} s, {outcome.steps:,} steps"
        lines = [f"{self.gcode}: {moved} in {outcome.queue_steps:,} queue_step commands"]
        lines += [
            f"  {name}: moved by {steps:+,} steps, as its node counts them"
            for name, steps in outcome.positions.items()
        ]
        lines += [f"  {node.to_text()}" for node in outcome.nodes]
        if astray := self._astray():
            lines.append(
                f"FAILED: {', '.join(astray)} moved by another number of steps than was sent; "
                "home the machine before it moves again, and please report this"
            )
        return "\n".join(lines)


def _node_json(node: NodeOutcome) -> Mapping[str, object]:
    link = node.link
    return {
        "bytes_sent": link.bytes_sent,
        "retransmitted_bytes": link.bytes_repeated,
        "min_lead_ms": None if link.min_lead_s is None else round(link.min_lead_s * 1e3, 1),
        "round_trip_us": round(link.srtt_s * 1e6, 2),
        "motion_queue_max": link.motion_commands_max,
        "clock_error_us": round(node.clock_error_s * 1e6, 2),
    }


def run_machine(options: RunOptions, host: Computer | None = None) -> RunReport:
    """Run OPTIONS.gcode, or standard input as it comes, on the machine of OPTIONS.config and HOST.

    HOST: this computer if None. Replies and notices go to standard output as they come. Raises
    CanductorError, KeyboardInterrupt; BrokenPipeError, OutputError when all is done, if the output takes
    nothing.
    """
    host = host or LinuxHost()
    description = load_machine(str(options.config))
    with ExitStack() as stack:
        program = stack.enter_context(
            Program.typed() if options.gcode is None else Program.open(options.gcode)
        )
        _announce(description)
        stack.enter_context(outputs_in_threads())
        on_progress = stack.enter_context(_progress(options, program))
        shorten_time_slice()
        lock_memory()
        outcome = run_to_end(
            lambda: run_job(
                description,
                program,
                on_progress,
                on_output=lambda output: show(output.text),
                cache=DictionaryCache.of_user(),
                tables=table_folder(machine_name(options.config)),
                host=host,
            ),
            host.make_loop,
        )
        return RunReport(program.name, outcome)


def _announce(description: MachineDescription) -> None:
    for line in (*description.unsupported, *description.notes):
        show(str(line))


@contextmanager
def _progress(options: RunOptions, program: Program) -> Iterator[Callable[[Progress], None]]:
    """Show the progress of a file; for typed lines, only their replies are shown."""
    if options.gcode is None:
        yield lambda _: None
        return
    title = f"printing {program.name}"
    with ProgressDisplay(title, quiet=options.json, is_behind=is_behind) as display:
        yield display.update
