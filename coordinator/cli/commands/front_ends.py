"""Commands that talk to a machine that runs, through its interface (docs/ipc.md)."""

import json
import ssl
import sys
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import shtab

from coordinator.cli.arguments.front_ends import Target
from coordinator.cli.commands.discover import find_machines
from coordinator.cli.parser import whole_parser
from coordinator.ipc.client.client import Client, Update
from coordinator.ipc.protocol.methods import ApiError
from coordinator.ipc.server.uploads import PART_MAX
from coordinator.support.command_options import Report, Terminated
from coordinator.support.interrupts import run_to_end
from nodes.support.errors import CanductorError

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Answer:
    """What the machine said."""

    result: Any
    text: str
    ok: bool = True

    def to_json(self) -> Mapping[str, object]:
        """Return the result."""
        return {"result": self.result}

    def to_text(self) -> str:
        """Return it for a reader."""
        return self.text


def tls_of(target: Target) -> ssl.SSLContext | None:
    """Return how TARGET's certificate is checked; None: as usual. Raises CanductorError."""
    if target.certificate is None:
        return None
    try:
        return ssl.create_default_context(cafile=target.certificate)
    except (OSError, ssl.SSLError) as error:
        raise CanductorError(f"{target.certificate} is no certificate: {error}") from None


def _with_client(target: Target, body: Callable[[Client], Awaitable[T]]) -> T:
    async def main() -> T:
        tls = tls_of(target)
        client = Client.connect(
            target.address, token=target.token, name="canductor", tls=tls, timeout_s=target.timeout_s
        )
        async with client:
            return await body(client)

    return run_to_end(main)


def call(target: Target, method: str, params: dict[str, Any]) -> Answer:
    """Call METHOD with PARAMS; raises CanductorError."""

    async def body(client: Client) -> Any:
        return await client.call(method, params)

    result = _with_client(target, body)
    return Answer(result, json.dumps(result, indent=2, ensure_ascii=False))


def watch(target: Target, fields: list[str], rate_hz: float, count: int | None, *, as_json: bool) -> Answer:
    """Show FIELDS as they change, COUNT times or until Ctrl-C; raises CanductorError."""
    shown = 0

    async def body(client: Client) -> None:
        nonlocal shown
        updates = client.watch(fields, rate_hz)
        try:
            async for update in updates:
                if update.snapshot and not update.values:
                    _say_that_none_matches(fields, waiting=shown + 1 != count)
                _show_update(update, as_json=as_json)
                shown += 1
                if shown == count:
                    return
        finally:
            await updates.aclose()

    try:
        _with_client(target, body)
    except Terminated:
        raise
    except KeyboardInterrupt:
        pass  # how one ends a watch
    return Answer({"updates": shown}, "")


def _say_that_none_matches(fields: list[str], *, waiting: bool) -> None:
    addition = "; waiting for one that does" if waiting else ""
    sys.stderr.write(f"canductor: no field matches {' '.join(fields)} now{addition}\n")
    sys.stderr.flush()


def _show_update(update: Update, *, as_json: bool) -> None:
    if as_json:
        told = {
            "sequence": update.sequence,
            "snapshot": update.snapshot,
            "values": update.values,
            "removed": sorted(update.removed),
        }
        sys.stdout.write(json.dumps(told) + "\n")
    else:
        sys.stdout.writelines(f"{path} = {_word(update.values[path])}\n" for path in sorted(update.values))
        sys.stdout.writelines(f"{path} is gone\n" for path in sorted(update.removed))
    sys.stdout.flush()


def _word(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def status(target: Target) -> Answer:
    """Tell the machine's name and state, and how its job and nodes are; raises CanductorError."""

    async def body(client: Client) -> dict[str, Any]:
        info = await client.call("machine.info")
        state = await client.call("state.get", {"fields": ["job.*", "nodes.*"]})
        return {"info": info, "state": state["values"]}

    result = _with_client(target, body)
    info = result["info"]
    lines = [f"{info.get('name', 'machine')}: {info.get('state', 'state not known')}"]
    if info.get("cause"):
        lines.append(f"  because: {info['cause']}")
    lines += [f"  {path} = {_word(value)}" for path, value in sorted(result["state"].items())]
    return Answer(result, "\n".join(lines))


def estop(target: Target) -> Answer:
    """Stop the machine at once; raises CanductorError."""

    async def body(client: Client) -> Any:
        return await client.call("machine.emergency_stop")

    result = _with_client(target, body)
    return Answer(result, "stopped: every node was told to shut down")


def page_link(target: Target, scope: str) -> Answer:
    """Print an address that lets one browser into the live page with SCOPE, once; raises CanductorError."""
    result = _call_page(target, "page.link", {"scope": scope})
    minutes = result["expires_s"] / 60
    return Answer(
        result, f"{result['url']}\nOpen it in a browser within {minutes:.0f} minutes; it works once."
    )


def sign_out(target: Target) -> Answer:
    """End the sessions of all browsers; raises CanductorError."""
    result = _call_page(target, "page.sign_out", {})
    return Answer(result, f"sessions of browsers that were ended: {result['sessions']}")


def _call_page(target: Target, method: str, params: dict[str, Any]) -> Any:
    async def body(client: Client) -> Any:
        return await client.call(method, params)

    try:
        return _with_client(target, body)
    except ApiError as error:
        if error.code == "no_such_method":
            raise CanductorError("the machine serves no live page; start it with --web") from None
        raise


def send(target: Target, file: Path, name: str, *, replace: bool, start: bool, quiet: bool) -> Answer:
    """Send FILE as NAME into the job folder, and begin to print it; raises CanductorError."""
    if file.exists() and not file.is_file():
        raise CanductorError(f"{file} is no regular file; save what it holds in one, and send that")
    size = file.stat().st_size

    async def body(client: Client) -> Any:
        sent = 0
        with file.open(encoding="utf-8", errors="replace", newline="") as text:
            part = text.read(PART_MAX)
            while True:
                following = text.read(PART_MAX)
                params: dict[str, Any] = {
                    "file": name,
                    "offset": sent,
                    "text": part,
                    "done": not following,
                    "replace": replace,
                }
                sent = (await client.call("job.upload", params))["size_bytes"]
                _show_progress(sent, size, quiet=quiet)
                if not following:
                    break
                part = following
        return await client.call("job.start", {"file": name}) if start else {"size_bytes": sent}

    result = _with_client(target, body)
    return Answer(result, f"{name} is {'being printed' if start else 'in the job folder'}")


def _show_progress(sent: int, size: int, *, quiet: bool) -> None:
    if not quiet and sys.stderr.isatty():
        end = "\n" if sent >= size else ""
        sys.stderr.write(f"\rsent {sent:,} of {size:,} bytes{end}")


def discover(timeout_s: float) -> Report:
    """List the machines that answer within TIMEOUT_S."""
    return run_to_end(lambda: find_machines(timeout_s))


def completion(shell: str) -> Answer:
    """Return the script that makes SHELL complete the words of canductor."""
    script = shtab.complete(whole_parser(), shell)
    return Answer(script, script.rstrip())
