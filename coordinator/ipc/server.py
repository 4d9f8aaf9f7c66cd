"""The server's sockets: listens, lets in, and drives one session per client (asyncio)."""

from collections.abc import Mapping

from coordinator.ipc.methods import Registry, Value
from coordinator.ipc.settings import IpcSettings
from coordinator.ipc.state import StateTree


class IpcServer:
    """Serves METHODS and STATE to front ends as SETTINGS say; lives on the loop that starts it."""

    def __init__(self, registry: Registry, state: StateTree, settings: IpcSettings) -> None:
        self._registry = registry
        self._state = state
        self._settings = settings

    async def start(self) -> None:
        """Open the sockets; raises CanductorError with all closed."""

    async def close(self) -> None:
        """Let go of every client and close the sockets."""

    def notify(self, event: str, values: Mapping[str, Value]) -> None:
        """Send EVENT ("log", "gcode.reply") to every client that listens to it; never blocks."""
