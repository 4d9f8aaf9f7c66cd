"""The words for announcing and for metrics."""

import argparse

import pytest

from coordinator.cli.arguments.network import declare_network, read_announce, read_metrics
from nodes.support.option_values import UsageError


def given(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    parser.add_argument("--tcp")
    declare_network(parser.add_argument)
    return parser.parse_args(words)


@pytest.mark.parametrize(
    ("words", "of_run", "of_demo"),
    [
        ((), None, False),
        (("--tcp", "x:1"), None, False),
        (("--tcp", "x:1", "--announce"), True, True),
        (("--tcp", "x:1", "--no-announce"), False, False),
        (("--no-announce",), False, False),
    ],
)
def test_announcing(words: tuple[str, ...], of_run: bool | None, of_demo: bool) -> None:
    assert read_announce(given(*words), unless_said=None) is of_run
    assert read_announce(given(*words), unless_said=False) is of_demo


def test_a_unix_socket_is_not_announced() -> None:
    with pytest.raises(UsageError, match="--announce needs --tcp"):
        read_announce(given("--announce"), unless_said=None)


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
    assert read_metrics(given(*words)) == address


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
def test_words_that_make_no_endpoint(word: str) -> None:
    with pytest.raises(UsageError, match="must be a port, or an IP address and one"):
        read_metrics(given(f"--metrics={word}", "--metrics-open"))


@pytest.mark.parametrize("host", ["0.0.0.0", "10.0.0.2", "[::]", "[fe80::1%eth0]"])  # noqa: S104
def test_others_read_the_metrics_only_if_they_are_to(host: str) -> None:
    with pytest.raises(UsageError, match="needs --metrics-open"):
        read_metrics(given("--metrics", f"{host}:9177"))
    with pytest.raises(UsageError, match="goes with --metrics"):
        read_metrics(given("--metrics-open"))
