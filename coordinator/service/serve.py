"""Serves a machine to front ends until Ctrl-C or SIGTERM: ``canductor run``, ``canductor demo --serve``."""

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from coordinator.commands import RunOptions, ServeOptions
from coordinator.host import LinuxHost
from coordinator.interrupts import run_to_end
from coordinator.ipc.methods import Registry
from coordinator.ipc.server import IpcServer
from coordinator.ipc.settings import IpcSettings, TcpSettings
from coordinator.ipc.state import StateTree
from coordinator.ipc.uploads import upload_method
from coordinator.machine.description import MachineDescription, load_machine
from coordinator.service.log_ring import Entry
from coordinator.service.machine_service import MachineService, ServiceSettings
from coordinator.service.methods import add_methods
from coordinator.service.typed import Typed
from nodes.dictionary_cache import DictionaryCache
from nodes.host_sockets import socket_folder


@dataclass(frozen=True, slots=True)
class ServeReport:
    """How a service ended that was asked to."""

    address: str
    state: str

    @property
    def ok(self) -> bool:
        """It did what it was to do."""
        return True

    def to_json(self) -> Mapping[str, object]:
        """Return the figures by name."""
        return {"address": self.address, "state": self.state}

    def to_text(self) -> str:
        """Return the same for a reader."""
        return f"served at {self.address} until asked to end; the machine was in {self.state}"


def serve_machine(options: RunOptions) -> ServeReport:
    """Serve the machine of OPTIONS.config. Raises CanductorError, KeyboardInterrupt if motion was cut off."""
    assert options.serve is not None
    path = str(options.config)
    load_machine(path)  # a mistake in it ends here, not in a service without a machine
    return serve(lambda: load_machine(path), options.serve, cache=DictionaryCache.of_user())


def serve(
    load: Callable[[], MachineDescription], options: ServeOptions, *, cache: DictionaryCache | None = None
) -> ServeReport:
    """Serve the machine that LOAD describes; raises as ``serve_machine``."""
    hall = _Hall(load, options, cache)
    try:
        run_to_end(hall.serve)
    except KeyboardInterrupt:
        if hall.cut_off:
            raise
    return ServeReport(str(hall.path), str(hall.state))


class _Hall:
    """A service and its server, on one loop."""

    def __init__(
        self, load: Callable[[], MachineDescription], options: ServeOptions, cache: DictionaryCache | None
    ) -> None:
        self.path = options.path or socket_folder() / f"{options.name}.sock"
        self.state = ""
        self.cut_off = False
        """Whether the end came while something moved."""
        self._load = load
        self._options = options
        self._cache = cache

    async def serve(self) -> None:
        """Be there for front ends until cancelled."""
        registry, tree = Registry(), StateTree()
        settings = ServiceSettings(
            name=self._options.name, jobs=self._options.jobs, node_commands=self._options.node_commands
        )
        service = MachineService(
            self._load,
            LinuxHost(),
            tree,
            settings,
            cache=self._cache,
            on_line=self._tell,
        )
        add_methods(service, registry)
        if settings.jobs is not None:
            registry.add(upload_method(settings.jobs))
        self._server = IpcServer(
            registry,
            tree,
            _ipc_settings(self._options, self.path),
            on_notice=lambda text: service.log.add("notice", text),
        )
        await self._server.start()
        _say(f"serving at {self.path}")
        if self._options.tcp is not None:
            _say(f"serving at {_address(self._options, self._server.tcp_port)}")
        typed = Typed(service, _say) if sys.stdin is not None and sys.stdin.isatty() else None
        try:
            await service.run()
        finally:
            if typed is not None:
                typed.close()
            self.state = str(service.state)
            self.cut_off = service.cut_off
            await self._server.close()

    def _tell(self, entry: Entry) -> None:
        self._server.notify("log", dict(entry))
        _say(str(entry["text"]))


def _ipc_settings(options: ServeOptions, path: Path) -> IpcSettings:
    tcp = None
    if options.tcp is not None and options.tokens is not None:
        host, port = options.tcp
        tcp = TcpSettings(
            host=host,
            port=port,
            tokens=options.tokens,
            certificate=options.certificate,
            private_key=options.private_key,
            plain_on_loopback=options.plain_on_loopback,
        )
    return IpcSettings(unix_path=path, tcp=tcp)


def _address(options: ServeOptions, port: int | None) -> str:
    assert options.tcp is not None
    host = options.tcp[0]
    scheme = "tls" if options.certificate is not None else "tcp"
    return f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}"


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
