"""Who has no right yet is asked for a token, by the page, in Chromium."""

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from coordinator.web import server as web_server
from tests.coordinator.web.browser import Visitor, chromium
from tests.coordinator.web.paged import Paged, paging

TOKENS = {"watch": "w" * 32, "operate": "o" * 32}


@contextmanager
def served(folder: Path) -> Iterator[Paged]:
    """Serve the page on a loop in a thread of its own: the browser's driver has this one."""
    tokens = folder / "tokens"
    tokens.touch(0o600)
    tokens.write_text("".join(f"{scope} somebody {token}\n" for scope, token in TOKENS.items()))
    there: list[Paged] = []
    started = threading.Event()
    end = asyncio.Event()
    loop = asyncio.new_event_loop()

    async def main() -> None:
        async with paging(folder, tokens=tokens) as paged:
            there.append(paged)
            started.set()
            await end.wait()

    thread = threading.Thread(target=lambda: loop.run_until_complete(main()))
    thread.start()
    try:
        assert started.wait(20)
        yield there[0]
    finally:
        loop.call_soon_threadsafe(end.set)
        thread.join(20)
        loop.close()


def test_a_token_lets_in_and_its_scope_decides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_server, "is_own_program", lambda *_: False)
    with chromium() as browser, served(tmp_path) as paged:
        tab = Visitor(browser, paged.at + "/")
        tab.page.goto(tab.url)
        token = tab.page.get_by_label("Token")
        token.wait_for()
        assert tab.text("login-told") == "This page needs a token of the machine."
        token.fill("x" * 32)
        tab.page.get_by_role("button", name="Let me in").click()
        tab.until_text("login-told", "This token is not known to the machine.")
        token.fill(TOKENS["watch"])
        token.press("Enter")
        tab.until("document.body.dataset.offline === 'false'")
        tab.until("document.getElementById('login').hidden")
        tab.until("document.getElementById('stop').getAttribute('aria-disabled') === 'true'")
        assert tab.page.get_by_role("button", name="Send").is_disabled()
        tab.page.locator("#stop").click(force=True)  # it looks as if one could not; who tries is told why
        tab.page.get_by_text("This token may only watch: the stop was not sent.").wait_for()
        assert paged.served.stops == []

        tab.page.reload()  # the session knows the token
        tab.until("document.body.dataset.offline === 'false'")
        assert tab.page.locator("#login").is_hidden()
        assert TOKENS["watch"] not in "".join(tab.asked), "in no address"
        other = Visitor(browser, tab.url)
        other.page.goto(tab.url)
        other.page.get_by_label("Token").fill(TOKENS["operate"])
        other.page.get_by_role("button", name="Let me in").click()
        other.until("document.getElementById('stop').dataset.line === 'up'")
        other.page.locator("#stop").click()
        other.page.get_by_text("All nodes were told to stop").wait_for()
        assert set(paged.served.stops) == {"the live page (127.0.0.1, token somebody)"}
        assert tab.context.cookies() == other.context.cookies() == []
        tab.close()
        other.close()
