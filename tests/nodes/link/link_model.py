"""One link as plain lists: the rules of nodes/link/core/link.h, written from its text, to compare with it.

Queues are lists of commands, blocks in flight a dictionary, received bytes one string. Nothing is packed, no
state is kept that could be computed. Times are host ns, clocks node ticks.
"""

import math
from dataclasses import dataclass, field

from tests.wire_twin import SYNC, block, crc16

MS = 1_000_000
NEVER = 2**64 - 1
MOTION, CONTROL, BULK = range(3)
ALL = (1 << MOTION) | (1 << CONTROL) | (1 << BULK)
OK, FULL, INVALID, GONE = range(4)
CONTENT_MAX, EMPTY, WHOLE = 59, 5, 64
IN_FLIGHT_MAX = 15
HEADERS = {MOTION: 17, CONTROL: 25, BULK: 25}
"""Bytes that a command takes in its queue beyond its content."""
RANKS = (CONTROL, MOTION, BULK)
"""Who goes first of classes that are due at the same moment."""
REACH_TICKS = 1 << 30


@dataclass
class Command:
    """What is queued."""

    content: bytes
    min_clock: int
    req_clock: int
    queued_ns: int = 0


@dataclass
class Sent:
    """A block in flight, or the last of those that were."""

    data: bytes = b""
    kind: int = CONTROL
    commands: int = 0
    req_clocks: list[int] = field(default_factory=list)
    sent_ns: int = 0
    due_clock: int = 0
    repeats: int = 0
    on_wire: int = 0


@dataclass
class Offer:
    """What goes next: class, time by which it should, whether before all others on the bus."""

    kind: int
    due_ns: int = 0
    urgent: bool = False


@dataclass
class Plan:
    """What the next new block would be."""

    at_ns: int
    offer: Offer
    chosen: list[tuple[int, int]]
    """Class and number of its commands, the first due first."""
    size: int


