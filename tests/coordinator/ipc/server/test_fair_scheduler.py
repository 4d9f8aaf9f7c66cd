"""Clients share the rounds of the loop; the clock is the test's."""

import asyncio
from typing import Any

from coordinator.ipc.server.fair_scheduler import ROUND_S, TURN_S, FairScheduler

TURNS_IN_A_ROUND = round(ROUND_S / TURN_S)
ROUNDING_S = 1e-9
"""More than the sums of times in s lose."""


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


class Transport(asyncio.Transport):
    def __init__(self) -> None:
        super().__init__()
        self.is_aborted = False

    def abort(self) -> None:
        self.is_aborted = True


class Client:
    """Has TURNS turns' worth of work, and notes in WORKED when it gets one."""

    def __init__(self, name: str, turns: int, clock: Clock, worked: list[str]) -> None:
        self.name = name
        self.turns = turns
        self.held = 0
        self.transport: asyncio.Transport = Transport()
        self._clock = clock
        self._worked = worked

    def work(self, until_s: float) -> bool:
        assert until_s == self._clock.now_s + TURN_S
        self._clock.now_s = until_s + ROUNDING_S
        self._worked.append(self.name)
        self.turns -= 1
        return self.turns > 0

    def pause(self) -> None:
        self.held += 1


async def rounds(worked: list[str]) -> list[list[str]]:
    """Return who worked in each round of the loop, until nobody does."""
    found, seen = [worked.copy()], len(worked)
    while True:
        await asyncio.sleep(0)
        if len(worked) == seen:
            return found
        found.append(worked[seen:])
        seen = len(worked)


def test_a_round_is_bounded_and_turns_are_fair() -> None:
    async def body() -> None:
        clock, worked = Clock(), list[str]()
        scheduler = FairScheduler(clock)
        clients = [Client(name, 3, clock, worked) for name in "abcdefgh"]
        for client in clients:
            scheduler.request_turn(client)
            scheduler.request_turn(client)  # twice is once
        found = await rounds(worked)
        # The first one has more to do than a turn, so all others wait behind it.
        assert list(map("".join, found)) == ["a", "abcd", "efgh", "abcd", "efgh", "bcde", "fgh"]
        # Whoever asks while it waits holds, the first one when it asks again.
        assert [client.held for client in clients] == [1] + [2] * 7

    asyncio.run(body())


def test_who_asks_little_is_served_at_once_until_the_round_is_spent() -> None:
    async def body() -> None:
        clock, worked = Clock(), list[str]()
        scheduler = FairScheduler(clock)
        clients = [Client(str(number), 1, clock, worked) for number in range(2 * TURNS_IN_A_ROUND)]
        for client in clients:
            scheduler.request_turn(client)
        assert len(worked) == TURNS_IN_A_ROUND
        scheduler.remove(clients[-1])
        found = await rounds(worked)
        assert found[1:] == [[client.name for client in clients[TURNS_IN_A_ROUND:-1]]]
        scheduler.request_turn(clients[0])  # a new round: at once again
        assert worked[-1] == "0"

    asyncio.run(body())


def test_an_urgent_client_is_ahead_and_the_others_get_on() -> None:
    """Failed before: a stop waited for all who send much. Clients that always seem urgent starve nobody."""

    async def body() -> None:
        clock, worked = Clock(), list[str]()
        scheduler = FairScheduler(clock)
        stop = Client("!", 1, clock, worked)
        floods = [Client(name, 1000, clock, worked) for name in "ABCDE"]
        others = [Client(name, 1000, clock, worked) for name in "abc"]
        for client in (*others, *floods):
            scheduler.request_turn(client)
        scheduler.request_turn(stop)
        scheduler.request_turn(stop, urgent=True)
        scheduler.request_turn(stop)
        assert "!" not in worked
        await asyncio.sleep(0)
        assert "".join(worked) == "a!abc", "once, before the others"
        turns = []
        for _ in range(12):
            for client in floods:
                scheduler.request_turn(client, urgent=True)
            worked.clear()
            await asyncio.sleep(0)
            turns.append("".join(worked[TURNS_IN_A_ROUND:]))
            assert "".join(worked[:TURNS_IN_A_ROUND]).isupper()
        assert set("".join(turns)) >= set("abc")
        assert all(turns), "each round has one turn for the others"
        scheduler.remove(floods[0])
        await asyncio.sleep(0)
        assert "A" not in worked[-TURNS_IN_A_ROUND:]

    asyncio.run(body())


def test_who_has_time_works_in_a_round_to_come() -> None:
    """However often it is requested, once; its caller goes on before."""

    async def body() -> None:
        clock, worked = Clock(), list[str]()
        scheduler = FairScheduler(clock)
        clients = [Client(name, 1, clock, worked) for name in "abcdef"]
        for client in clients * 2:
            scheduler.request_later(client)
        scheduler.request_turn(clients[-1], urgent=True)
        scheduler.request_later(clients[-1])
        assert await rounds(worked) == [[], ["f", "a", "b", "c"], ["d", "e"]]
        assert [client.held for client in clients] == [0] * 5 + [1]

    asyncio.run(body())


class BrokenClient(Client):
    def work(self, until_s: float) -> bool:
        super().work(until_s)
        raise ZeroDivisionError


def test_a_turn_that_fails_ends_its_client_only() -> None:
    """Failed before: those behind it waited for ever, unless somebody else came."""
    reports: list[dict[str, Any]] = []

    async def body() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: reports.append(context))
        clock, worked = Clock(), list[str]()
        scheduler = FairScheduler(clock)
        broken = BrokenClient("b", 3, clock, worked)
        for client in (Client("a", 2, clock, worked), broken, Client("c", 1, clock, worked)):
            scheduler.request_turn(client)
        found = await rounds(worked)
        assert list(map("".join, found)) == ["a", "abc"]
        scheduler.request_turn(broken)  # the first of its round
        assert isinstance(broken.transport, Transport)
        assert broken.transport.is_aborted

    asyncio.run(body())
    assert [type(report["exception"]) for report in reports] == [ZeroDivisionError] * 2
