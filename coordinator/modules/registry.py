"""Which module a section is for: the one whose ``KIND`` is the section's first word.

Modules of this package are found in its folders, those of other packages by the entry point group
``canductor.modules``.
"""

import re
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pkgutil import iter_modules
from typing import Final

import coordinator.modules
from coordinator.config.errors import ConfigError, Place
from coordinator.modules.base import Module

ENTRY_POINTS: Final = "canductor.modules"
"""Name: the section's first word; value: ``package.module:Class``."""


def _own_classes() -> Iterator[type[Module]]:
    """Yield all modules in the folders of this package."""
    for folder in iter_modules(coordinator.modules.__path__, f"{coordinator.modules.__name__}."):
        if not folder.ispkg:
            continue
        for file in iter_modules(import_module(folder.name).__path__, f"{folder.name}."):
            for found in vars(import_module(file.name)).values():
                if isinstance(found, type) and issubclass(found, Module) and found.__module__ == file.name:
                    yield found


_OWN: Final = sorted(_own_classes(), key=lambda module: module.KIND)
MODULES: Final = {module.KIND: module for module in _OWN if "KIND" in vars(module)}
"""Our modules, by the section's first word."""
_OPTION_READERS: Final = {module.READS: module for module in _OWN if module.READS}
"""By a pattern of section names that the machine itself reads: which module reads further options there."""


def own_kinds() -> tuple[str, ...]:
    """Return the first words of the sections that our modules are for."""
    return tuple(MODULES)


def own_modules() -> Iterator[tuple[str, type[Module]]]:
    """Yield our modules with how their sections are written: ``[fan]``, ``[fan_generic NAME]``."""
    for kind, module in MODULES.items():
        yield (f"[{kind} NAME]" if module.NAMED else f"[{kind}]"), module


def own_option_readers() -> Iterator[tuple[str, type[Module]]]:
    """Yield our modules that read further options of sections that the machine itself reads."""
    for module in _OPTION_READERS.values():
        yield module.TITLE, module


def known_kinds() -> tuple[str, ...]:
    """Return the first words of the sections that some module is for."""
    return (*MODULES, *_others())


def module_for(kind: str, place: Place) -> type[Module] | None:
    """Return the module for sections ``[KIND ...]``, or None; raises ConfigError when it cannot be loaded."""
    if kind in MODULES:
        return MODULES[kind]
    other = _others().get(kind)
    if other is None:
        return None
    try:
        found = other.load()
    # Whatever code that is not ours raises, its user learns which package it was.
    except Exception as error:
        raise ConfigError(
            place,
            f"the module for [{kind}], {other.value} of package {_package(other)}, cannot be loaded:"
            f" {error or type(error).__name__}; update or remove that package",
        ) from error
    if not (isinstance(found, type) and issubclass(found, Module)):
        raise ConfigError(
            place,
            f"{other.value} of package {_package(other)} is no module for [{kind}]: it must be a subclass of"
            " coordinator.modules.base.Module; update or remove that package",
        )
    return found


def option_readers(section: str) -> Iterator[type[Module]]:
    """Yield the modules that read further options of a section that belongs to the machine itself."""
    for pattern, module in _OPTION_READERS.items():
        if re.fullmatch(pattern, section, re.ASCII):
            yield module


@cache
def _others() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=ENTRY_POINTS)}


def _package(point: "EntryPoint") -> str:
    return point.dist.name if point.dist is not None else "?"
