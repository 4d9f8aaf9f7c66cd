"""The options that serve a machine: what is reachable from other computers needs protection."""

import io
from pathlib import Path

import pytest

from coordinator.cli import main as cli
from coordinator.cli.arguments.serving import declare_serving, serving_options
from coordinator.front_ends.serve import ServeOptions
from coordinator.support.examples import DEMO_GCODE, DEMO_MACHINE
from nodes.support.option_values import Parser, UsageError


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert cli.main(["demo", "--serve", *words]) != 0
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    return err


@pytest.mark.parametrize("address", ["0.0.0.0:8080", "192.168.1.5:8080", "[::]:8080"])
def test_beyond_loopback_there_are_tokens_and_tls(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, address: str
) -> None:
    assert "needs --tokens FILE" in refused(capsys, "--web", address)
    tokens = str(tmp_path / "tokens")
    assert "needs --tls-certificate and --tls-key" in refused(capsys, "--web", address, "--tokens", tokens)


@pytest.mark.parametrize(
    "address", ["", "x", "0", "65536", "-1", "8080x", "host:8080", "127.0.0.1:", ":8080", "1.2.3:1"]
)
def test_what_is_no_address(capsys: pytest.CaptureFixture[str], address: str) -> None:
    assert "--web is '" in refused(capsys, f"--web={address}")


@pytest.mark.parametrize(
    "name", ["", "a b", "-x", "x-", "a..b", "é", "a" * 64, "a." * 128, "1.2.3.4/x", "x:80"]
)
def test_what_is_no_host_name(capsys: pytest.CaptureFixture[str], name: str) -> None:
    assert "must be a host name" in refused(capsys, "--web", "8080", f"--web-name={name}")


def test_names_are_of_the_page(capsys: pytest.CaptureFixture[str]) -> None:
    assert "--web-name goes with --web" in refused(capsys, "--web-name", "printer.example")


def test_without_serve_there_is_no_page(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["demo", "--web", "8080"]) != 0
    assert "give --serve" in capsys.readouterr().err


SERVICE = {
    ("--log-file", "log"): "--log-file",
    ("--name", "x y"): "--name",
    ("--jobs", "."): "--jobs",
    ("--tokens", "t", "--announce"): "--tokens",
    ("--no-announce",): "--announce/--no-announce",
    ("--node-commands",): "--node-commands",
    ("--web-name", "printer.example"): "--web-name",
    ("--metrics-open",): "--metrics-open",
}


ADDRESSES = "give --ipc, --klippy-api, --pty, --tcp, --web or --metrics"


@pytest.mark.parametrize("words", SERVICE)
@pytest.mark.parametrize(
    ("command", "remedy"),
    [
        (("run", DEMO_MACHINE), ADDRESSES),
        (("run", DEMO_MACHINE, "--gcode", DEMO_GCODE), ADDRESSES),
        (("demo",), "give --serve"),
    ],
    ids=["run", "print", "demo"],
)
def test_where_nothing_is_served_there_is_nothing_for_a_service(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
    command: tuple[object, ...],
    remedy: str,
) -> None:
    """Failed before: they were ignored, and without a terminal nothing was an empty program."""
    monkeypatch.setattr("sys.stdin", io.StringIO())
    assert cli.main([*map(str, command), *words]) == cli.EXIT_USAGE
    sentence = f"{SERVICE[words]} is for a service; {remedy}, or leave it out"
    assert sentence in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--gcode", "FILE", "--ipc", "sock"), "--gcode prints a file and exits; leave it out"),
        (("--tcp", "127.0.0.1:7125"), "--tokens"),
        (("--ipc", "sock", "--jobs", "none"), "must be a folder"),
    ],
)
def test_what_a_machine_cannot_be_run_with(
    capsys: pytest.CaptureFixture[str], words: tuple[str, ...], sentence: str
) -> None:
    words = tuple(str(DEMO_GCODE) if word == "FILE" else word for word in words)
    assert cli.main(["run", str(DEMO_MACHINE), *words]) == cli.EXIT_USAGE
    err = capsys.readouterr().err
    assert sentence in err
    assert err.count("\n") == 1


# ------------------------------------------------------------------------------------- announcing, metrics


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
