"""Serves a machine to front ends until Ctrl-C or SIGTERM: ``canductor run``, ``canductor demo --serve``."""

import asyncio
import contextlib
import platform
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING

from coordinator.assembly.load import load_machine
from coordinator.config.model import MachineDescription
from coordinator.front_ends.console import Console, asyncio_reports_to
from coordinator.front_ends.log_file import ServiceLog
from coordinator.front_ends.stop_path import StopPath
from coordinator.ipc.discovery.announcement import Announcement, bracketed, host_word
from coordinator.ipc.discovery.announcer_process import AnnouncerProcess
from coordinator.ipc.protocol.methods import Registry, Scope
from coordinator.ipc.server.server import IpcServer
from coordinator.ipc.server.session_methods import API_VERSION
from coordinator.ipc.server.settings import IpcSettings, TcpSettings
from coordinator.ipc.server.state import StateTree
from coordinator.ipc.server.stop_lane import StopLane
from coordinator.ipc.server.tcp_listener import raise_files_limit
from coordinator.ipc.server.uploads import upload_method
from coordinator.klippy_api.gateway import Gateway
from coordinator.runtime.linux_host import LinuxHost
from coordinator.serial_host.terminal import PseudoTerminal
from coordinator.service.api.methods import add_methods
from coordinator.service.core.machine_service import MachineService, ServiceSettings
from coordinator.service.core.typed import Typed
from coordinator.service.state.log_ring import Entry
from coordinator.support.interrupts import run_to_end
from coordinator.support.locked_memory import lock_memory
from coordinator.support.loop_watchdog import WatchedLoop
from coordinator.support.report import PlainReport, Report
from coordinator.support.time_slice import shorten_time_slice
from coordinator.support.values import Value
from coordinator.support.version import VERSION
from coordinator.tables.store import table_folder
from coordinator.web.access import LINK_S
from coordinator.web.settings import WebSettings
from nodes.dictionary.cache import DictionaryCache
from nodes.support.host_sockets import socket_folder
from nodes.support.state_folder import state_folder

if TYPE_CHECKING:
    from coordinator.web.server import WebServer


@dataclass(frozen=True, slots=True, kw_only=True)
class ServeOptions:
    """How a machine is served to front ends."""

    name: str
    """What front ends show; also the socket's name unless PATH says otherwise."""
    path: Path | None = None
    """The Unix socket; None: NAME.sock where this user's machines have theirs."""
    jobs: Path | None = None
    """Folder of the files that may be printed; None: there are no jobs."""
    node_commands: bool = False
    """Whether clients may send raw commands to nodes."""
    tcp: tuple[str, int] | None = None
    """Host and port."""
    tokens: Path | None = None
    certificate: Path | None = None
    private_key: Path | None = None
    plain_on_loopback: bool = False
    web: tuple[str, int] | None = None
    """Address and port of the live page."""
    web_without_tls: bool = False
    """Serve the page without TLS beyond loopback, too."""
    web_names: tuple[str, ...] = ()
    """Host names, in lower case, that the page answers to."""
    announce: bool | None = None
    """Announce the machine on the network; None: if its TCP port can be reached from there."""
    metrics: tuple[str, int] | None = None
    """IP address and port of the figures for Prometheus."""
    config: Path = Path()
    """The configuration file, for clients that show where it is."""
    klippy_api: Path | None = None
    """The Unix socket for Moonraker (docs/klippy-api.md); None: there is none."""
    pty: Path | None = None
    """The link to a pseudo-terminal for a serial host (docs/pty.md); None: there is none."""
    log_file: Path | None = None
    """The file that the log is written to; None: there is none."""
    state: Path | None = None
    """Folder of what outlives the service, such as the journal of jobs; None: that of this user's machine."""
    metrics_open: bool = False
    """Whether others than this computer may read them."""


def serve_machine(options: ServeOptions) -> Report:
    """Serve the machine of OPTIONS.config. Raises CanductorError, KeyboardInterrupt if motion was cut off."""
    path = str(options.config)
    if options.klippy_api is None:
        load_machine(path)  # a mistake in it ends here, not in a service without a machine
    return serve(lambda: load_machine(path), options, cache=DictionaryCache.of_user())


