"""The options that serve a machine to front ends: sockets, tokens, the live page, the network, metrics."""

import argparse
import re
from ipaddress import ip_address
from pathlib import Path
from typing import Any, Final

from coordinator.front_ends.serve import ServeOptions
from coordinator.support.examples import machine_name
from nodes.support.file_kind import is_folder
from nodes.support.numbers import read_int
from nodes.support.option_values import UsageError, options_from, regular_file

HOST_NAME_MAX: Final = 253
_LABEL: Final = re.compile(r"[a-z0-9_]([a-z0-9_-]{0,61}[a-z0-9_])?", re.ASCII)


def declare_serving(command: argparse.ArgumentParser) -> None:
    """Add the options to COMMAND."""
    group = command.add_argument_group("serving front ends")
    actions: list[argparse.Action] = []

    def add(*names: str, **how: Any) -> None:
        actions.append(group.add_argument(*names, **how))

    add(
        "--ipc",
        dest="path",
        type=Path,
        metavar="PATH",
        help="serve programs at this Unix socket; see docs/run.md",
    )
    add("--klippy-api", type=Path, metavar="PATH", help="serve Moonraker at this Unix socket")
    add(
        "--pty",
        type=Path,
        metavar="PATH",
        help="serve a serial host such as OctoPrint: PATH links to its port",
    )
    add("--log-file", type=Path, metavar="FILE", help="write the log to this file, in turns of 10 MiB")
    add("--name", help="name of the machine (default: that of the configuration file)")
    add("--jobs", type=_folder, metavar="DIR", help="folder of the files that front ends may print")
    add("--node-commands", action="store_true", help="let administrators send raw commands to nodes")
    add(
        "--tcp",
        type=_tcp_address,
        metavar="HOST:PORT",
        help="serve programs at this address; needs --tokens and, beyond loopback, TLS",
    )
    add(
        "--tokens",
        type=Path,
        metavar="FILE",
        help="access tokens for clients on the network; see docs/security.md",
    )
    add(
        "--tls-certificate",
        dest="certificate",
        type=regular_file,
        metavar="FILE",
        help="certificate chain (PEM)",
    )
    add("--tls-key", dest="private_key", type=regular_file, metavar="FILE", help="private key (PEM)")
    add(
        "--no-tls-on-loopback",
        dest="plain_on_loopback",
        action="store_true",
        help="allow TCP without TLS on a loopback address",
    )
    add(
        "--web",
        type=_web_address,
        metavar="[HOST:]PORT",
        help="serve the live page; beyond this computer (0.0.0.0:PORT) needs --tokens and TLS",
    )
    add("--web-without-tls", action="store_true", help="serve the live page unencrypted beyond this computer")
    add(
        "--web-name",
        dest="web_names",
        type=_host_name,
        action="append",
        metavar="NAME",
        help="accept this host name for the live page; IP addresses and localhost are always accepted",
    )
    add(
        "--announce",
        action=argparse.BooleanOptionalAction,
        help="announce the TCP port to 'canductor discover' (default: only 'run', beyond loopback)",
    )
    add(
        "--metrics",
        type=_metrics_address,
        metavar="[ADDRESS:]PORT",
        help="serve metrics for Prometheus at http://ADDRESS:PORT/metrics (default address: 127.0.0.1)",
    )
    add(
        "--metrics-open",
        action="store_true",
        help="let other computers read the metrics, without authentication",
    )
    command.set_defaults(serving=tuple(actions))


def is_asked_to_serve(given: argparse.Namespace) -> bool:
    """Return whether the options ask for a service that stays."""
    return any(
        address is not None
        for address in (given.path, given.klippy_api, given.pty, given.tcp, given.web, given.metrics)
    )


def refuse_serving_options(given: argparse.Namespace, remedy: str) -> None:
    """Raise UsageError where an option is given, since nothing is served; REMEDY ends its sentence."""
    for action in given.serving:
        if getattr(given, action.dest) != action.default:
            raise UsageError(f"{'/'.join(action.option_strings)} is for a service; {remedy}, or leave it out")


