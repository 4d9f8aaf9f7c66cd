"""Who may connect to whose Unix sockets."""

import pytest

from coordinator.ipc.protocol.peer import may_serve, may_use


@pytest.mark.parametrize(
    ("own", "used_by", "served_by"), [(1000, {0, 1000}, {0, 1000}), (0, {0}, {0, 1000, 1001})]
)
def test_whom_this_user_may_serve_and_who_may_serve_him(
    monkeypatch: pytest.MonkeyPatch, own: int, used_by: set[int], served_by: set[int]
) -> None:
    """Root controls everybody's machines."""
    monkeypatch.setattr("os.geteuid", lambda: own)
    users = (0, 1000, 1001)
    assert {uid for uid in users if may_use(uid)} == used_by
    assert {uid for uid in users if may_serve(uid)} == served_by
