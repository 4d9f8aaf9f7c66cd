"""A machine on virtual nodes that is served on all ways in, and whose control loop can be held.

A process of its own, for live_stops.py: `python -m tests.fuzz.stopped_service FOLDER FD`, FD the
file descriptor of its terminal. It prints one JSON line of ports and links once it serves. A line ``waiting``
or ``calculating`` on standard input holds the loop in that manner, which is answered by ``held``; the next
line lets it go. It ends with its standard input.
"""

import json
import sys
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any, Final

from coordinator.front_ends.http_servers import make_metrics
from coordinator.ipc.protocol.limits import Limits
from coordinator.ipc.protocol.methods import Registry, Scope
from coordinator.ipc.server.server import IpcServer
from coordinator.ipc.server.settings import IpcSettings, TcpSettings
from coordinator.ipc.server.uploads import upload_method
from coordinator.serial_host.terminal import PseudoTerminal
from coordinator.service.api.methods import add_methods
from coordinator.service.state.log_ring import Entry
from coordinator.support.locked_memory import lock_memory
from coordinator.support.time_slice import shorten_time_slice
from coordinator.web.server import WebServer
from coordinator.web.settings import WebSettings
from tests.coordinator.certificates import make_certificate
from tests.fuzz.proved_service import ADMIN_TOKEN, WATCH_TOKEN
from tests.stages.held_service import HeldService, serve_held

LOOPBACK: Final = "127.0.0.1"


class OpenService(HeldService):
    """On all ways in; whoever comes to FOLDER/open.sock may watch."""

    own_process = True
    pty: PseudoTerminal | None = None
    ways: dict[str, Any]
    """Ports and links by their names."""

    @asynccontextmanager
    async def interfaces(self) -> AsyncIterator[None]:
        """Serve on all ways in."""
        async with super().interfaces(), AsyncExitStack() as stack:
            lane, notice = self.stop_path.lane, self.lines.append
            tokens = self.folder / "tokens"
            tokens.touch(0o600)
            tokens.write_text(f"watch fuzzer {WATCH_TOKEN}\nadmin operator {ADMIN_TOKEN}\n")
            pem, key = make_certificate(self.folder)
            plain = TcpSettings(host=LOOPBACK, port=0, tokens=tokens, plain_on_loopback=True)
            secret = TcpSettings(host=LOOPBACK, port=0, tokens=tokens, certificate=pem, private_key=key)
            limits = Limits(message_timeout_s=1.0)
            servers = []
            for settings in (
                IpcSettings(unix_path=self.folder / "open.sock", unix_scope=Scope.WATCH, limits=limits),
                IpcSettings(unix_path=None, tcp=plain, limits=limits),
                IpcSettings(unix_path=None, tcp=secret, limits=limits),
            ):
                registry = Registry()
                add_methods(self.service, registry)
                registry.add(upload_method(self.folder))
                servers.append(IpcServer(registry, self.tree, settings, stop_lane=lane))
                await servers[-1].start()
                stack.push_async_callback(servers[-1].close)
            pages = []
            for settings_of_page in (
                WebSettings(host=LOOPBACK, port=0),
                WebSettings(host=LOOPBACK, port=0, certificate=pem, private_key=key),
            ):
                pages.append(WebServer(servers[1], settings_of_page, on_notice=notice))
                await pages[-1].start()
                stack.push_async_callback(pages[-1].close)
            metrics = make_metrics(lambda: self.tree.snapshot().values, {}, (LOOPBACK, 0), is_open=False)
            await metrics.start()
            stack.push_async_callback(metrics.close)
            self.pty = PseudoTerminal(self.service, self.folder / "host.pty")
            self.pty.start()
            stack.push_async_callback(self.pty.close)
            lane.look_also(self.pty.find_stop)
            self.ways = {
                "tcp": servers[1].tcp_port,
                "tls": servers[2].tcp_port,
                "pages": [page.new_link(Scope.OPERATE) for page in pages],
                "metrics": metrics.port,
            }
            yield

    def hear(self, entry: Entry) -> None:
        """Take note of a line of the service's log."""
        super().hear(entry)
        if self.pty is not None:
            self.pty.host.note(entry)


def main() -> None:
    """Serve, and hold the loop as standard input says."""
    commands, answers = sys.stdin, sys.stdout
    shorten_time_slice()
    lock_memory()

    def say(line: str) -> None:
        answers.write(line + "\n")
        answers.flush()

    def obey(held: OpenService) -> None:
        held.wait_for(lambda: held.service.starts > 0, "it starts")
        say(json.dumps(held.ways))
        for line in commands:
            with held.held(calculating=line.strip() == "calculating"):
                say("held")
                commands.readline()

    serve_held(Path(sys.argv[1]), obey, OpenService, terminal=int(sys.argv[2]))


if __name__ == "__main__":
    main()
