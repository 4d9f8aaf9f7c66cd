"""One node over its life cycle: identified, configured, synchronized, and left in a known state."""

import asyncio
import contextlib
from collections.abc import Callable, Sequence
from typing import Final, Literal

from nodes.clock.clock import ClockEstimate, ClockEstimator
from nodes.clock.estimated_clock import EstimatedClock
from nodes.clock.sync_pulse import PulseClock
from nodes.dictionary.cache import DictionaryCache
from nodes.dictionary.dictionary import Dictionary
from nodes.dictionary.message_format import Message, Value
from nodes.dictionary.parts import DictionaryError
from nodes.dictionary.vocabulary import carries_identity, check_vocabulary
from nodes.link import LinkError
from nodes.link.interfaces import LinkInterface
from nodes.node.absence import BACK_WITHIN_S, RETRY_S, Absence
from nodes.node.board_reset import ResetMethod
from nodes.node.clock_keeper import ClockKeeper
from nodes.node.config import NodeConfig
from nodes.node.connector import BuildConfig, Connector
from nodes.node.errors import NodeError, NodeLost, NodeShutdown, shutdown_sentence
from nodes.node.identify import identify
from nodes.node.load import NodeLoad, load_of
from nodes.node.queue_slots import share_slots
from nodes.node.request_reply import (
    QUERY_TIMEOUT_S,
    QUERY_TRIES,
    Answer,
    Callback,
    QueryTimeout,
    RequestReply,
)
from nodes.node.states import NodeEvent, NodeState, following
from nodes.node.watchdog import QUERIES, NodeWatchdog, get_config, restarted
from nodes.support.errors import CanductorError

CONFIG_RESET_TRIES: Final = 4
RESET_SETTLE_S: Final = 0.3
"""Time for the reset command to arrive, repeated if necessary, and for the node to begin to boot."""
ALIVE_TIMEOUT_S: Final = 0.1
"""Time for a node to prove that it is alive when another board claims its identity."""
CLOCK_TIMEOUT_S: Final = 15.0
"""On a bus that loses one frame in twenty, every fourth sample is lost or unusable."""
MEASURED: Final = "analog_in_state"
STATE: Final = ("config", "uptime", "clock", "sync_pulse")
PATIENCE_S: Final = {
    **dict.fromkeys(STATE, 0.32),
    "stats": 1.0,
    MEASURED: 0.005,  # the sensors of a node report together; a heater is controlled by what they say
}
"""How long responses that come all the time may wait until something else wakes the host; what is asked of a
node waits for the next report of its heaters' sensors, every 0.3 s."""
REST_PATIENCE_S: Final = 1.0
"""The same of what sensors measure while nothing acts on it, and of a node's state while all is at rest."""

ClockSource = Literal["pulse", "exchange"]
OnState = Callable[["Node"], None]
ExplainShutdown = Callable[[str], str]
"""Returns what is known of a shutdown for the given reason, in a few words; "": nothing."""
OnClock = Callable[["Node", ClockEstimate], None]


def _ignore(*_: object) -> None:
    pass


