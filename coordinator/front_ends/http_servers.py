"""The live page and the figures for Prometheus of a served machine; imported only where one is asked for.

Both bring an HTTP server, which takes 15 MB of memory.
"""

from collections.abc import Callable

from coordinator.ipc.protocol.methods import Registry
from coordinator.ipc.server.server import IpcServer
from coordinator.metrics.server import MetricsServer, MetricsSettings
from coordinator.support.values import Value
from coordinator.web.methods import add_page_methods
from coordinator.web.server import WebServer
from coordinator.web.settings import WebSettings


def make_page(
    server: IpcServer, registry: Registry, settings: WebSettings, on_notice: Callable[[str], None]
) -> WebServer:
    """Return the live page of SERVER, not started, with its methods in REGISTRY."""
    page = WebServer(server, settings, on_notice=on_notice)
    add_page_methods(registry, page)
    return page


def make_metrics(
    fields: Callable[[], dict[str, Value]], about: dict[str, str], address: tuple[str, int], *, is_open: bool
) -> MetricsServer:
    """Return the server of the figures that FIELDS returns, not started; IS_OPEN: to other computers, too."""
    host, port = address
    return MetricsServer(fields, about, MetricsSettings(host, port, open=is_open))
