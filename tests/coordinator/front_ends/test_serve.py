"""A front end that cannot be opened ends the service in a sentence, whichever it is."""

import socket
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from coordinator.assembly.load import load_machine
from coordinator.config.model import MachineDescription
from coordinator.front_ends import serve as front_ends
from coordinator.front_ends.serve import ServeOptions, serve
from coordinator.support.examples import DEMO_MACHINE
from nodes.support.errors import CanductorError


@pytest.fixture
def options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ServeOptions:
    """Return those of a service that could start, in a process that is a test's and stays as it is."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    for change in ("lock_memory", "shorten_time_slice", "raise_files_limit"):
        monkeypatch.setattr(front_ends, change, lambda: None)
    return ServeOptions(name="test", path=tmp_path / "test.sock", config=DEMO_MACHINE)


@pytest.fixture
def taken() -> Iterator[tuple[str, int]]:
    """Return the address of a port at which somebody else listens."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        yield "127.0.0.1", other.getsockname()[1]


def refusal(options: ServeOptions) -> str:
    with pytest.raises(CanductorError) as refused:
        serve(lambda: load_machine(str(DEMO_MACHINE)), options)
    return str(refused.value)


@pytest.mark.parametrize("what", ["tcp", "web", "metrics"])
def test_a_port_that_is_in_use(
    options: ServeOptions, taken: tuple[str, int], tmp_path: Path, what: str
) -> None:
    tokens = tmp_path / "tokens"
    tokens.touch(mode=0o600)
    change: dict[str, Any] = {what: taken}
    asked = replace(options, tokens=tokens, plain_on_loopback=True, **change)
    assert "in use" in refusal(asked)
    assert options.path is not None
    assert not options.path.exists()


@pytest.mark.parametrize("what", ["path", "klippy_api", "pty"])
@pytest.mark.parametrize("make", [Path.mkdir, Path.touch])
def test_a_path_at_which_something_else_is(
    options: ServeOptions, tmp_path: Path, what: str, make: Callable[[Path], None]
) -> None:
    other = tmp_path / "other"
    make(other)
    change: dict[str, Any] = {what: other}
    assert str(other) in refusal(replace(options, **change))
    assert other.exists()


@pytest.mark.parametrize("content", [None, b"\xff\x00\x01"])
def test_tokens_that_cannot_be_read(options: ServeOptions, tmp_path: Path, content: bytes | None) -> None:
    tokens = tmp_path / "tokens"
    if content is not None:
        tokens.touch(mode=0o600)
        tokens.write_bytes(content)
    asked = replace(options, tcp=("127.0.0.1", 0), tokens=tokens, plain_on_loopback=True)
    assert str(tokens) in refusal(asked)


def test_a_certificate_that_is_none(options: ServeOptions, tmp_path: Path) -> None:
    pem, tokens = tmp_path / "cert.pem", tmp_path / "tokens"
    pem.write_text("no certificate")
    tokens.touch(mode=0o600)
    asked = replace(options, tcp=("127.0.0.1", 0), tokens=tokens, certificate=pem, private_key=pem)
    assert str(pem) in refusal(asked)


class Loaded(BaseException):
    """Ends a service that has come as far as to load its machine."""


@pytest.mark.parametrize(
    ("spoiled", "sentence"),
    [
        ("state/canductor/test/tables/x.table.json", "x.table.json is no kept table and was left out"),
        ("state/canductor/test/tables", "state/canductor/test/tables cannot be read: not a directory"),
        ("state/canductor", "state/canductor/test/tables cannot be read: not a directory"),
    ],
)
def test_kept_tables_that_cannot_be_read_are_reported(
    options: ServeOptions, tmp_path: Path, capfd: pytest.CaptureFixture[str], spoiled: str, sentence: str
) -> None:
    """They ended the service as an internal error; so did a state folder that may not be entered."""
    (tmp_path / spoiled).parent.mkdir(parents=True)
    (tmp_path / spoiled).touch()

    def load() -> MachineDescription:
        raise Loaded

    with pytest.raises(Loaded):
        serve(load, options)
    assert sentence in capfd.readouterr().out
