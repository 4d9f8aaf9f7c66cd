"""The words of the command line about serving front ends: sockets, tokens, the live page."""

import argparse
import re
from ipaddress import ip_address
from pathlib import Path
from typing import Final

from coordinator.cli.arguments.network import declare_network, read_announce, read_metrics
from coordinator.support.command_options import ServeOptions
from nodes.support.option_values import UsageError, existing_file

HOST_NAME_MAX: Final = 253
_LABEL: Final = re.compile(r"[a-z0-9_]([a-z0-9_-]{0,61}[a-z0-9_])?", re.ASCII)


def declare_serving(command: argparse.ArgumentParser) -> None:
    """Add the words to COMMAND."""
    add = command.add_argument_group("serving front ends").add_argument
    add("--ipc", type=Path, metavar="PATH", help="serve at this Unix socket; see docs/run.md")
    add("--klippy-api", type=Path, metavar="PATH", help="serve Moonraker at this Unix socket, too")
    add("--name", metavar="NAME", help="of the machine; the configuration file's name if not given")
    add("--jobs", type=Path, metavar="DIR", help="folder of the files that front ends may print")
    add("--node-commands", action="store_true", help="let administrators send raw commands to nodes")
    add("--tcp", metavar="HOST:PORT", help="serve there, too; needs --tokens, and TLS but on loopback")
    add("--tokens", type=Path, metavar="FILE", help="tokens of TCP clients; see docs/security.md")
    add("--tls-certificate", type=Path, metavar="FILE", help="certificate chain, PEM")
    add("--tls-key", type=Path, metavar="FILE", help="private key, PEM")
    add("--no-tls-on-loopback", action="store_true", help="TCP without TLS, on a loopback address only")
    add(
        "--web",
        metavar="[HOST:]PORT",
        help="serve the live page; beyond this computer (0.0.0.0:PORT) it needs --tokens, and TLS",
    )
    add("--web-without-tls", action="store_true", help="the page beyond this computer, readable on the way")
    add(
        "--web-name",
        action="append",
        metavar="NAME",
        help="host name under which the page is opened; without, only IP addresses and localhost are",
    )
    declare_network(add)


def is_asked_to_serve(given: argparse.Namespace) -> bool:
    """Tell whether the words ask for a service that stays."""
    return any(
        word is not None for word in (given.ipc, given.klippy_api, given.tcp, given.web, given.metrics)
    )


def read_serving(given: argparse.Namespace, config: Path, announce: bool | None = None) -> ServeOptions:
    """Return what the words ask for, ANNOUNCE unless they say so; raises UsageError."""
    name = given.name or (config.parent.name if config.stem == "machine" else config.stem)
    if not re.fullmatch(r"[A-Za-z0-9_-]{1,48}", name):
        raise UsageError(f"--name is '{name}', must be 1 to 48 letters, digits, - and _")
    if given.jobs is not None and not given.jobs.is_dir():
        raise UsageError(f"--jobs is '{given.jobs}', must be a folder; make it")
    if given.tcp is not None and given.tokens is None:
        raise UsageError("--tcp needs --tokens FILE: who comes over the network has to show one")
    return ServeOptions(
        name=name,
        path=given.ipc,
        config=config,
        klippy_api=given.klippy_api,
        jobs=given.jobs,
        node_commands=given.node_commands,
        tcp=None if given.tcp is None else _host_port("--tcp", given.tcp),
        tokens=given.tokens,
        certificate=existing_file(given.tls_certificate),
        private_key=existing_file(given.tls_key),
        plain_on_loopback=given.no_tls_on_loopback,
        announce=read_announce(given, announce),
        metrics=read_metrics(given),
        metrics_open=given.metrics_open,
        web=_web_address(given),
        web_without_tls=given.web_without_tls,
        web_names=_web_names(given),
    )


def _web_names(given: argparse.Namespace) -> tuple[str, ...]:
    """Return the host names that the page answers to, in lower case."""
    names = tuple(str(name).lower() for name in given.web_name or ())
    if names and given.web is None:
        raise UsageError("--web-name goes with --web [HOST:]PORT")
    for name in names:
        if len(name) > HOST_NAME_MAX or not all(_LABEL.fullmatch(label) for label in name.split(".")):
            raise UsageError(f"--web-name is '{name}', must be a host name such as printer.example")
    return names


def _web_address(given: argparse.Namespace) -> tuple[str, int] | None:
    """Return where the live page is to be; beyond loopback only with what protects it."""
    if given.web is None:
        return None
    text = given.web if ":" in given.web else f"127.0.0.1:{given.web}"
    host, port = _host_port("--web", text, "[ADDRESS:]PORT such as 8080 or 0.0.0.0:8080")
    host = "127.0.0.1" if host == "localhost" else host
    try:
        beyond = not ip_address(host).is_loopback
    except ValueError:
        raise UsageError(f"--web is '{given.web}', must be an IP address and a port, or a port") from None
    if beyond and given.tokens is None:
        raise UsageError(f"--web at {host} needs --tokens FILE: who comes over the network has to show one")
    if beyond and not given.web_without_tls and (given.tls_certificate is None or given.tls_key is None):
        raise UsageError(
            f"--web at {host} needs --tls-certificate and --tls-key; or --web-without-tls, if nobody listens"
        )
    return host, port


def _host_port(option: str, text: str, form: str = "HOST:PORT such as 127.0.0.1:7125") -> tuple[str, int]:
    host, colon, port = text.rpartition(":")
    if not (colon and host and port.isascii() and port.isdecimal() and 0 < int(port[:6]) < 65536):
        raise UsageError(f"{option} is '{text}', must be {form}")
    return host.strip("[]"), int(port)
