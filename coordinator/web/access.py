"""Who may use the live page: one-time links, and the sessions of browsers; sans-IO.

A browser signs in once, with a one-time link or a token, and gets two secrets: a cookie, which scripts cannot
read, and a key, which the page's script keeps. Both are needed. Browsers send a cookie to every port of a
computer, so a program of another user who serves a page on this computer can receive it; the key is kept for
one origin (scheme, host and port) and goes nowhere else.

Only digests of secrets are kept. Nothing here looks at where a connection comes from.
"""

import hmac
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from coordinator.ipc.protocol.methods import Scope
from coordinator.ipc.server.auth import digest_of

LINK_S: Final = 600.0
"""For so long a link can be used."""
LINKS_MAX: Final = 16
"""Links that were not used yet; the oldest makes room."""
SESSION_S: Final = 30 * 86_400.0
"""A session ends when it was not used for so long."""
SESSIONS_MAX: Final = 64
"""The session that was not used for the longest time makes room."""
USED_STEP_S: Final = 86_400.0
"""When a session is used is noted once in so long: each note is written to the disk."""
_SECRET_BYTES: Final = 32


@dataclass(slots=True, eq=False)
class PageSession:
    """A browser that signed in."""

    cookie: bytes
    """Digest."""
    key: bytes
    """Digest."""
    host: str
    """Host and port under which the page was opened; the session is good there only."""
    scope: Scope
    token: bytes | None
    """Digest of the token that it signed in with; None: with a link."""
    used_s: float
    """When it was last seen, within USED_STEP_S; seconds since 1970."""


@dataclass(frozen=True, slots=True)
class SignedIn:
    """A new session with its secrets, which are given to the browser and not kept."""

    session: PageSession
    cookie: str
    key: str


class PageAccess:
    """Open links and sessions. SESSIONS were kept from an earlier run."""

    def __init__(self, sessions: Iterable[PageSession] = ()) -> None:
        self._links: dict[bytes, tuple[Scope, float]] = {}  # by digest: scope and end; the oldest first
        self.sessions: list[PageSession] = list(sessions)[:SESSIONS_MAX]

    # ------------------------------------------------------------------------------------------ links

    def new_link(self, scope: Scope, now_s: float) -> str:
        """Return the code of a new link that gives SCOPE, once, until LINK_S after NOW_S (monotonic)."""
        code = secrets.token_urlsafe(_SECRET_BYTES)
        if len(self._links) >= LINKS_MAX:
            del self._links[next(iter(self._links))]
        self._links[digest_of(code)] = scope, now_s + LINK_S
        return code

    def use_link(self, code: str, now_s: float) -> Scope | None:
        """Return what the link with CODE gives, None if nothing; it gives nothing from then on."""
        given, found = digest_of(code), None
        for known in self._links:
            if hmac.compare_digest(known, given):
                found = known
        if found is None:
            return None
        scope, until_s = self._links.pop(found)
        return scope if now_s < until_s else None

    # --------------------------------------------------------------------------------------- sessions

    def sign_in(self, host: str, scope: Scope, token: bytes | None, time_s: float) -> SignedIn:
        """Begin a session of the page found under HOST; TOKEN is the digest of the token that gave SCOPE.

        TIME_S is the time in seconds since 1970.
        """
        cookie, key = secrets.token_urlsafe(_SECRET_BYTES), secrets.token_urlsafe(_SECRET_BYTES)
        session = PageSession(digest_of(cookie), digest_of(key), host, scope, token, time_s)
        self.sessions = [other for other in self.sessions if not _has_ended(other, time_s)]
        if len(self.sessions) >= SESSIONS_MAX:
            self.sessions.remove(min(self.sessions, key=lambda other: other.used_s))
        self.sessions.append(session)
        return SignedIn(session, cookie, key)

    def find(self, cookie: str, host: str, time_s: float) -> PageSession | None:
        """Return the session of COOKIE at HOST, None if there is none; takes as long whichever it is."""
        given, found = digest_of(cookie), None
        for session in self.sessions:
            if hmac.compare_digest(session.cookie, given) and session.host == host:
                found = session
        return None if found is None or _has_ended(found, time_s) else found

    def note_use(self, session: PageSession, time_s: float) -> bool:
        """Note that SESSION is used; return whether that is to be written to the disk."""
        if abs(time_s - session.used_s) < USED_STEP_S:
            return False
        session.used_s = time_s
        return True

    def sign_out(self, session: PageSession) -> None:
        """End SESSION, if it has not ended yet."""
        self.sessions = [other for other in self.sessions if other is not session]

    def sign_all_out(self) -> int:
        """End all sessions and links; return how many sessions there were."""
        count = len(self.sessions)
        self.sessions.clear()
        self._links.clear()
        return count


def is_key_of(session: PageSession, key: str) -> bool:
    """Return whether KEY is the one that SESSION's browser was given."""
    return hmac.compare_digest(session.key, digest_of(key))


def _has_ended(session: PageSession, time_s: float) -> bool:
    return time_s - session.used_s > SESSION_S
