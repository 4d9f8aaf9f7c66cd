"""The words about serving: the page beyond this computer only with what protects it."""

from pathlib import Path

import pytest

from coordinator.cli import main as cli
from coordinator.support.examples import DEMO_GCODE, DEMO_MACHINE


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
