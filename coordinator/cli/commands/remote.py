"""Commands for a running machine: status, send, watch, call, page, estop (docs/ipc.md)."""

import argparse
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from coordinator.cli.arguments.target import declare_target, target_of
from coordinator.ipc.client.client import Client, Update
from coordinator.ipc.client.target import Target
from coordinator.ipc.client.upload import send_program, show_progress
from coordinator.ipc.protocol.methods import ApiError
from coordinator.support.interrupts import Terminated
from coordinator.support.report import Report
from nodes.support.errors import CanductorError
from nodes.support.option_values import UsageError, add_command, existing_file, parse_float, parse_int

Job = Callable[[], Report]


def add_to(commands: Any) -> None:
    """Add the commands."""
    for name, summary, declare, make_job in (
        ("status", "print the state of a running machine", declare_target, _status),
        ("send", "send a file to a running machine and print it", _declare_send, _send),
        ("watch", "show the fields of a running machine and their changes", _declare_watch, _watch),
        ("call", "call a method of a running machine", _declare_call, _call),
        ("page", "print a link that opens the live page of a running machine once", _declare_page, _page),
        ("estop", "stop a running machine immediately", declare_target, _estop),
    ):
        add_command(commands, name, summary, declare, make_job)


def _declare_call(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("method", help="name of the method; api.methods lists all")
    add("params", nargs="*", metavar="NAME=VALUE", help="parameters; a value is JSON or plain text")
    declare_target(command)


def _call(given: argparse.Namespace) -> Job:
    target, params = target_of(given), _read_params(given.params)
    return lambda: call(target, given.method, params)


def _read_params(pairs: list[str]) -> dict[str, Any]:
    """Return NAME=VALUE as parameters; a value that is no JSON is a string. Raises UsageError."""
    params: dict[str, Any] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not name or not equals:
            raise UsageError(f"parameters are NAME=VALUE, not '{pair}'")
        if name in params:
            raise UsageError(f"the parameter {name} is given twice")
        try:
            params[name] = json.loads(text)
        except (ValueError, RecursionError):
            params[name] = text
    return params


def _declare_watch(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("fields", nargs="*", metavar="FIELD", help="fields to show; * matches any characters (default: all)")
    add(
        "--rate",
        type=partial(parse_float, low=0.01, high=50, unit="Hz"),
        default=2.0,
        metavar="HZ",
        help="maximum number of updates per second (default: 2)",
    )
    add(
        "--count",
        type=partial(parse_int, low=1),
        metavar="N",
        help="exit after this many updates (default: at Ctrl-C)",
    )
    declare_target(command)


def _watch(given: argparse.Namespace) -> Job:
    target, fields = target_of(given), given.fields or ["*"]
    return lambda: watch(target, fields, given.rate, given.count, as_json=given.json)


def _status(given: argparse.Namespace) -> Job:
    target = target_of(given)
    return lambda: status(target)


def _declare_send(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("file", type=existing_file, help="G-code file")
    add("--name", help="name of the file on the machine (default: its own name)")
    add("--replace", action="store_true", help="overwrite an existing file of that name")
    add("--no-start", action="store_true", help="do not print the file")
    declare_target(command)


def _send(given: argparse.Namespace) -> Job:
    target, name = target_of(given), given.name or given.file.name
    return lambda: send(
        target, given.file, name, replace=given.replace, start=not given.no_start, quiet=given.json
    )


def _estop(given: argparse.Namespace) -> Job:
    target = target_of(given)
    return lambda: estop(target)


def _declare_page(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("--watch", action="store_true", help="the link only lets the browser watch, not operate the machine")
    add("--sign-out", action="store_true", help="end the sessions of all browsers instead")
    declare_target(command)


def _page(given: argparse.Namespace) -> Job:
    if given.sign_out and given.watch:
        raise UsageError("--sign-out prints no link; leave out --watch")
    target = target_of(given)
    if given.sign_out:
        return lambda: sign_out(target)
    return lambda: page_link(target, "watch" if given.watch else "operate")


# ---------------------------------------------------------------------------------------------------- work


@dataclass(frozen=True, slots=True)
class Answer:
    """The result of a method of the machine."""

    result: Any
    text: str
    ok: bool = True

    def to_json(self) -> Mapping[str, object]:
        """Return the result."""
        return {"result": self.result}

    def to_text(self) -> str:
        """Return it for a reader."""
        return self.text


def call(target: Target, method: str, params: dict[str, Any]) -> Answer:
    """Call METHOD with PARAMS; raises CanductorError."""
    result = target.run(lambda client: client.call(method, params))
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
                    _report_no_match(fields, waiting=shown + 1 != count)
                _show_update(update, as_json=as_json)
                shown += 1
                if shown == count:
                    return
        finally:
            await updates.aclose()

    try:
        target.run(body)
    except Terminated:
        raise
    except KeyboardInterrupt:
        pass  # how one ends a watch
    return Answer({"updates": shown}, "")


def _report_no_match(fields: list[str], *, waiting: bool) -> None:
    addition = "; waiting for one that does" if waiting else ""
    sys.stderr.write(f"canductor: no field matches {' '.join(fields)} now{addition}\n")
    sys.stderr.flush()


def _show_update(update: Update, *, as_json: bool) -> None:
    if as_json:
        shown = {
            "sequence": update.sequence,
            "snapshot": update.snapshot,
            "values": update.values,
            "removed": sorted(update.removed),
        }
        sys.stdout.write(json.dumps(shown) + "\n")
    else:
        sys.stdout.writelines(f"{path} = {_word(update.values[path])}\n" for path in sorted(update.values))
        sys.stdout.writelines(f"{path} is gone\n" for path in sorted(update.removed))
    sys.stdout.flush()


def _word(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def status(target: Target) -> Answer:
    """Return the machine's name and state, and those of its job and nodes; raises CanductorError."""

    async def body(client: Client) -> dict[str, Any]:
        info = await client.call("machine.info")
        state = await client.call("state.get", {"fields": ["job.*", "nodes.*"]})
        return {"info": info, "state": state["values"]}

    result = target.run(body)
    info = result["info"]
    lines = [f"{info.get('name', 'machine')}: {info.get('state', 'state not known')}"]
    if info.get("cause"):
        lines.append(f"  because: {info['cause']}")
    lines += [f"  {path} = {_word(value)}" for path, value in sorted(result["state"].items())]
    return Answer(result, "\n".join(lines))


def estop(target: Target) -> Answer:
    """Stop the machine at once; raises CanductorError."""
    result = target.run(lambda client: client.call("machine.emergency_stop"))
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
    try:
        return target.run(lambda client: client.call(method, params))
    except ApiError as error:
        if error.code == "no_such_method":
            raise CanductorError("the machine serves no live page; start it with --web") from None
        raise


def send(target: Target, file: Path, name: str, *, replace: bool, start: bool, quiet: bool) -> Answer:
    """Send FILE as NAME into the job folder, and print it if START; raises CanductorError."""
    on_progress = None if quiet else show_progress
    result = send_program(target, file, name, replace=replace, start=start, on_progress=on_progress)
    return Answer(result, f"{name} is {'being printed' if start else 'in the job folder'}")
