"""[probe]: a switch at the head that the bed closes; also one that docks, or that is deployed by g-code."""

from coordinator.config.options import SectionSpec
from coordinator.config.sections.probe import PIN
from coordinator.modules.base import Build
from coordinator.modules.probes.probe import LINE_OPTIONS, MEASURING_OPTIONS, Probe
from coordinator.modules.probes.probe_commands import ProbeCommands


class SwitchProbe(Probe):
    """The probe of [probe]."""

    SPEC = SectionSpec(
        "A switch at the head that finds how high the bed is; by probe:z_virtual_endstop the endstop of Z",
        (PIN, *MEASURING_OPTIONS, *LINE_OPTIONS),
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        build.shared(ProbeCommands)