class LinkModel:
    """The same calls as the C link; SIZES are bytes of the queues by class."""

    def __init__(self, window: int, lost_after_ns: int, sizes: dict[int, int]) -> None:
        self.window, self.lost_after_ns, self.sizes = window, lost_after_ns, sizes
        self.state, self.cause = "probing", ""
        self.queues: dict[int, list[Command]] = {MOTION: [], CONTROL: [], BULK: []}
        self.most: dict[int, list[int]] = {kind: [0, 0] for kind in sizes}
        """Most commands and bytes that a queue held."""
        self.first = self.cursor = self.next = 16
        self.slots: dict[int, Sent] = {slot: Sent() for slot in range(16)}
        self.urgent = False
        self.progress_ns = self.heard_ns = self.silence_ns = self.silences = 0
        self.last_ack: int | None = None
        self.naks_outstanding = self.outstanding_until_ns = self.outstanding_until = 0
        self.late_bytes = 0
        self.backoff = 0
        self.ignored_nak_ns = 0
        self.lead_in = "flush"
        self.clock: tuple[float, int, int] | None = None
        self.motion_content = 0
        self.rx = b""
        self.rx_ns = 0
        self.rx_excused = self.hunting = False
        self.count = dict.fromkeys(
            (
                *("blocks_sent", "bytes_sent", "commands_sent", "commands_dropped", "blocks_repeated"),
                *("bytes_repeated", "naks", "timeouts", "blocks_received", "bytes_received"),
                *("bytes_invalid", "acks_duplicate", "acks_never_sent", "srtt_ns", "rttvar_ns"),
                *("lead_count", "lead_min_ns"),
            ),
            0,
        )
        self.lead_histogram = [0] * 16

    # -------------------------------------------------------------------------------------------- commands

    def send(self, kind: int, content: bytes, min_clock: int, req_clock: int, now: int) -> int:
        if self.state == "lost":
            return GONE
        if not 1 <= len(content) <= CONTENT_MAX or kind not in {CONTROL, BULK}:
            return INVALID
        return self._put(kind, [Command(content, min_clock, req_clock, now)])

    def send_batch(self, commands: list[Command]) -> int:
        if self.state == "lost":
            return GONE
        if any(not 1 <= len(command.content) <= CONTENT_MAX for command in commands):
            return INVALID
        return self._put(MOTION, commands)

    def _put(self, kind: int, commands: list[Command]) -> int:
        queue = self.queues[kind]
        held = sum(HEADERS[kind] + len(command.content) for command in [*queue, *commands])
        if held > self.sizes[kind]:
            return FULL
        queue += commands
        most = self.most[kind]
        self.most[kind] = [max(most[0], len(queue)), max(most[1], held)]
        return OK

    def send_urgent(self, content: bytes, now: int) -> int:
        if self.state == "lost":
            return GONE
        if not 1 <= len(content) <= CONTENT_MAX:
            return INVALID
        for queue in self.queues.values():
            self.count["commands_dropped"] += len(queue)
            queue.clear()
        self.urgent = True
        return self.send(CONTROL, content, 0, 0, now)

    def set_receive_window(self, size: int) -> int:
        if size < WHOLE:
            return INVALID
        self.window = size
        return OK

    def set_clock(self, freq_hz: float, at_ns: int, at_ticks: int) -> int:
        if not math.isfinite(freq_hz) or freq_hz <= 0:
            return INVALID
        self.clock = (freq_hz, at_ns, at_ticks)
        return OK

    @property
    def pending(self) -> int:
        return sum(map(len, self.queues.values())) + sum(sent.commands for sent in self._in_flight())

    # ------------------------------------------------------------------------------------------------ time

    def _ns_at(self, ticks: int) -> int:
        """Return when the clock reads TICKS: never too early; within what 64 bits hold."""
        assert self.clock is not None
        freq_hz, at_ns, at_ticks = self.clock
        away_ns = float(abs(ticks - at_ticks)) / freq_hz * 1e9
        if ticks >= at_ticks:
            return at_ns + math.ceil(away_ns) if away_ns < 9e18 else NEVER
        return at_ns - int(away_ns) if away_ns < float(at_ns) else 0

    @property
    def _answer_ns(self) -> int:
        srtt_ns, rttvar_ns = self.count["srtt_ns"], self.count["rttvar_ns"]
        return max(srtt_ns + 4 * rttvar_ns if srtt_ns else 100 * MS, 4 * MS)

    @property
    def first_rto_ns(self) -> int:
        return max(self._answer_ns, 20 * MS)

    @property
    def rto_ns(self) -> int:
        return min(self.first_rto_ns << self.backoff, self.lost_after_ns // 8)

    @property
    def unanswered_since(self) -> int:
        if self.cursor == self.first:
            return NEVER
        return max(self.slots[self.first % 16].sent_ns, self.progress_ns)

    @property
    def _repeat_at(self) -> int:
        since_ns = self.unanswered_since
        if since_ns == NEVER:
            return NEVER
        left_ns = self._due_ns - since_ns
        at_ns = since_ns + self.rto_ns
        if left_ns > 0:  # a sixteenth of the time left, if that is the longer of answer and timeout
            at_ns = min(at_ns, since_ns + max(left_ns // 16, self._answer_ns))
        if self.ignored_nak_ns:
            at_ns = min(at_ns, self.ignored_nak_ns + (self._answer_ns << min(self.backoff, 2)))
        return at_ns

    @property
    def _due_ns(self) -> int:
        """Return when the first command in flight, or the first motion in the queue, is due; 0: unknown."""
        if self.clock is None:
            return 0
        clocks = [sent.due_clock for sent in self._in_flight()]
        clocks += [command.req_clock for command in self.queues[MOTION][:1]]
        due = min((clock for clock in clocks if clock), default=0)
        return self._ns_at(due) if due else 0

    @property
    def lost_at(self) -> int:
        waits = self.first < self.next or self.state == "confirming"
        return self.progress_ns + self.lost_after_ns if waits else NEVER

    @property
    def _partial_at(self) -> int:
        return self.rx_ns + 100 * MS if self.rx else NEVER

    def handle_timer(self, now: int) -> None:
        if self.state == "lost":
            return
        quarter_ns = self.lost_after_ns // 4
        if now > min(self.lost_at, self._repeat_at) + quarter_ns:  # this computer slept
            self.progress_ns = max(self.progress_ns, now - quarter_ns)
        if now >= self.lost_at:
            self.state = "lost"
            self.cause = "stuck" if self.heard_ns > self.progress_ns else "silent"
        elif now >= self._repeat_at:
            self.count["timeouts"] += 1
            self.backoff += 1
            since_ns = max(self.silence_ns, self.heard_ns, self.progress_ns)
            if self.state == "running" and now >= since_ns + 250 * MS:
                self.silence_ns = now
                self.silences += 1
            self._rewind(now, "flush")

    def deadline(self, now: int, allowed: int) -> int:
        return max(self._next_deadline(now, allowed), now + 1)

    def _next_deadline(self, now: int, allowed: int) -> int:
        if self.state == "lost":
            return NEVER
        at_ns = min(self.lost_at, self._repeat_at, self._partial_at)
        if self.state != "running" or self.cursor < self.next:
            return at_ns
        gate_ns = self._plan(now, allowed).at_ns
        return min(at_ns, gate_ns) if gate_ns > now else at_ns

    # ------------------------------------------------------------------------------------------- new blocks

    def _gate_ns(self, command: Command) -> int:
        """Return when COMMAND may go: its clocks are unambiguous then, and the node has room."""
        if self.clock is None:
            return NEVER if command.min_clock else 0
        free_ns = self._ns_at(command.min_clock) if command.min_clock else 0
        if free_ns and free_ns < NEVER - 2 * MS:
            free_ns += 2 * MS
        beyond = command.req_clock - REACH_TICKS
        return max(free_ns, self._ns_at(beyond) if beyond > 0 else 0)

    def motion_due(self, req_clock: int) -> int:
        if not req_clock or self.clock is None:
            return 0
        margin_ns = min(self.count["srtt_ns"] + self.first_rto_ns, 100 * MS)
        return max(self._ns_at(req_clock) - margin_ns, 1)

    def _offer(self, kind: int, head: Command, now: int) -> Offer:
        due_ns = 0 if kind == BULK else self.motion_due(head.req_clock)
        if kind == MOTION:
            return Offer(kind, due_ns or now, urgent=0 < due_ns <= now)
        if kind == CONTROL and self.urgent:
            return Offer(kind, 0, urgent=True)
        patience_ns = 1000 * MS if kind == BULK else 5 * MS
        soon_ns = head.queued_ns + patience_ns
        return Offer(kind, min(soon_ns, due_ns) if due_ns else soon_ns)

    def _plan(self, now: int, allowed: int) -> Plan:
        plan = self._plan_of(now, allowed)
        if plan.chosen and plan.offer.kind == BULK and not self._has_room(plan):
            plan = self._plan_of(now, allowed & ~(1 << BULK))
        return plan

    def _plan_of(self, now: int, allowed: int) -> Plan:
        at_ns = NEVER
        offers: list[Offer] = []
        for kind in RANKS:
            queue, may = self.queues[kind], bool(allowed & 1 << kind)
            if not queue or not (may or kind == MOTION):
                continue
            gate_ns = self._gate_ns(queue[0])
            if gate_ns > now:
                at_ns = min(at_ns, gate_ns)
                continue
            offer = self._offer(kind, queue[0], now)
            if may or offer.urgent:
                offers.append(offer)
            elif offer.due_ns > now:
                at_ns = min(at_ns, offer.due_ns)
        offers.sort(key=lambda offer: (not offer.urgent, offer.due_ns))
        size, chosen, next_ns = 0, [], NEVER
        for offer in offers:
            count, more, next_gate_ns = self._fitting(offer.kind, CONTENT_MAX - size, now)
            chosen.append((offer.kind, count))
            size += more
            if offer.kind == MOTION:
                next_ns = next_gate_ns
        filled = [kind for kind, count in chosen if count]
        if filled == [MOTION]:
            at_ns = min(at_ns, self._hold_until(dict(chosen)[MOTION], size, next_ns))
        elif filled:
            at_ns = 0
        return Plan(at_ns, offers[0] if offers else Offer(MOTION), chosen, size)

    def _fitting(self, kind: int, room: int, now: int) -> tuple[int, int, int]:
        """Return how many commands of KIND may go and fit, their size, and when the next that fits may."""
        size = 0
        for count, command in enumerate(self.queues[kind]):
            if len(command.content) > room - size:
                return count, size, NEVER
            if (gate_ns := self._gate_ns(command)) > now:
                return count, size, gate_ns
            size += len(command.content)
        return len(self.queues[kind]), size, NEVER

    def _hold_until(self, count: int, size: int, next_ns: int) -> int:
        """Return until when motion alone waits for more of it: full, but not within 100 ms of its time."""
        if next_ns == NEVER:
            return 0
        head = self.queues[MOTION][0]
        due_ns = self._ns_at(head.req_clock) if head.req_clock and self.clock is not None else 0
        full_ns = 0
        for command in self.queues[MOTION][count:]:
            size += len(command.content)
            if size > CONTENT_MAX:
                break
            full_ns = max(full_ns, self._gate_ns(command))
        return min(full_ns, max(due_ns - 100 * MS, 0))

    def _has_room(self, plan: Plan) -> bool:
        return self._fits(EMPTY + plan.size + (WHOLE if plan.offer.kind == BULK else 0))

    def _may_go(self, plan: Plan, now: int) -> bool:
        return plan.at_ns <= now and self.next - self.first < IN_FLIGHT_MAX and self._has_room(plan)

    # -------------------------------------------------------------------------------------------- sending

    def _in_flight(self) -> list[Sent]:
        return [self.slots[sequence % 16] for sequence in range(self.first, self.next)]

    def _fits(self, size: int) -> bool:
        in_flight = sum(self.slots[n % 16].on_wire for n in range(self.first, self.cursor))
        return in_flight == 0 or in_flight + self.late_bytes + size <= self.window

    @property
    def _may_probe(self) -> bool:
        return self.first == self.next and any(self.queues.values())

    @property
    def _lead_in_bytes(self) -> int:
        if self.lead_in != "flush":
            return int(self.lead_in == "sync")
        return max(WHOLE - sum(len(sent.data) for sent in self._in_flight()), 1)

    def next_offer(self, now: int, allowed: int) -> Offer | None:
        if self.state == "lost":
            return None
        if self.cursor < self.next:
            sent = self.slots[self.cursor % 16]
            motion = self.queues[MOTION]
            urgent = bool(sent.req_clocks) or bool(motion and motion[0].req_clock) or self.urgent
            return Offer(sent.kind, 0, urgent) if self._fits(self._lead_in_bytes + len(sent.data)) else None
        if self.state != "running":
            return Offer(CONTROL) if self._may_probe else None
        plan = self._plan(now, allowed)
        return plan.offer if self._may_go(plan, now) else None

    def next_block(self, now: int, allowed: int) -> bytes:
        if self.state == "lost" or (self.cursor == self.next and not self._make(now, allowed)):
            return b""
        sent = self.slots[self.cursor % 16]
        data = self._wire_form(sent, now)
        if not data:
            return b""
        if sent.sent_ns:
            sent.repeats = min(sent.repeats + 1, 255)
            self.count["blocks_repeated"] += 1
            self.count["bytes_repeated"] += len(data)
        self.count["blocks_sent"] += 1
        self.count["bytes_sent"] += len(data)
        self.lead_in = ""
        sent.sent_ns, sent.on_wire = max(now, 1), len(data)
        self.cursor += 1
        return data

    def _wire_form(self, sent: Sent, now: int) -> bytes:
        """Return the bytes of a transmission; none when they do not fit."""
        lead_in = self._lead_in_bytes
        soon = 0 < self._due_ns - now < 200 * MS
        again = self.cursor == self.first and bool(sent.sent_ns) and self.state == "running"
        twice = again and (soon or sent.repeats > 0)
        if twice and (lead_in + len(sent.data)) % 8 == 1:
            lead_in += 1
        fills = self.lead_in == "flush" and self.state == "running"
        syncs = bytes([SYNC]) * lead_in
        data = (bytes(lead_in - 1) + syncs[:1] if fills and lead_in else syncs) + sent.data
        if not self._fits(len(data)):
            return b""
        double = data + bytes([SYNC]) * (-len(data) % 8 + 1) + sent.data
        if twice and len(double) <= self.window:
            self.naks_outstanding += 1
            return double
        return data

    def _make(self, now: int, allowed: int) -> bool:
        chosen: list[tuple[int, int]] = []
        kind = CONTROL
        if self.state == "running":
            if not self._fits(EMPTY + 1):
                return False
            plan = self._plan(now, allowed)
            if not self._may_go(plan, now):
                return False
            chosen, kind = plan.chosen, plan.offer.kind
        elif not self._may_probe:
            return False
        taken: list[Command] = []
        req_clocks: list[int] = []
        for one, count in chosen:
            commands, self.queues[one][:] = self.queues[one][:count], self.queues[one][count:]
            taken += commands
            if one == MOTION:
                req_clocks += [command.req_clock for command in commands if command.req_clock]
                self.motion_content += sum(len(command.content) for command in commands)
        self.urgent = self.urgent and bool(self.queues[CONTROL])
        data = block(self.next, b"".join(command.content for command in taken))
        due_clock = min((command.req_clock for command in taken if command.req_clock), default=0)
        self.slots[self.next % 16] = Sent(data, kind, len(taken), req_clocks, due_clock=due_clock)
        self.count["commands_sent"] += len(taken)
        if self.first == self.next and self.state != "confirming":
            self.progress_ns = now
        self.next += 1
        return True

    def _rewind(self, now: int, lead_in: str) -> None:
        self.naks_outstanding = min(self.naks_outstanding + self.cursor - self.first, 2 * IN_FLIGHT_MAX)
        self.outstanding_until_ns, self.outstanding_until = now + self.rto_ns, self.next
        self.cursor = self.first
        self.ignored_nak_ns = self.late_bytes = 0
        if self.lead_in != "flush":
            self.lead_in = lead_in

    # ------------------------------------------------------------------------------------------- receiving

    def receive(self, data: bytes, now: int) -> list[tuple[bytes, int]]:
        """Return content and the time that it answers of each response in DATA."""
        give_up = False
        if not data and now >= self._partial_at:
            give_up = self.rx_excused or now - self._partial_at <= 10 * MS
            if not give_up:  # whoever looks so late stood still: the sender gets as long again
                self.rx_excused, self.rx_ns = True, now
        if data:
            self.rx_ns, self.rx_excused = now, False
        self.count["bytes_received"] += len(data)
        self.rx += data
        found = self._scan(now)
        while give_up and self.rx:
            at = self.rx.find(SYNC)
            dropped = len(self.rx) if at < 0 else at + 1
            self.count["bytes_invalid"] += dropped
            self.rx = self.rx[dropped:]
            found += self._scan(now)
        return found

    def _scan(self, now: int) -> list[tuple[bytes, int]]:
        found: list[tuple[bytes, int]] = []
        while True:
            was_hunting = self.hunting
            invalid = self._hunt() if was_hunting else 0
            syncs = self._drop_syncs()
            if was_hunting:
                self.count["bytes_invalid"] += invalid + syncs
                syncs = 0
            if not self.rx:
                return found
            length = self.rx[0]
            sound = EMPTY <= length <= WHOLE and (len(self.rx) < 2 or self.rx[1] >> 4 == 1)
            if sound and len(self.rx) < length:
                if not any(bytes([SYNC]) + block(seq) in self.rx for seq in range(16)):
                    return found
                self.count["bytes_invalid"] += self._hunt()
                continue
            whole = self.rx[:length]
            if sound and whole[-3:] == crc16(whole[:-3]).to_bytes(2, "big") + bytes([SYNC]):
                self.rx = self.rx[length:]
                found += self._take(whole, now)
            else:  # sync bytes in front of a bad block belong to it
                self.count["bytes_invalid"] += syncs + self._hunt()

    def _hunt(self) -> int:
        """Drop everything up to and including the next sync byte; return how many bytes."""
        at = self.rx.find(SYNC)
        self.hunting = at < 0
        dropped = len(self.rx) if at < 0 else at + 1
        self.rx = self.rx[dropped:]
        return dropped

    def _drop_syncs(self) -> int:
        """Drop the sync bytes in front, which are legal anywhere before a block; return how many."""
        rest = self.rx.lstrip(bytes([SYNC]))
        dropped, self.rx = len(self.rx) - len(rest), rest
        return dropped

    def _take(self, whole: bytes, now: int) -> list[tuple[bytes, int]]:
        answer, content = whole[1] & 15, whole[2:-3]
        self.count["blocks_received"] += 1
        self.heard_ns = now
        self._sequence(answer, not content, now)
        if not content:
            return []
        asked = self.slots[(self.first - 1) % 16]
        known = self.state == "running" and answer == self.first % 16 and not asked.repeats
        return [(content, asked.sent_ns if known else 0)]

    def _sequence(self, answer: int, empty: bool, now: int) -> None:
        if self.state == "lost":
            return
        behind = (answer - self.first) % 16
        if self.state != "running":
            self._probed(behind, now)
            return
        sequence = self.first + behind
        if sequence > self.next:
            self.count["acks_never_sent"] += 1
            return
        if behind:
            self._acknowledge(sequence, now)
        elif empty and self.last_ack == sequence:
            if self.first < self.next:
                self._nak(now)
            else:
                self.count["acks_duplicate"] += 1
        if empty:
            self.last_ack = sequence

    def _probed(self, behind: int, now: int) -> None:
        if self.cursor == self.first or (self.state == "confirming" and behind == 0):
            return
        if self.state == "confirming" and behind == 1:
            self.state = "running"
            self._acknowledge(self.first + 1, now)
            self.naks_outstanding, self.late_bytes, self.last_ack = 0, 0, self.first
            return
        self.state = "confirming"
        self.first = self.cursor = self.next = self.first + behind
        self.naks_outstanding = self.late_bytes = 0

    def _nak(self, now: int) -> None:
        self.count["naks"] += 1
        if self.cursor == self.first:
            return
        if self.naks_outstanding and now < self.outstanding_until_ns:
            self.naks_outstanding -= 1
            if not self.naks_outstanding:
                self.late_bytes = 0
            self.ignored_nak_ns = now
            return
        self._rewind(now, "sync")

    def _acknowledge(self, sequence: int, now: int) -> None:
        last = self.slots[(sequence - 1) % 16]
        self._measure(max(now - last.sent_ns, 1), sure=not last.repeats)
        for number in range(self.first, sequence):
            sent = self.slots[number % 16]
            if number < self.cursor and sent.repeats and self.naks_outstanding:
                self.late_bytes += sent.on_wire
            for req_clock in sent.req_clocks:
                self._note_lead(req_clock, now)
        self.first = sequence
        self.cursor = max(self.cursor, sequence)
        self.progress_ns = now
        self.ignored_nak_ns = 0
        if sequence > self.outstanding_until:
            self.naks_outstanding = self.late_bytes = 0

    def _measure(self, sample_ns: int, *, sure: bool) -> None:
        """Take a round trip, or, of a repeat, what a round trip takes at least."""
        srtt_ns, rttvar_ns = self.count["srtt_ns"], self.count["rttvar_ns"]
        if not sure and 2 * sample_ns < srtt_ns:
            return
        self.backoff = 0
        if not sure and sample_ns <= srtt_ns:
            return
        if srtt_ns:
            sample_ns = min(sample_ns, srtt_ns + max(srtt_ns, 10 * MS))
            rttvar_ns = (3 * rttvar_ns + abs(sample_ns - srtt_ns)) // 4
            srtt_ns = (7 * srtt_ns + sample_ns) // 8
        else:
            srtt_ns, rttvar_ns = sample_ns, sample_ns // 2
        self.count["srtt_ns"], self.count["rttvar_ns"] = srtt_ns, rttvar_ns

    def _note_lead(self, req_clock: int, now: int) -> None:
        if self.clock is None:
            return
        lead_ns = self._ns_at(req_clock) - now
        least = self.count["lead_min_ns"]
        self.count["lead_min_ns"] = min(least, lead_ns) if self.count["lead_count"] else lead_ns
        self.count["lead_count"] += 1
        bucket = 0 if lead_ns < 0 else 1
        while 0 < bucket < 15 and lead_ns >= MS << (bucket - 1):
            bucket += 1
        self.lead_histogram[bucket] += 1
