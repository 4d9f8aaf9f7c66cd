"""Links and sessions of the page, without a server."""

import dataclasses
import json
from pathlib import Path

import pytest

from coordinator.ipc.protocol.methods import Scope
from coordinator.web.access import (
    LINK_S,
    LINKS_MAX,
    SESSION_S,
    SESSIONS_MAX,
    USED_STEP_S,
    PageAccess,
    PageSession,
    is_key_of,
)
from coordinator.web.session_file import read_sessions, write_sessions
from nodes.support.errors import CanductorError

HOST = "127.0.0.1:8080"


def test_a_link_works_once() -> None:
    access = PageAccess()
    code = access.new_link(Scope.WATCH, 5.0)
    for wrong in ("", code[:-1], f"{code}x", "\ud800"):
        assert access.use_link(wrong, 5.0) is None
    assert access.use_link(code, 5.0) is Scope.WATCH
    assert access.use_link(code, 5.0) is None


def test_a_link_expires() -> None:
    access = PageAccess()
    first, second = access.new_link(Scope.OPERATE, 5.0), access.new_link(Scope.OPERATE, 5.0)
    assert access.use_link(first, 5.0 + LINK_S) is None
    assert access.use_link(second, 4.999 + LINK_S) is Scope.OPERATE
    assert access.use_link(first, 5.0) is None, "it was used up"


def test_links_are_bounded() -> None:
    access = PageAccess()
    codes = [access.new_link(Scope.WATCH, 0.0) for _ in range(LINKS_MAX + 1)]
    assert len(set(codes)) == len(codes)
    assert access.use_link(codes[0], 1.0) is None
    assert all(access.use_link(code, 1.0) for code in codes[1:])


def test_a_session_is_good_for_its_host_with_cookie_and_key() -> None:
    access = PageAccess()
    one, other = (access.sign_in(HOST, scope, None, 10.0) for scope in (Scope.WATCH, Scope.OPERATE))
    assert access.find(one.cookie, HOST, 10.0) is one.session
    assert access.find(one.cookie, "127.0.0.1:9999", 10.0) is None
    assert access.find(one.key, HOST, 10.0) is None
    assert access.find("", HOST, 10.0) is None
    assert is_key_of(one.session, one.key)
    assert not any(is_key_of(one.session, key) for key in ("", one.cookie, other.key))
    secrets = {one.cookie, one.key, other.cookie, other.key}
    assert len(secrets) == 4
    kept = str(one.session)
    assert not any(secret in kept for secret in secrets)
    access.sign_out(one.session)
    assert access.find(one.cookie, HOST, 10.0) is None
    assert access.find(other.cookie, HOST, 10.0) is other.session
    code = access.new_link(Scope.OPERATE, 0.0)
    assert access.sign_all_out() == 1
    assert access.find(other.cookie, HOST, 10.0) is None
    assert access.use_link(code, 0.0) is None


def test_a_session_ends_when_it_is_not_used() -> None:
    access = PageAccess()
    signed_in = access.sign_in(HOST, Scope.WATCH, None, 0.0)
    assert not access.note_use(signed_in.session, USED_STEP_S - 1)
    assert access.note_use(signed_in.session, USED_STEP_S)
    assert not access.note_use(signed_in.session, USED_STEP_S + 1)
    assert access.find(signed_in.cookie, HOST, USED_STEP_S + SESSION_S) is signed_in.session
    assert access.find(signed_in.cookie, HOST, USED_STEP_S + SESSION_S + 1) is None


def test_sessions_are_bounded_and_the_one_not_used_longest_makes_room() -> None:
    access = PageAccess()
    first, second, *_ = [access.sign_in(HOST, Scope.WATCH, None, n) for n in range(SESSIONS_MAX)]
    access.note_use(first.session, USED_STEP_S)
    access.sign_in(HOST, Scope.WATCH, None, USED_STEP_S)
    assert len(access.sessions) == SESSIONS_MAX
    assert access.find(first.cookie, HOST, USED_STEP_S) is first.session
    assert access.find(second.cookie, HOST, USED_STEP_S) is None


# ------------------------------------------------------------------------------------------------- the file


ENTRY = {"cookie": "", "key": "", "host": HOST, "scope": "watch", "token": None}
"""Of a session in the file, without its time."""


def session(**changes: object) -> PageSession:
    made = PageSession(b"c" * 32, b"k" * 32, HOST, Scope.OPERATE, b"t" * 32, 1.5e9)
    return dataclasses.replace(made, **changes)  # type: ignore[arg-type]


def test_sessions_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "new" / "page-8080.json"
    assert read_sessions(path) == []
    kept = [session(), session(token=None, scope=Scope.WATCH)]
    write_sessions(path, kept)
    assert path.stat().st_mode & 0o777 == 0o600
    assert path.parent.stat().st_mode & 0o077 == 0
    assert list(map(dataclasses.astuple, read_sessions(path))) == list(map(dataclasses.astuple, kept))
    write_sessions(path, [])
    assert read_sessions(path) == []
    assert list(path.parent.iterdir()) == [path], "nothing half is left"


def test_a_file_that_others_can_write_is_not_believed(tmp_path: Path) -> None:
    path = tmp_path / "sessions"
    write_sessions(path, [session()])
    path.chmod(0o620)
    with pytest.raises(CanductorError, match="chmod 600"):
        read_sessions(path)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "null",
        "{}",
        '{"version":2,"sessions":[]}',
        '{"version":1,"sessions":[{}]}',
        '{"version":1,"sessions":{"a":1}}',
        '{"version":1,"sessions":[{"cookie":1}]}',
        "[" * 100_000,
        json.dumps({"version": 1, "sessions": [{**ENTRY, "used_s": 10**1000}]}),
    ],
)
def test_a_file_that_is_none(tmp_path: Path, text: str) -> None:
    path = tmp_path / "sessions"
    path.write_text(text)
    path.chmod(0o600)
    with pytest.raises(CanductorError, match="does not hold the page's sessions"):
        read_sessions(path)


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(CanductorError, match="cannot be kept in"):
        write_sessions(tmp_path / "file" / "sessions", [session()])
