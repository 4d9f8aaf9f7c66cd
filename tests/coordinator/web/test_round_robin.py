"""However many connections have something to do, a round of the loop has few of their turns."""

import asyncio
from collections.abc import Callable

from coordinator.web.round_robin import TURNS_PER_ROUND, RoundRobin
from tests.stages import jump_loop


class Greedy:
    """Takes as many turns as it is given, TURNS at most; SERVED gets it each time."""

    def __init__(self, turns: int, serve: Callable[["Greedy"], None]) -> None:
        self.turns = turns
        self._serve = serve

    def take_turn(self) -> bool:
        self.turns -= 1
        self._serve(self)
        return self.turns > 0


def test_each_round_has_few_turns_and_all_get_theirs() -> None:
    async def main() -> None:
        served: list[Greedy] = []
        turns = RoundRobin()
        workers = [Greedy(3, served.append) for _ in range(10)]
        for worker in [*workers, *workers]:
            turns.request_turn(worker)
        assert not served
        while len(served) < 30:
            before = len(served)
            await asyncio.sleep(0)
            assert 0 < len(served) - before <= TURNS_PER_ROUND
        assert served == workers * 3

    jump_loop.run(main())


def test_who_has_left_gets_none() -> None:
    async def main() -> None:
        turns, served = RoundRobin(), list[Greedy]()

        def serve(worker: Greedy) -> None:
            served.append(worker)
            turns.remove(workers[1])

        workers = [Greedy(1, serve) for _ in range(3)]
        for worker in workers:
            turns.request_turn(worker)
        await asyncio.sleep(0)
        assert served == [workers[0], workers[2]]

    jump_loop.run(main())
