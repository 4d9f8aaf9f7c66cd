from pathlib import Path

import pytest

from coordinator.ipc.protocol.methods import Scope
from coordinator.ipc.server.auth import ADDRESSES_MAX, FAILURES_MAX, LOCKOUT_S, Grant, LoginThrottle, Tokens
from nodes.support.errors import CanductorError

TOKEN = "a" * 31 + "b"


def read(path: Path, text: str) -> Tokens:
    path.write_text(text)
    path.chmod(0o600)
    return Tokens.read(path)


def test_tokens(tmp_path: Path) -> None:
    tokens = read(tmp_path / "t", f"\n# comment\noperate phone {TOKEN} # mine\nwatch wall {TOKEN}x\n")
    assert tokens.check(TOKEN) == Grant("phone", Scope.OPERATE)
    assert tokens.check(TOKEN + "x") == Grant("wall", Scope.WATCH)
    for wrong in ("", TOKEN[:-1], TOKEN + "y", "\ud800", "ü" * 32):
        assert tokens.check(wrong) is None


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("operate phone", "line 1: must be SCOPE NAME TOKEN"),
        (f"\nking phone {TOKEN}", "line 2: must be SCOPE NAME TOKEN"),
        ("watch a short", "fewer than 32"),
        (f"watch a {TOKEN}\nadmin b {TOKEN}", "line 2: the token occurs twice"),
    ],
)
def test_lines_that_are_none(tmp_path: Path, text: str, sentence: str) -> None:
    with pytest.raises(CanductorError, match=sentence) as error:
        read(tmp_path / "t", text)
    assert TOKEN not in str(error.value)


def test_the_brake() -> None:
    brake = LoginThrottle()
    for n in range(FAILURES_MAX):
        assert brake.lockout_s("10.0.0.1", float(n)) == 0
        brake.failed("10.0.0.1", float(n))
    last_s = FAILURES_MAX - 1.0
    assert brake.lockout_s("10.0.0.1", last_s + 1) == LOCKOUT_S - 1
    assert brake.lockout_s("::ffff:10.0.0.1", last_s + 1) == LOCKOUT_S - 1
    assert brake.lockout_s("10.0.0.2", last_s) == 0
    assert brake.lockout_s("10.0.0.1", last_s + LOCKOUT_S) == 0
    brake.failed("10.0.0.1", last_s + LOCKOUT_S + 1)  # counts from one again
    assert brake.lockout_s("10.0.0.1", last_s + LOCKOUT_S + 1) == 0


def test_the_brake_takes_a_network_for_one() -> None:
    brake = LoginThrottle()
    for n in range(FAILURES_MAX):
        brake.failed(f"2001:db8::{n}", 0.0)
    assert brake.lockout_s("2001:db8::ffff", 0.0) > 0
    assert brake.lockout_s("2001:db8:0:1::", 0.0) == 0
    for n in range(2 * ADDRESSES_MAX):
        brake.failed(f"10.0.{n >> 8}.{n & 255}", 1.0)
    assert len(brake._failures) <= ADDRESSES_MAX
