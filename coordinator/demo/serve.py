"""``canductor demo --serve``: the virtual machine stays up for front ends to be developed and tried on."""

import dataclasses
import tempfile
from pathlib import Path

from coordinator.commands import DEMO_GCODE, DemoOptions
from coordinator.demo.stage import Stage
from coordinator.machine.description import load_machine
from coordinator.service.serve import ServeReport, serve


def serve_demo(options: DemoOptions) -> ServeReport:
    """Serve until Ctrl-C or SIGTERM; raises CanductorError."""
    assert options.serve is not None
    description = load_machine(str(options.machine))
    serving = options.serve
    if serving.jobs is None:
        serving = dataclasses.replace(serving, jobs=DEMO_GCODE.parent)
    with (
        tempfile.TemporaryDirectory(prefix="canductor-demo-") as folder,
        Stage(description, options, Path(folder)) as stage,
    ):
        return serve(lambda: stage.description, serving)
