"""The list of our modules is whole."""

from importlib import import_module
from pkgutil import walk_packages

import coordinator.modules
from coordinator.modules.base import Module
from coordinator.modules.registry import FURTHER_OPTIONS, SECTIONS

PACKAGE = coordinator.modules.__name__
MADE_BY_OTHERS = {
    "eddy_current.drift_calibration:DriftCalibration",
    "load_cells.load_cell_commands:LoadCellCommands",
    "load_cells.load_cell_probe:LoadCellProbeStatus",
    "probes.probe_commands:ProbeCommands",
}
"""Modules that describe themselves and have no section."""


def described() -> set[str]:
    """Return all modules of this package that say what they are for, by file and name."""
    found = set()
    for file in walk_packages(coordinator.modules.__path__, f"{PACKAGE}."):
        for name, value in vars(import_module(file.name)).items():
            if isinstance(value, type) and issubclass(value, Module) and value.__module__ == file.name:
                found |= {f"{file.name.removeprefix(f'{PACKAGE}.')}:{name}"} if value.SPEC.help else set()
    return found


def test_each_section_is_listed() -> None:
    assert described() - MADE_BY_OTHERS == {*SECTIONS.values(), *FURTHER_OPTIONS.values()}


def test_they_are_in_order() -> None:
    assert list(SECTIONS) == sorted(SECTIONS)
