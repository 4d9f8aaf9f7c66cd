"""Serves a machine to front ends until Ctrl-C or SIGTERM: ``canductor run``, ``canductor demo --serve``."""

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

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
from coordinator.web.settings import WebSettings
from nodes.dictionary_cache import DictionaryCache
from nodes.errors import CanductorError
from nodes.host_sockets import socket_folder

if TYPE_CHECKING:
    from coordinator.web.server import WebServer


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
        self._server = IpcServer(registry, tree, _ipc_settings(self._options, self.path))
        await self._server.start()
        page = await _open_page(self._server, self._options)
        _say(f"serving at {self.path}")
        if page is not None:
            _say(f"the live page is at {page.url}")
        typed = Typed(service, _say) if sys.stdin is not None and sys.stdin.isatty() else None
        try:
            await service.run()
        finally:
            if typed is not None:
                typed.close()
            self.state = str(service.state)
            self.cut_off = service.cut_off
            await self._server.close()
            if page is not None:
                await page.close()

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
    return IpcSettings(unix_path=path, tcp=tcp, tokens=options.tokens)


async def _open_page(server: IpcServer, options: ServeOptions) -> "WebServer | None":
    """Open the live page if asked for; raises CanductorError with the server closed."""
    if options.web is None:
        return None
    host, port = options.web
    try:
        try:
            from coordinator.web.server import WebServer  # noqa: PLC0415 (the extra web)
        except ModuleNotFoundError as error:
            raise CanductorError(
                f"the live page needs {error.name}, which is not installed; run: pip install 'canductor[web]'"
            ) from None
        settings = WebSettings(host=host, port=port)
        if not settings.on_loopback and not options.web_without_tls:
            settings = replace(settings, certificate=options.certificate, private_key=options.private_key)
        page = WebServer(server, settings)
        await page.start()
    except BaseException:
        await server.close()
        raise
    return page


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
