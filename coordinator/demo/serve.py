"""``canductor demo --serve``: the virtual machine stays up for front ends to be developed and tried on."""

import dataclasses
import shutil
import tempfile
from pathlib import Path

from coordinator.assembly.load import load_machine
from coordinator.config.model import MachineDescription
from coordinator.demo.run import DemoOptions
from coordinator.front_ends.serve import ServeOptions, serve
from coordinator.support.examples import DEMO_GCODE, EXAMPLES
from coordinator.support.report import Report
from coordinator.virtual_machine.virtual_machine import VirtualMachine


def serve_demo(options: DemoOptions, serving: ServeOptions) -> Report:
    """Serve until Ctrl-C or SIGTERM; raises CanductorError."""
    with tempfile.TemporaryDirectory(prefix="canductor-demo-") as name:
        folder = Path(name)
        machine = str(to_change(options.machine, folder))
        description = load_machine(machine)
        serving = dataclasses.replace(serving, state=folder / "state")
        with VirtualMachine(description, dataclasses.replace(options, logs=False), folder) as stage:
            return serve(lambda: stage.of(load_machine(machine)), with_jobs(serving, description, folder))


def to_change(machine: Path, folder: Path) -> Path:
    """Return the file MACHINE, or of an example a copy in FOLDER: SAVE_CONFIG writes into it."""
    if not machine.resolve().is_relative_to(EXAMPLES.resolve()):
        return machine
    return Path(shutil.copy(machine, folder / "machine.cfg"))


def with_jobs(options: ServeOptions, description: MachineDescription, folder: Path) -> ServeOptions:
    """Return OPTIONS with a job folder in FOLDER unless they name one or the machine has its own."""
    has_jobs = "virtual_sdcard" in description.modules.config
    if options.jobs is not None or has_jobs:
        return options
    return dataclasses.replace(options, jobs=_demo_jobs(folder))


def _demo_jobs(folder: Path) -> Path:
    """Return a job folder with the demo's program, for this run."""
    jobs = folder / "jobs"
    jobs.mkdir()
    shutil.copy(DEMO_GCODE, jobs)
    return jobs
