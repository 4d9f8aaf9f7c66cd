"""The words of the commands that talk to a machine that runs, and of shell completion."""

import argparse
import importlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, cast

from coordinator.cli.arguments.table import declare_table
from coordinator.support.command_options import Report
from nodes.support.errors import CanductorError
from nodes.support.option_values import UsageError, existing_file, number, whole
from nodes.support.secret_file import read_secret

SHELLS: Final = ("bash", "zsh", "fish")


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """Which machine, and who asks."""

    address: str | None
    """None: the only one of this user that runs here."""
    token: str | None
    certificate: Path | None
    """What a TLS server must have been signed with; None: what this computer trusts."""
    timeout_s: float


def declare(command: argparse.ArgumentParser, name: str) -> None:
    """Add the options of the command NAME."""
    add = command.add_argument
    if name == "table":
        declare_table(command, add_target, read_target)
        return
    if name == "call":
        add("method", help="its name; api.methods lists all")
        add("params", nargs="*", metavar="NAME=VALUE", help="parameters; values as JSON, or as they are")
    elif name == "watch":
        add("fields", nargs="*", metavar="FIELD", help="which fields; * stands for any characters")
        add("--rate", default="2", metavar="HZ", help="updates a second, at most; 2 if not given")
        add("--count", metavar="N", help="end after so many updates; else with Ctrl-C")
    elif name == "send":
        add("file", type=Path, help="g-code file")
        add("--name", help="what it is called there; its own name if not given")
        add("--replace", action="store_true", help="overwrite an existing file of that name")
        add("--no-start", action="store_true", help="only send it")
    elif name == "page":
        add("--watch", action="store_true", help="the browser may look, and do nothing else")
        add("--sign-out", action="store_true", help="end the sessions of all browsers instead")
    elif name == "completion":
        add("shell", choices=SHELLS, help="for which shell")
    elif name == "discover":
        add("--timeout", default="3", metavar="S", help="for machines to answer; 3 if not given")
    if name not in ("completion", "discover"):
        add_target(command)
    add("--json", action="store_true", help="print one JSON object as the last line")
    command.set_defaults(make_job=_MAKERS[name])


def add_target(command: argparse.ArgumentParser) -> None:
    """Add the options that say which machine."""
    add = command.add_argument
    add("--at", metavar="ADDRESS", help="socket, tcp://HOST:PORT or tls://HOST:PORT")
    add("--token-file", type=Path, metavar="FILE", help="file that holds the token, for TCP")
    add("--certificate", type=Path, metavar="PEM", help="certificate that the server must have")
    add("--timeout", default="5", metavar="S", help="for the machine to answer; 5 if not given")


def read_target(given: argparse.Namespace) -> Target:
    """Read them; raises CanductorError, UsageError."""
    return Target(
        address=given.at,
        token=None if given.token_file is None else _read_token(given.token_file),
        certificate=existing_file(given.certificate),
        timeout_s=number("--timeout", given.timeout, 0.1, 3600, "s"),
    )


def _read_token(path: Path) -> str:
    existing_file(path)
    words = read_secret(path, "the token's file")[0].split()
    if not words:
        raise CanductorError(f"the token's file {path} is empty; write the token into it")
    if len(words) > 1:
        raise CanductorError(f"the token's file {path} must hold one token, and nothing else")
    return words[0]


def _run(name: str, *arguments: object, **options: object) -> Report:
    function = getattr(importlib.import_module("coordinator.cli.commands.front_ends"), name)
    return cast("Report", function(*arguments, **options))


def read_params(pairs: list[str]) -> dict[str, Any]:
    """Read NAME=VALUE words; a value that is no JSON is a string. Raises UsageError."""
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


def _call(given: argparse.Namespace) -> Callable[[], Report]:
    target, params = read_target(given), read_params(given.params)
    return lambda: _run("call", target, given.method, params)


def _watch(given: argparse.Namespace) -> Callable[[], Report]:
    target, rate_hz = read_target(given), number("--rate", given.rate, 0.01, 50, "Hz")
    count = None if given.count is None else whole("--count", given.count, 1)
    return lambda: _run("watch", target, given.fields or ["*"], rate_hz, count, as_json=given.json)


def _status(given: argparse.Namespace) -> Callable[[], Report]:
    target = read_target(given)
    return lambda: _run("status", target)


def _send(given: argparse.Namespace) -> Callable[[], Report]:
    target = read_target(given)
    existing_file(given.file)
    name = given.name or given.file.name
    return lambda: _run(
        "send", target, given.file, name, replace=given.replace, start=not given.no_start, quiet=given.json
    )


def _estop(given: argparse.Namespace) -> Callable[[], Report]:
    target = read_target(given)
    return lambda: _run("estop", target)


def _page(given: argparse.Namespace) -> Callable[[], Report]:
    target = read_target(given)
    if given.sign_out and given.watch:
        raise UsageError("--sign-out prints no link; leave --watch out")
    if given.sign_out:
        return lambda: _run("sign_out", target)
    scope = "watch" if given.watch else "operate"
    return lambda: _run("page_link", target, scope)


def _discover(given: argparse.Namespace) -> Callable[[], Report]:
    timeout_s = number("--timeout", given.timeout, 0.1, 60, "s")
    return lambda: _run("discover", timeout_s)


def _completion(given: argparse.Namespace) -> Callable[[], Report]:
    return lambda: _run("completion", given.shell)


_MAKERS: Final = {
    "call": _call,
    "watch": _watch,
    "status": _status,
    "send": _send,
    "page": _page,
    "estop": _estop,
    "completion": _completion,
    "discover": _discover,
}
