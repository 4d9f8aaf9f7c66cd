"""What the running machine needs of its modules; ``coordinator.modules`` provides it."""

from collections.abc import Collection, Iterator, Mapping
from typing import Any, Protocol, TypeVar

from coordinator.config.pins import PinRegistry
from coordinator.gcode.commands import Vocabulary
from coordinator.runtime.module_context import Live
from coordinator.support.values import Value
from nodes.node.config import NodeConfig
from nodes.node.node import Node

M = TypeVar("M")


class MachineModules(Protocol):
    """All modules of one machine, from its configuration to its end (modules/module_set.py)."""

    config: Mapping[str, Mapping[str, str]]
    """The configuration as text: options by section."""
    settings: Mapping[str, Mapping[str, object]]
    """As it was read: values and defaults."""
    notes: list[str]
    """Sentences about what is no mistake."""
    pins: PinRegistry

    @property
    def vocabulary(self) -> Vocabulary: ...  # noqa: D102
    @property
    def command_help(self) -> Mapping[str, str]: ...  # noqa: D102
    def configure(self, config: NodeConfig) -> None: ...  # noqa: D102
    def node_started(self, node: Node) -> None: ...  # noqa: D102
    async def connect(self, live: "Live") -> None: ...  # noqa: D102
    def before_motion(self, steppers: Collection[str]) -> None: ...  # noqa: D102
    def job_begins(self) -> None: ...  # noqa: D102
    def stopped(self, cause: str) -> None: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102
    def status(self) -> Mapping[str, Mapping[str, Value]]: ...  # noqa: D102
    def knows(self, command: str) -> bool: ...  # noqa: D102
    def names(self, kind: type[Any]) -> list[str]: ...  # noqa: D102
    def find(self, name: str, kind: type[M]) -> M | None: ...  # noqa: D102
    def of(self, kind: type[M]) -> Iterator[M]: ...  # noqa: D102
