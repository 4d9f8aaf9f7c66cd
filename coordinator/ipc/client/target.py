"""Which machine a program talks to, and how it gets in."""

import ssl
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from coordinator.ipc.client.client import Client
from coordinator.support.interrupts import run_to_end
from coordinator.support.values import Value
from nodes.support.errors import CanductorError

T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """A running machine, and the credentials for it."""

    address: str | None = None
    """None: the only machine of this user that runs on this computer."""
    token: str | None = None
    certificate: Path | None = None
    """The certificate that must have signed that of a TLS server; None: those that this computer trusts."""
    timeout_s: float = 5.0

    def settings(self, name: str) -> dict[str, Any]:
        """Return the options of a ``Client`` called NAME; raises CanductorError."""
        return {"token": self.token, "tls": self._tls(), "timeout_s": self.timeout_s, "name": name}

    def _tls(self) -> ssl.SSLContext | None:
        if self.certificate is None:
            return None
        try:
            return ssl.create_default_context(cafile=self.certificate)
        except (OSError, ssl.SSLError) as error:
            raise CanductorError(f"{self.certificate} is no certificate: {error}") from None

    def call(self, method: str, params: Mapping[str, Value] | None = None) -> Any:
        """Call METHOD with PARAMS and return its result; raises CanductorError."""
        return self.run(lambda client: client.call(method, params))

    def call_first(self, method: str) -> Any:
        """Call METHOD in the first bytes of the connection; raises CanductorError."""

        async def main() -> Any:
            async with Client(self.address, first=method, **self.settings("canductor")) as client:
                assert client.first is not None
                return await client.first

        return run_to_end(main)

    def run(self, body: Callable[[Client], Awaitable[T]]) -> T:
        """Run BODY with a connected client, on its own loop; Ctrl-C cancels it. Raises CanductorError."""

        async def main() -> T:
            async with Client(self.address, **self.settings("canductor")) as client:
                return await body(client)

        return run_to_end(main)
