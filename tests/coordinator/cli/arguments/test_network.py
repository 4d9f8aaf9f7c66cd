"""The options that announce a machine and serve its metrics."""

from pathlib import Path

import pytest

from coordinator.cli.arguments.serving import declare_serving, serving_options
from coordinator.front_ends.serve import ServeOptions
from nodes.support.option_values import Parser, UsageError


def served(*words: str, announce: bool | None = None) -> ServeOptions:
    parser = Parser()
    declare_serving(parser)
    return serving_options(parser.parse_args(words), Path("demo.cfg"), announce)


@pytest.mark.parametrize(
    ("words", "of_run", "of_demo"),
    [
        ((), None, False),
        (("--tcp", "x:1", "--tokens", "t"), None, False),
        (("--tcp", "x:1", "--tokens", "t", "--announce"), True, True),
        (("--tcp", "x:1", "--tokens", "t", "--no-announce"), False, False),
        (("--no-announce",), False, False),
    ],
)
def test_announcing(words: tuple[str, ...], of_run: bool | None, of_demo: bool) -> None:
    assert served(*words).announce is of_run
    assert served(*words, announce=False).announce is of_demo


def test_a_unix_socket_is_not_announced() -> None:
    with pytest.raises(UsageError, match="--announce needs --tcp"):
        served("--announce")


@pytest.mark.parametrize(
    ("words", "address"),
    [
        ((), None),
        (("--metrics", "9177"), ("127.0.0.1", 9177)),
        (("--metrics", "localhost:9177"), ("127.0.0.1", 9177)),
        (("--metrics", "127.0.0.2:65535"), ("127.0.0.2", 65535)),
        (("--metrics", "[::1]:9177"), ("::1", 9177)),
        (("--metrics", "10.0.0.2:9177", "--metrics-open"), ("10.0.0.2", 9177)),
        (("--metrics", "[::]:9177", "--metrics-open"), ("::", 9177)),
    ],
)
def test_where_the_metrics_are(words: tuple[str, ...], address: tuple[str, int] | None) -> None:
    assert served(*words).metrics == address


@pytest.mark.parametrize(
    "word",
    [
        "http",
        "",
        "0",
        "65536",
        "٩",
        "99999999999",
        "printer.example:9177",
        "[::1]",
        "1.2.3:5",
        "127.0.0.1:-1",
        ":",
    ],
)
def test_what_is_no_metrics_address(word: str) -> None:
    with pytest.raises(UsageError, match="must be a port, or an IP address and a port"):
        served(f"--metrics={word}", "--metrics-open")


@pytest.mark.parametrize("host", ["0.0.0.0", "10.0.0.2", "[::]", "[fe80::1%eth0]"])  # noqa: S104
def test_others_read_the_metrics_only_if_they_are_to(host: str) -> None:
    with pytest.raises(UsageError, match="needs --metrics-open"):
        served("--metrics", f"{host}:9177")
    with pytest.raises(UsageError, match="goes with --metrics"):
        served("--metrics-open")
