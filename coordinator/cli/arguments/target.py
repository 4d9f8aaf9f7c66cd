"""The options that select a running machine."""

import argparse

from coordinator.ipc.client.target import Target
from nodes.support.errors import CanductorError
from nodes.support.option_values import decimal, existing_file, options_from, regular_file
from nodes.support.secret_file import read_secret


def declare_target(command: argparse.ArgumentParser) -> None:
    """Add the options to COMMAND."""
    add = command.add_argument
    add("--at", dest="address", metavar="ADDRESS", help="Unix socket, tcp://HOST:PORT or tls://HOST:PORT")
    add(
        "--token-file",
        dest="token",
        type=_read_token,
        metavar="FILE",
        help="file with the access token, for TCP",
    )
    add(
        "--certificate",
        type=regular_file,
        metavar="PEM",
        help="trust only servers whose certificate is this one, or signed by it",
    )
    add(
        "--timeout",
        dest="timeout_s",
        type=decimal(0.1, 3600, "s"),
        default=5.0,
        metavar="S",
        help="how long to wait for the machine's answer, in seconds",
    )


def target_of(given: argparse.Namespace) -> Target:
    """Return the machine that the options select."""
    return options_from(Target, given)


def _read_token(text: str) -> str:
    path = existing_file(text)
    words = read_secret(path, "the token's file")[0].split()
    if not words:
        raise CanductorError(f"the token's file {path} is empty; write the token into it")
    if len(words) > 1:
        raise CanductorError(f"the token's file {path} must hold one token, and nothing else")
    return words[0]
