"""Commands for a running machine: status, send, watch, call, page, estop (docs/ipc.md)."""

import argparse
import json
from typing import Any

from coordinator.cli.arguments.target import declare_target, target_of
from coordinator.ipc.client.client import Client, Update
from coordinator.ipc.client.target import Target
from coordinator.ipc.client.upload import send_program, show_progress
from coordinator.ipc.protocol.methods import ApiError
from coordinator.support.interrupts import Terminated
from coordinator.support.job_names import RULE, is_job_name
from coordinator.support.quoting import shown as quoted
from coordinator.support.report import PlainReport
from nodes.support.errors import CanductorError
from nodes.support.option_values import UsageError, add_command, decimal, existing_file, integer
from nodes.support.terminal import show, show_error


def add_to(commands: Any) -> None:
    """Add the commands."""
    for name, summary, declare, run in (
        ("status", "print the state of a running machine", declare_target, _status),
        ("send", "send a file to a running machine and print it", _declare_send, _send),
        ("watch", "show the fields of a running machine and their changes", _declare_watch, _watch),
        ("call", "call a method of a running machine", _declare_call, _call),
        ("page", "print a link that opens the live page of a running machine once", _declare_page, _page),
        ("estop", "stop a running machine immediately", declare_target, _estop),
    ):
        add_command(commands, name, summary, declare, run)


# ---------------------------------------------------------------------------------------- status, send, estop


def _status(given: argparse.Namespace) -> PlainReport:
    async def body(client: Client) -> dict[str, Any]:
        info = await client.call("machine.info")
        state = await client.call("state.get", {"fields": ["job.*", "nodes.*"]})
        return {"info": info, "state": state["values"]}

    result = target_of(given).run(body)
    info = result["info"]
    lines = [f"{info.get('name', 'machine')}: {info.get('state', 'state not known')}"]
    if info.get("cause"):
        lines.append(f"  because: {info['cause']}")
    lines += [f"  {path} = {_word(value)}" for path, value in sorted(result["state"].items())]
    return PlainReport({"result": result}, "\n".join(lines))


def _declare_send(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("file", type=existing_file, help="G-code file")
    add("--name", help="name of the file on the machine (default: its own name)")
    add("--replace", action="store_true", help="overwrite an existing file of that name")
    add("--no-start", dest="start", action="store_false", help="do not print the file")
    declare_target(command)


def _send(given: argparse.Namespace) -> PlainReport:
    name = given.name or given.file.name
    if not is_job_name(name):
        raise UsageError(f"{quoted(name)} must be {RULE}; give --name")
    result = send_program(
        target_of(given),
        given.file,
        name,
        replace=given.replace,
        start=given.start,
        on_progress=None if given.json else show_progress,
    )
    return PlainReport(
        {"result": result}, f"{name} is {'being printed' if given.start else 'in the job folder'}"
    )


def _estop(given: argparse.Namespace) -> PlainReport:
    result = target_of(given).call_first("machine.emergency_stop")
    return PlainReport({"result": result}, "stopped: every node was ordered to shut down")


# --------------------------------------------------------------------------------------------------- call


def _declare_call(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("method", help="name of the method; api.methods lists all")
    add("params", nargs="*", metavar="NAME=VALUE", help="parameters; a value is JSON or plain text")
    declare_target(command)


def _call(given: argparse.Namespace) -> PlainReport:
    result = target_of(given).call(given.method, _read_params(given.params))
    return PlainReport({"result": result}, json.dumps(result, indent=2, ensure_ascii=False))


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


# -------------------------------------------------------------------------------------------------- watch


def _declare_watch(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("fields", nargs="*", metavar="FIELD", help="fields to show; * matches any characters (default: all)")
    rate = decimal(0.01, 50, "Hz")
    add("--rate", type=rate, default=2.0, metavar="HZ", help="maximum number of updates per second")
    add("--count", type=integer(1), metavar="N", help="exit after this many updates (default: at Ctrl-C)")
    declare_target(command)


def _watch(given: argparse.Namespace) -> PlainReport:
    """Show fields as they change, until the count is reached or Ctrl-C, which is no failure."""
    fields = given.fields or ["*"]
    shown = 0

    async def body(client: Client) -> None:
        nonlocal shown
        updates = client.watch(fields, given.rate)
        try:
            async for update in updates:
                if update.snapshot and not update.values:
                    _report_no_match(fields, waiting=shown + 1 != given.count)
                _show_update(update, as_json=given.json)
                shown += 1
                if shown == given.count:
                    return
        finally:
            await updates.aclose()

    try:
        target_of(given).run(body)
    except Terminated:
        raise
    except KeyboardInterrupt:
        pass
    return PlainReport({"result": {"updates": shown}}, "")


def _report_no_match(fields: list[str], *, waiting: bool) -> None:
    addition = "; waiting for one that does" if waiting else ""
    show_error(f"canductor: no field matches {' '.join(fields)} now{addition}")


def _show_update(update: Update, *, as_json: bool) -> None:
    if as_json:
        shown = {
            "sequence": update.sequence,
            "snapshot": update.snapshot,
            "values": update.values,
            "removed": sorted(update.removed),
        }
        show(json.dumps(shown))
    else:
        lines = [f"{path} = {_word(update.values[path])}" for path in sorted(update.values)]
        show("\n".join([*lines, *(f"{path} is gone" for path in sorted(update.removed)), ""]), end="")


def _word(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


# --------------------------------------------------------------------------------------------------- page


def _declare_page(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("--watch", action="store_true", help="the link only lets the browser watch, not operate the machine")
    add("--sign-out", action="store_true", help="end the sessions of all browsers instead")
    declare_target(command)


def _page(given: argparse.Namespace) -> PlainReport:
    if given.sign_out and given.watch:
        raise UsageError("--sign-out prints no link; leave out --watch")
    target = target_of(given)
    if given.sign_out:
        result = _call_page(target, "page.sign_out", {})
        return PlainReport({"result": result}, f"sessions of browsers that were ended: {result['sessions']}")
    result = _call_page(target, "page.link", {"scope": "watch" if given.watch else "operate"})
    minutes = result["expires_s"] / 60
    return PlainReport(
        {"result": result},
        f"{result['url']}\nOpen it in a browser within {minutes:.0f} minutes; it works once.",
    )


def _call_page(target: Target, method: str, params: dict[str, Any]) -> Any:
    try:
        return target.call(method, params)
    except ApiError as error:
        if error.code == "no_such_method":
            raise CanductorError("the machine serves no live page; start it with --web") from None
        raise