class Node:
    """Node NAME, reached through CONNECTOR and configured as BUILD_CONFIG says.

    ON_STATE is called after every change of ``state``, ON_CLOCK with every new estimate of its clock, both on
    the control loop; ON_NOTICE with a sentence for the user. ``failure`` states why it is lost or shut down.
    Without a CACHE every start downloads the dictionary.
    """

    def __init__(
        self,
        name: str,
        connector: Connector,
        build_config: BuildConfig,
        *,
        on_state: OnState = _ignore,
        on_clock: OnClock = _ignore,
        on_notice: Callable[[str], None] = _ignore,
        cache: DictionaryCache | None = None,
    ) -> None:
        self.name = name
        self.state = NodeState.CONNECTING
        self.failure: NodeError | None = None
        self.move_count = 0
        """Queue slots shared by all steppers and timed outputs; known when READY."""
        self.step_slots = 0
        """The slots that the steppers have."""
        self.output_slots = 0
        """The slots that each timed output has."""
        self.load: NodeLoad | None = None
        self.pulse_clock: PulseClock | None = None
        """The node's clock by sync pulses, while its bus has them; updated by the bus."""
        self.reset_first = ""
        """Why the next start resets the node even when it is configured as it should be; "": it does not."""
        self.was_reached = False
        """Whether the last start got as far as configuring the node."""
        self.kept_configuration = False
        """Whether the last start found it configured as it should be: what it did then, it may still do."""
        self._connector = connector
        self._build_config = build_config
        self._on_state = on_state
        self._on_clock = on_clock
        self._on_notice = on_notice
        self._cache = cache
        self._talk = RequestReply(name)
        self._keeper: ClockKeeper | None = None
        self._watchdog = NodeWatchdog(name, 0)
        self._explain: list[ExplainShutdown] = []
        self._reports_wait: tuple[bool, bool] | None = None
        """What ``let_reports_wait`` has set since the start: whether measurements and state wait for long."""
        self._starting_over = True  # messages count only once an old configuration was checked
        self._reaching = False  # a link that is lost now is one attempt that failed
        self._generation = 0
        for response, handler in (
            ("stats", self._handle_stats),
            ("shutdown", self._handle_shutdown),
            ("is_shutdown", self._handle_is_shutdown),
            ("starting", self._handle_starting),
        ):
            self._talk.on(response, None, handler)

    # ------------------------------------------------------------------------------------------- inspection

    @property
    def dictionary(self) -> Dictionary:
        """The node's dictionary; before it is read, one with only the messages that request it."""
        return self._talk.dictionary

    @property
    def clock(self) -> ClockEstimator:
        """The node's clock; NodeError before its first sample."""
        if self._keeper is None or not self._keeper.estimator.accepted:
            raise NodeError(f"the clock of node {self.name} is not known yet: the node is {self.state.value}")
        return self._keeper.estimator

    @property
    def talks(self) -> bool:
        """Whether commands can be sent to the node now."""
        return self.failure is None and self.state in (NodeState.CONFIGURING, NodeState.READY)

    @property
    def best_clock(self) -> EstimatedClock:
        """The best estimate of the node's clock: by sync pulses, else by exchanges; NodeError before."""
        clock, pulses = self.clock, self.pulse_clock
        # The interrupts of some boards jitter so much that exchanges are more accurate.
        return clock if pulses is None or pulses.error_s > clock.estimate().bound_s else pulses

    @property
    def clock_source(self) -> ClockSource:
        """The source of ``best_clock``; NodeError before the first sample."""
        return "pulse" if isinstance(self.best_clock, PulseClock) else "exchange"

    @property
    def clock_error_s(self) -> float | None:
        """Bound of the error of ``best_clock``; None while that is not known.

        With pulses it is relative to the reference node's clock, with exchanges to host time.
        """
        if self._keeper is None or not self._keeper.estimator.accepted:
            return None
        best = self.best_clock
        return best.error_s if isinstance(best, PulseClock) else self.clock.estimate().bound_s

    @property
    def clock_freq_hz(self) -> int:
        """Nominal ticks per second."""
        return self.dictionary.clock_freq_hz

    @property
    def link(self) -> LinkInterface:
        """The link, for batches of commands; NodeError unless the node can be talked to."""
        self._check_usable()
        return self._talk.link

    @property
    def undecodable(self) -> int:
        """Responses dropped because nothing in the dictionary fits them."""
        return self._talk.undecodable

    # ---------------------------------------------------------------------------------------------- messages

    def send(self, name: str, /, *, min_clock: int = 0, req_clock: int = 0, **args: Value | str) -> None:
        """Send a command (clocks: ``nodes/link/core/batch.h``); NodeError when the node cannot take it."""
        self._check_usable()
        self._talk.send(name, args, min_clock=min_clock, req_clock=req_clock)

    async def query(
        self,
        name: str,
        response: str,
        /,
        *,
        timeout_s: float = QUERY_TIMEOUT_S,
        tries: int = QUERY_TRIES,
        patient: bool = False,
        **args: Value | str,
    ) -> Message:
        """Send a command and return its RESPONSE (of the same oid); repeat the command when it gets lost.

        The answer to a PATIENT question may come later than it could.

        Raises QueryTimeout, or NodeLost or NodeShutdown when that happens meanwhile.
        """
        self._check_usable()
        answer = await self._talk.ask(name, response, args, timeout_s=timeout_s, tries=tries, patient=patient)
        return answer.message

    def on(self, response: str, oid: int | None, callback: Callback) -> Callable[[], None]:
        """Call CALLBACK for every RESPONSE (of OID, unless None); return a function that ends it."""
        return self._talk.on(response, oid, callback)

    def let_reports_wait(self, *, measurements: bool, state: bool, clock: bool) -> None:
        """Let what sensors measure and what the node says of its STATE wait for long from now on, or not.

        A node whose CLOCK nothing needs closely is asked for it less often.
        """
        if self._reports_wait != (measurements, state):
            with contextlib.suppress(CanductorError):  # there is no link, or it is lost
                for response, rests in {MEASURED: measurements, **dict.fromkeys(STATE, state)}.items():
                    seconds = REST_PATIENCE_S if rests else PATIENCE_S[response]
                    self._talk.let_wait(response, seconds, in_step=response == MEASURED and not rests)
                self._reports_wait = measurements, state
        if self._keeper is not None:
            self._keeper.rests = clock

    def explain_shutdown(self, explain: ExplainShutdown) -> None:
        """Have EXPLAIN add to the sentence of a shutdown, until the node is started again."""
        self._explain.append(explain)

    def emergency_stop(self) -> None:
        """Stop the node ahead of everything queued for it; no effect on a node that cannot be reached.

        From any thread.
        """
        if self._talk.connected and "emergency_stop" in self.dictionary.commands:
            # The link may already have lost the node without the loop having been notified.
            with contextlib.suppress(CanductorError):
                self._talk.link.send_urgent(self.dictionary.encode("emergency_stop"))

    def lose(self, cause: str) -> None:
        """Record that the node can no longer be reached."""
        self._fail(NodeEvent.LOST, NodeLost(f"lost node {self.name}: {cause}"))

    def restarted(self, how: str) -> None:
        """Record that the node restarted by itself; HOW: the evidence for that."""
        self._fail(NodeEvent.RESTARTED, restarted(self.name, how))

    async def lives(self) -> bool:
        """Return whether the node answers at once and has its configuration."""
        try:
            answer = await self._talk.ask(
                "get_config", "config", tries=1, timeout_s=ALIVE_TIMEOUT_S, survives_shutdown=True
            )
        except CanductorError:
            return False
        return bool(answer.message.integer("is_config"))

    def check_ready(self) -> None:
        """Raise NodeError unless the node is configured and works."""
        if self.failure is None and self.state is NodeState.READY:
            return
        self._check_usable()
        raise NodeError(f"node {self.name} is {self.state.value} and not ready yet")

    def _check_usable(self) -> None:
        if self.failure is not None:
            raise self.failure.with_traceback(None)
        if self.state not in (NodeState.CONFIGURING, NodeState.READY):
            raise NodeError(f"node {self.name} is {self.state.value} and takes no commands")

    # --------------------------------------------------------------------------------------------- starting

    async def start(self) -> None:
        """Bring the node to READY from CONNECTING; raises CanductorError, leaving it LOST or SHUTDOWN."""
        try:
            await self._start()
        except CanductorError as error:
            failure = error if isinstance(error, NodeError) else NodeError(str(error))
            if self.failure is None:
                self._fail(NodeEvent.LOST, failure)
            elif self.state is NodeState.LOST:
                self.failure = failure  # a better reason than that of its link, which only found it silent
            raise

    async def _start(self) -> None:
        """Reach the node, reset it where that is needed, configure it: every start and restart is this."""
        self._reaching, self.was_reached = True, False
        try:
            keeper, wanted, found = await self._prepare()
        finally:
            self._reaching = False
        self.reset_first, self.was_reached = "", True
        await self._configure(found, wanted)
        await self._wait_for_clock(keeper)
        for response, seconds in PATIENCE_S.items():
            self._talk.let_wait(response, seconds)
        self._reports_wait = None
        self._enter(NodeEvent.CONFIGURED)

    async def _prepare(self) -> tuple[ClockKeeper, NodeConfig, Message]:
        """Return when the node is neither shut down nor differently configured, after resets if necessary.

        Returns what keeps its clock, its configuration as it has to be, and its configuration state.
        """
        methods = list(self._connector.reset_methods)
        used: list[ResetMethod] = []
        absence = self._absence(self._connector.absence_s(), "")
        if self.reset_first:
            from_outside = [method for method in methods if method is not ResetMethod.COMMAND]
            for method in from_outside:  # reaches firmware that hangs, too
                methods.remove(method)
                if await self._connector.reset(method):
                    used.append(method)
            after = f"it was reset because {self.reset_first}" if used else self.reset_first
            absence = self._absence(BACK_WITHIN_S, after)
        while True:
            found = await self._reach(absence)
            keeper = self._start_clock()
            wanted = self._wanted()
            why = self._why_reset(found, wanted)
            cleared = await self._clear(methods, used, why) if why else found
            if cleared is not None:
                return keeper, wanted, cleared
            absence = self._absence(BACK_WITHIN_S, f"it was reset because {why}")

    def _wanted(self) -> NodeConfig:
        """Return what the node is to be configured as; a bug in that is reported and fails only this node."""
        try:
            return self._build_config(self.dictionary)
        except CanductorError:
            raise
        except Exception as bug:  # noqa: BLE001 (it may depend on what the dictionary says)
            context = {"message": f"building the configuration of node {self.name} failed", "exception": bug}
            asyncio.get_running_loop().call_exception_handler(context)
            raise NodeError(
                f"the configuration of node {self.name} cannot be built ({bug!r}); "
                "this is a bug, please report it"
            ) from None

    def _absence(self, limit_s: float, after: str) -> Absence:
        return Absence(self.name, limit_s, after, self._on_notice)

    async def _reach(self, absence: Absence) -> Message:
        """Connect until the node has sent its dictionary, within ABSENCE; return its configuration state."""
        while True:
            try:
                found = await self._reach_once()
            except DictionaryError:
                raise
            except CanductorError as error:
                missing = self._connector.missing(error)
                if not absence.goes_on(missing):
                    raise absence.error(missing, error) from None
            else:
                absence.ended()
                return found
            await self._disconnect()
            self._enter(NodeEvent.SILENT)
            await asyncio.sleep(RETRY_S)

    async def _reach_once(self) -> Message:
        self._starting_over = True
        self._explain.clear()
        link = await self._connector.connect(self._talk.receive, self._link_lost(self._generation))
        self._talk.attach(link)
        self._enter(NodeEvent.CONNECTED)
        await self._identify()
        self._enter(NodeEvent.IDENTIFIED)
        return await get_config(self._talk)

    async def restart(self) -> None:
        """Start again, from READY, SHUTDOWN or LOST; raises like ``start``."""
        await self._disconnect()
        if following(self.state, NodeEvent.RESET) is None:
            raise NodeError(f"node {self.name} is {self.state.value} and cannot be restarted")
        if self.state is NodeState.LOST:
            self._connector.forget()
        self.failure = None
        self._enter(NodeEvent.RESET)
        await self.start()

    async def sleep(self) -> None:
        """Disconnect the node, so that its power can be switched off: it gets no messages and is not watched.

        A running start must have been cancelled before. Raises NodeError when the node sleeps or is closed.
        """
        if following(self.state, NodeEvent.SLEEP) is None:
            raise NodeError(f"node {self.name} is {self.state.value} and cannot be put to sleep")
        await self._disconnect()
        self._connector.forget()
        self.failure = None
        self._enter(NodeEvent.SLEEP)

    async def wake(self) -> None:
        """Start the node again, from SLEEPING; raises like ``start``."""
        if following(self.state, NodeEvent.WAKE) is None:
            raise NodeError(f"node {self.name} is {self.state.value} and cannot be woken")
        self._enter(NodeEvent.WAKE)
        await self.start()

    async def close(self) -> None:
        """Close the connection; the node itself keeps its state."""
        await self._disconnect()
        self._enter(NodeEvent.CLOSE)

    async def _disconnect(self) -> None:
        self._generation += 1
        self._talk.fail(self.failure or NodeLost(f"the connection to node {self.name} was closed"))
        if self._keeper is not None:
            await self._keeper.close()
        link = self._talk.detach()
        if link is not None:
            link.close()

    async def _identify(self) -> None:
        cache = self._cache or DictionaryCache()
        dictionary = await identify(self._talk, cache, self._connector.why_silent)
        try:
            check_vocabulary(dictionary)
            self._talk.dictionary = dictionary
            self._talk.link.set_receive_window(dictionary.receive_window)
        except DictionaryError as error:
            raise DictionaryError(f"node {self.name}: {error}") from None
        await self._check_identity()

    async def _check_identity(self) -> None:
        """Check that the board that answers is the one to which the node's id was assigned."""
        if carries_identity(self.dictionary):
            answer = await self._talk.ask("get_canbus_id", "canbus_id", survives_shutdown=True)
            self._connector.check_identity(answer.message.data("canbus_uuid"))

    # ------------------------------------------------------------------------------------------ configuring

    def _why_reset(self, found: Message, wanted: NodeConfig) -> str:
        """Return why the node cannot be configured as it is, as a clause; "": it can, or is already."""
        if found.integer("is_shutdown"):
            return "it was shut down"
        if not found.integer("is_config"):
            return ""
        if found.integer("crc") != wanted.crc:
            return "it had another configuration"
        return self.reset_first

    async def _configure(self, found: Message, wanted: NodeConfig) -> None:
        """Configure the node, whose state is FOUND, as WANTED."""
        self._starting_over = False
        self.kept_configuration = bool(found.integer("is_config"))
        if not self.kept_configuration:
            for command in wanted.config_commands:
                self._talk.send_text(command)
            self._talk.send("finalize_config", {"crc": wanted.crc})
            found = await self._finalized()
        self._check_configured(found, wanted)
        self.move_count = found.integer("move_count")
        self.step_slots, self.output_slots = share_slots(self.move_count, wanted.timed_outputs)
        self._watchdog = NodeWatchdog(self.name, wanted.crc)
        for command in wanted.init_commands:
            self._talk.send_text(command)

    async def _finalized(self) -> Message:
        """Query the configuration state after its last command.

        Answers carry no numbers: answers to an earlier query that was repeated may arrive now.
        """
        for _ in range(QUERY_TRIES):
            found = await get_config(self._talk)
            if found.integer("is_config") or found.integer("is_shutdown") or self.failure is not None:
                break
        return found

    def _check_configured(self, found: Message, wanted: NodeConfig) -> None:
        if self.failure is not None:
            raise self.failure.with_traceback(None)
        if found.integer("is_shutdown"):
            raise NodeShutdown(f"node {self.name} shut down during configuration; check its pins and limits")
        if not found.integer("is_config") or found.integer("crc") != wanted.crc:
            raise NodeError(f"node {self.name} did not accept its configuration; restart it and try again")

    async def _clear(self, methods: list[ResetMethod], used: list[ResetMethod], why: str) -> Message | None:
        """Clear the node's configuration by the first of METHODS that is possible; move it to USED.

        Returns its configuration state; None: the board was reset and has to be connected again.
        """
        while methods:
            method = methods.pop(0)
            if method is ResetMethod.COMMAND and "config_reset" in self.dictionary.commands:
                # Preferred to a reset of the whole board, which makes a USB device or CAN bridge disappear.
                with contextlib.suppress(NodeLost, QueryTimeout, LinkError):
                    return await self._config_reset()
                self._connector.forget()  # a Linux process starts again, and has another pseudo-terminal then
                done = True
            elif method is ResetMethod.COMMAND:
                done = await self._reset_by_command()
            else:
                done = await self._connector.reset(method)
            if done:
                used.append(method)
                await self._disconnect()
                self._enter(NodeEvent.RESET)
                return None
        found = f"resets had no effect (by {', '.join(used)})" if used else "it has no way to reset"
        raise NodeError(f"node {self.name} has to be reset because {why}, but {found}; power-cycle it")

    async def _reset_by_command(self) -> bool:
        if "reset" not in self.dictionary.commands:
            return False
        self._connector.expect_reset()
        self._generation += 1  # the link is expected to break
        self._talk.send("reset")
        await asyncio.sleep(RESET_SETTLE_S)
        self._connector.forget()
        return True

    async def _config_reset(self) -> Message:
        """Clear the node's configuration. Firmware accepts config_reset only when shut down."""
        for _ in range(CONFIG_RESET_TRIES):
            self._talk.send("emergency_stop")
            self._talk.send("config_reset")
            found = await get_config(self._talk)
            if found.integer("is_shutdown") and "clear_shutdown" in self.dictionary.commands:
                self._talk.send("clear_shutdown")
                found = await get_config(self._talk)
            if not found.integer("is_config") and not found.integer("is_shutdown"):
                return found
        raise NodeError(f"node {self.name} does not clear its old configuration; power-cycle it")

    # ------------------------------------------------------------------------------------------------ clock

    def _start_clock(self) -> ClockKeeper:
        self._keeper = ClockKeeper(
            self._talk,
            self._connector,
            on_estimate=lambda estimate: self._on_clock(self, estimate),
            queries=lambda: QUERIES if self.state is NodeState.READY else (),
            on_answers=self._look,
            on_lost=self.lose,
        )
        return self._keeper

    async def _look(self, answers: Sequence[Answer | None]) -> None:
        """Detect a restart or shutdown whose only message was lost."""
        trouble = await self._watchdog.look(answers) if self.state is NodeState.READY else None
        if trouble is not None:
            shutdown = isinstance(trouble, NodeShutdown)
            self._fail(NodeEvent.SHUTDOWN if shutdown else NodeEvent.RESTARTED, trouble)

    async def _wait_for_clock(self, keeper: ClockKeeper) -> None:
        try:
            async with asyncio.timeout(CLOCK_TIMEOUT_S):
                await keeper.ready.wait()
        except TimeoutError:
            raise self.failure or NodeError(
                f"node {self.name} answers too rarely to estimate its clock; check the bus load and errors"
            ) from None
        if self.failure is not None:
            raise self.failure.with_traceback(None)

    # ------------------------------------------------------------------------------------------- responses

    def _enter(self, event: NodeEvent) -> None:
        after = following(self.state, event)
        if after is not None:
            self.state = after
            self._on_state(self)

    def _fail(self, event: NodeEvent, failure: NodeError) -> None:
        if self._reaching and event in (NodeEvent.LOST, NodeEvent.RESTARTED):
            self._talk.fail(failure)  # the start knows whether it may be away
            return
        if following(self.state, event) is None:
            return
        self.failure = failure
        self._enter(event)
        self._talk.fail(failure, shutdown=event is NodeEvent.SHUTDOWN)
        if self._keeper is not None:
            self._keeper.ready.set()  # waiting for it is pointless now

    def _link_lost(self, generation: int) -> Callable[[str], None]:
        def lost(cause: str) -> None:
            if generation == self._generation:
                self.lose(cause)

        return lost

    def _handle_stats(self, stats: Message) -> None:
        base = self.dictionary.int_constant("STATS_SUMSQ_BASE", 256)
        self.load = load_of(stats, self.dictionary.clock_freq_hz, base)

    def _handle_shutdown(self, message: Message) -> None:
        self.shut_down_for(message.integer("static_string_id"), message.integer("clock"))

    def _handle_is_shutdown(self, message: Message) -> None:
        self.shut_down_for(message.integer("static_string_id"))

    def stopped_the_bus(self, static_string_id: int, clock: int) -> None:
        """Record that the node shut down at its CLOCK and stopped all others, as a frame on the bus says.

        A frame with a number that the node's firmware does not have is forged, or the reason did not fit:
        then the nodes' own reports count.
        """
        if self.state in _SHUTDOWN_MEANS:
            known = self.dictionary.enumerations.get("static_string_id")
            if known is not None and known.name_of(static_string_id) is not None:
                self.shut_down_for(static_string_id, clock)

    def shut_down_for(self, static_string_id: int, clock: int | None = None) -> None:
        """Record that the node shut down (at its CLOCK, if known), and the text of its reason."""
        if self._starting_over or self.failure is not None or self.state not in _SHUTDOWN_MEANS:
            return
        text = self.dictionary.enum_name("static_string_id", static_string_id)
        known = self._known_of(text)
        if off := self._clock_off(clock):
            known.append(f"{off}: its oscillator is failing, or the host was suspended")
        sentence = shutdown_sentence(self.name, text) + (f" ({'; '.join(known)})" if known else "")
        self._fail(NodeEvent.SHUTDOWN, NodeShutdown(sentence))

    def _known_of(self, reason: str) -> list[str]:
        """Return what is known of a shutdown for REASON; a bug in that does not hide the shutdown."""
        known = []
        for explain in self._explain:
            try:
                known.append(explain(reason))
            except Exception as bug:  # noqa: BLE001
                self._talk.bugs.add(f"node {self.name}: the reason of its shutdown", bug)
        return [words for words in known if words]

    def _clock_off(self, clock: int | None) -> str:
        """Return how the node's clock is off, also by a CLOCK that the node has read before now, if it is."""
        if self._keeper is None or not self._keeper.estimator.ready:
            return ""
        estimator, now_ns = self._keeper.estimator, round(asyncio.get_running_loop().time() * 1e9)
        if jump_s := estimator.jumped_lately_s(now_ns):
            return f"its clock has jumped by {jump_s * 1e3:+.1f} ms"
        ahead_s = 0.0 if clock is None else estimator.ahead_s(now_ns, clock)
        return f"its clock was {ahead_s * 1e3:.1f} ms ahead of what the host knows of it" if ahead_s else ""

    def _handle_starting(self, _: Message) -> None:
        if not self._starting_over:
            self.restarted("it reported that")


_SHUTDOWN_MEANS: Final = (NodeState.CONFIGURING, NodeState.READY)