def serving_options(given: argparse.Namespace, config: Path, announce: bool | None = None) -> ServeOptions:
    """Return the options of the machine of CONFIG, ANNOUNCE being the default; raises UsageError."""
    options = options_from(
        ServeOptions,
        given,
        name=given.name or machine_name(config),
        config=config,
        announce=announce if given.announce is None else given.announce,
        web_names=tuple(given.web_names or ()),
    )
    if not re.fullmatch(r"[A-Za-z0-9_-]{1,48}", options.name):
        raise UsageError(f"--name is '{options.name}', must be 1 to 48 letters, digits, - and _")
    if options.tcp is not None and options.tokens is None:
        raise UsageError("--tcp needs --tokens FILE: clients on the network have to authenticate")
    if options.announce and options.tcp is None:
        raise UsageError("--announce needs --tcp HOST:PORT: others cannot reach a Unix socket")
    _check_metrics(options)
    _check_web(options)
    return options


def _check_metrics(options: ServeOptions) -> None:
    if options.metrics is None:
        if options.metrics_open:
            raise UsageError("--metrics-open goes with --metrics [ADDRESS:]PORT")
    elif _is_beyond_loopback(options.metrics) and not options.metrics_open:
        raise UsageError(
            f"--metrics at {options.metrics[0]} needs --metrics-open: readers are not authenticated"
            " (see docs/security.md)"
        )


def _check_web(options: ServeOptions) -> None:
    if options.web is None:
        if options.web_names:
            raise UsageError("--web-name goes with --web [HOST:]PORT")
        return
    if not _is_beyond_loopback(options.web):
        return
    host = options.web[0]
    if options.tokens is None:
        raise UsageError(f"--web at {host} needs --tokens FILE: clients on the network have to authenticate")
    if not options.web_without_tls and (options.certificate is None or options.private_key is None):
        raise UsageError(
            f"--web at {host} needs --tls-certificate and --tls-key; or, on a network that you trust,"
            " --web-without-tls"
        )


def _is_beyond_loopback(address: tuple[str, int]) -> bool:
    return not ip_address(address[0]).is_loopback


def _folder(text: str) -> Path:
    if not is_folder(text):
        raise UsageError(f"is '{text}', must be a folder; create it")
    return Path(text)


def _host_name(text: str) -> str:
    name = text.lower()
    if len(name) > HOST_NAME_MAX or not all(_LABEL.fullmatch(label) for label in name.split(".")):
        raise UsageError(f"is '{name}', must be a host name such as printer.example")
    return name


def _tcp_address(text: str) -> tuple[str, int]:
    host, port = _host_port(text)
    if not host or not port:
        raise UsageError(f"is '{text}', must be HOST:PORT such as 127.0.0.1:7125")
    return host, port


def _web_address(text: str) -> tuple[str, int]:
    return _ip_address(text, "8080 or 0.0.0.0:8080")


def _metrics_address(text: str) -> tuple[str, int]:
    return _ip_address(text, "9100 or 10.0.0.2:9100")


def _ip_address(text: str, examples: str) -> tuple[str, int]:
    """Read [ADDRESS:]PORT; the address is that of loopback if there is none."""
    host, port = _host_port(text if ":" in text else f"127.0.0.1:{text}")
    host = "127.0.0.1" if host == "localhost" else host
    try:
        ip_address(host)
    except ValueError:
        port = 0
    if not port:
        raise UsageError(f"is '{text}', must be a port, or an IP address and a port, such as {examples}")
    return host, port


def _host_port(text: str) -> tuple[str, int]:
    """Split HOST:PORT; the port is 0 if it is none."""
    host, _, port = text.rpartition(":")
    number = read_int(port) or 0
    return host.removeprefix("[").removesuffix("]"), number if 0 < number < 65536 else 0