def serve(
    load: Callable[[], MachineDescription], options: ServeOptions, *, cache: DictionaryCache | None = None
) -> Report:
    """Serve the machine that LOAD describes; raises as ``serve_machine``."""
    raise_files_limit()
    shorten_time_slice()
    lock_memory()
    process = _ServiceProcess(load, options, cache)
    try:
        run_to_end(process.serve, WatchedLoop)
    except KeyboardInterrupt:
        if process.cut_off:
            raise
    address, state = str(process.path), process.state
    text = f"served at {address} until it was stopped; the machine was in state {state}"
    return PlainReport({"address": address, "state": state}, text)


class _ServiceProcess:
    """A service and the servers of its front ends, on one loop."""

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
        self._console, self._errors = Console(sys.stdout), Console(sys.stderr)
        self._announcer: AnnouncerProcess | None = None
        self._gateway: Gateway | None = None
        self._terminal: PseudoTerminal | None = None
        self._log_file: ServiceLog | None = None

    async def serve(self) -> None:
        """Serve front ends until cancelled."""
        registry, tree = Registry(), StateTree()
        settings = ServiceSettings(
            name=self._options.name,
            jobs=self._options.jobs,
            node_commands=self._options.node_commands,
            tables=table_folder(self._options.name),
            state=self._options.state or state_folder(self._options.name),
            own_process=True,
        )
        service = MachineService(
            self._load,
            LinuxHost(),
            tree,
            settings,
            cache=self._cache,
            on_line=lambda entry: self._on_entry(service, entry),
        )
        service.claim_folder()  # before uploads are removed that may be those of another service
        add_methods(service, registry)
        if settings.jobs is not None:
            registry.add(upload_method(settings.jobs))
        stop_path = StopPath(service)
        self._server = IpcServer(
            registry,
            tree,
            _ipc_settings(self._options, self.path),
            on_notice=lambda text: service.log.add("notice", text),
            stop_lane=stop_path.lane,
        )
        page = self._page(registry, service)
        async with contextlib.AsyncExitStack() as stack:
            for console in (self._console, self._errors):
                stack.push_async_callback(asyncio.to_thread, console.close)
            stack.enter_context(asyncio_reports_to(self._errors))
            if self._options.log_file is not None:
                self._log_file = ServiceLog(service, self._options.config, self._options.log_file)
                stack.push_async_callback(self._log_file.close)
            stack.callback(stop_path.close)
            if page is not None:
                stack.push_async_callback(page.close)
            stack.push_async_callback(self._server.close)  # before the page, whose browsers get the reason so
            await self._server.start()
            if page is not None:
                await page.start()
            self._report_addresses(page)
            await self._open_metrics(tree, stack)
            await self._open_klippy_api(service, stop_path.lane, stack)
            self._open_terminal(service, stop_path.lane, stack)
            self._announce(service, stack)
            if sys.stdin is not None and sys.stdin.isatty():
                typed = Typed(service, self._console.show)
                stack.callback(typed.close)
                stop_path.lane.look_also(typed.find_stop)
            stop_path.start()
            try:
                await service.run()
            finally:
                self.state = str(service.state)
                self.cut_off = service.cut_off

    def _report_addresses(self, page: "WebServer | None") -> None:
        self._console.show(f"serving at {self.path}")
        if self._options.tcp is not None:
            self._console.show(f"serving at {_address(self._options, self._server.tcp_port)}")
        if page is not None:
            self._console.show(f"the live page is at {page.url}")
            self._console.show(
                f"to get in, open {page.new_link(Scope.OPERATE)} within {LINK_S / 60:.0f} minutes;"
                " it works once, 'canductor page' prints another"
            )

    async def _open_klippy_api(
        self, service: MachineService, stop_lane: StopLane, stack: contextlib.AsyncExitStack
    ) -> None:
        """Serve Moonraker if asked for; raises CanductorError."""
        path = self._options.klippy_api
        if path is None:
            return
        self._gateway = Gateway(
            service,
            self._options.config,
            on_notice=lambda text: service.log.add("notice", text),
            stop_lane=stop_lane,
            log_file=self._options.log_file,
        )
        await self._gateway.start(path)
        stack.push_async_callback(self._gateway.close)
        self._console.show(f"serving Moonraker at {path}")

    def _open_terminal(
        self, service: MachineService, stop_lane: StopLane, stack: contextlib.AsyncExitStack
    ) -> None:
        """Serve a serial host if asked for; raises CanductorError."""
        path = self._options.pty
        if path is None:
            return
        self._terminal = PseudoTerminal(service, path)
        self._terminal.start()
        stack.push_async_callback(self._terminal.close)
        stop_lane.look_also(self._terminal.find_stop)
        self._console.show(f"serving a serial host at {path}")

    def _page(self, registry: Registry, service: MachineService) -> "WebServer | None":
        """Return the live page if it is asked for, with its methods in REGISTRY."""
        options = self._options
        if options.web is None:
            return None
        host, port = options.web
        sessions = state_folder(options.name) / f"page-{port}.json"
        settings = WebSettings(host=host, port=port, names=options.web_names, sessions=sessions)
        if not settings.on_loopback and not options.web_without_tls:
            settings = replace(settings, certificate=options.certificate, private_key=options.private_key)
        from coordinator.front_ends.http_servers import make_page  # noqa: PLC0415 (see there)

        return make_page(self._server, registry, settings, lambda text: service.log.add("notice", text))

    async def _open_metrics(self, tree: StateTree, stack: contextlib.AsyncExitStack) -> None:
        """Open the endpoint for Prometheus if asked for; raises CanductorError."""
        if self._options.metrics is None:
            return

        def fields() -> dict[str, Value]:
            figures = {f"api.{name}": value for name, value in self._server.figures().items()}
            return tree.snapshot().values | figures

        from coordinator.front_ends.http_servers import make_metrics  # noqa: PLC0415 (see there)

        about = {"name": self._options.name, "version": VERSION, "api": str(API_VERSION)}
        metrics = make_metrics(fields, about, self._options.metrics, is_open=self._options.metrics_open)
        await metrics.start()
        stack.push_async_callback(metrics.close)
        self._console.show(
            f"metrics are at http://{bracketed(self._options.metrics[0])}:{metrics.port}/metrics"
        )

    def _announce(self, service: MachineService, stack: contextlib.AsyncExitStack) -> None:
        """Announce the machine on the network, if wanted."""
        bound, port = self._server.tcp_addresses, self._server.tcp_port
        wanted = self._options.announce
        if wanted is None:
            wanted = not all(ip_address(address.partition("%")[0]).is_loopback for address in bound)
        if not wanted or port is None:
            return
        machine = Announcement(
            name=service.settings.name,
            host=host_word(platform.node()),
            version=VERSION,
            state=str(service.state),
            api=API_VERSION,
            tls=self._options.certificate is not None and self._options.private_key is not None,
            id=service.settings.id,
            port=port,
            addresses=(),
        )
        self._announcer = AnnouncerProcess(
            machine, bound, lambda sentence: service.log.add("network", sentence)
        )
        self._announcer.start()
        stack.push_async_callback(self._announcer.close)

    def _on_entry(self, service: MachineService, entry: Entry) -> None:
        self._server.notify("log", dict(entry))
        self._console.show(str(entry["text"]))
        if self._gateway is not None:
            self._gateway.note(entry)
        if self._terminal is not None:
            self._terminal.host.note(entry)
        if self._log_file is not None:
            self._log_file.note(entry)
        if self._announcer is not None and entry["kind"] == "state":
            self._announcer.set_state(str(service.state))


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


def _address(options: ServeOptions, port: int | None) -> str:
    assert options.tcp is not None
    host = options.tcp[0]
    scheme = "tls" if options.certificate is not None else "tcp"
    return f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}"
