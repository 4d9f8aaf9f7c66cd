// SPDX-License-Identifier: Apache-2.0
// The sending half of a link: queues, blocks, window, repeats, timers.
#include "nodes/link/core/link_core.h"

#include <math.h>
#include <string.h>

#include "nodes/link/core/batch.h"

#define RTO_MIN_NS (20 * NS_PER_MS)    // with less, a busy host or node would cause needless repeats
#define RTO_FIRST_NS (100 * NS_PER_MS) // until a round trip was measured
// Repeats know when the commands that they delay are due. A timeout is at most this part of the time left,
// which gives some forty tries from 300 ms on, but not less than ANSWER_MIN_NS: with late timers and slow
// nodes a shorter one would repeat in vain. A block every 4 ms is a quarter of a bus of 1 Mbit/s, for that
// time.
#define EARLY_SHARE 16
#define ANSWER_MIN_NS (4 * NS_PER_MS)
#define DOUBLE_NS (200 * NS_PER_MS) // commands that are due so soon are repeated twice at a time
#define TRIES 8             // timeouts, at least, before a link counts as lost; of 1 s, longer than GAP_NS
#define NAK_DOUBLINGS_MAX 2 // of the wait after a nak: the node answers
#define FRAME_BYTES 8       // of CAN; a serial line has no frames, the gaps do no harm there
#define FILLER 0            // no block begins with it

// -------------------------------------------------------------------------------------------------- set-up

void link_init(struct link *link, const struct link_settings *settings, const struct link_memory *memories) {
    memset(link, 0, sizeof *link);
    link->settings = *settings;
    for (int kind = 0; kind < LINK_CLASSES; kind++)
        link_queue_init(&link->queues[kind], memories[kind].at, memories[kind].size, kind != LINK_MOTION);
    link->lead_in = LEAD_FLUSH; // an earlier host may have left half a block in the node's buffer
}

enum link_status link_set_receive_window(struct link *link, uint64_t size) {
    if (size < LINK_WINDOW_MIN)
        return LINK_INVALID;
    link->settings.receive_window = size;
    return LINK_OK;
}

enum link_status link_set_clock(struct link *link, double freq_hz, uint64_t at_ns, uint64_t at_ticks) {
    if (!isfinite(freq_hz) || freq_hz <= 0)
        return LINK_INVALID;
    link->clock_hz = freq_hz;
    link->clock_at_ns = at_ns;
    link->clock_at_ticks = at_ticks;
    return LINK_OK;
}

uint64_t link_clock_to_ns(const struct link *link, uint64_t ticks) {
    int ahead = ticks >= link->clock_at_ticks;
    uint64_t ticks_away = ahead ? ticks - link->clock_at_ticks : link->clock_at_ticks - ticks;
    double away_ns = (double)ticks_away / link->clock_hz * 1e9;
    if (ahead) // rounded up: never too early
        return away_ns < 9e18 ? link->clock_at_ns + (uint64_t)ceil(away_ns) : LINK_NEVER;
    return away_ns < (double)link->clock_at_ns ? link->clock_at_ns - (uint64_t)away_ns : 0;
}

uint64_t link_answer_time(const struct link *link) {
    const struct link_stats *stats = &link->stats;
    uint64_t answer_ns = stats->srtt_ns ? stats->srtt_ns + 4 * stats->rttvar_ns : RTO_FIRST_NS;
    return answer_ns < ANSWER_MIN_NS ? ANSWER_MIN_NS : answer_ns;
}

uint64_t link_first_rto(const struct link *link) {
    uint64_t rto_ns = link_answer_time(link);
    return rto_ns < RTO_MIN_NS ? RTO_MIN_NS : rto_ns;
}

// ------------------------------------------------------------------------------------------------ queueing

enum link_status link_send(struct link *link, enum link_class kind, const uint8_t *content, size_t size,
                           uint64_t min_clock, uint64_t req_clock, uint64_t now) {
    if (link->state == LINK_LOST)
        return LINK_GONE;
    if (size == 0 || size > WIRE_CONTENT_MAX || (kind != LINK_CONTROL && kind != LINK_BULK))
        return LINK_INVALID;
    struct link_command command = {min_clock, req_clock, now, (uint8_t)size};
    return link_queue_put_stamped(&link->queues[kind], &command, content) ? LINK_OK : LINK_FULL;
}

enum link_status link_send_batch(struct link *link, const uint8_t *batch, size_t size) {
    if (link->state == LINK_LOST)
        return LINK_GONE;
    uint64_t count = 0;
    struct batch_record record;
    for (size_t at = 0; at < size; count++) {
        size_t length = batch_read(batch + at, size - at, &record);
        if (length == 0 || record.size == 0 || record.size > WIRE_CONTENT_MAX)
            return LINK_INVALID;
        at += length;
    }
    return link_queue_put(&link->queues[LINK_MOTION], batch, size, count) ? LINK_OK : LINK_FULL;
}

enum link_status link_send_urgent(struct link *link, const uint8_t *content, size_t size, uint64_t now) {
    if (link->state == LINK_LOST)
        return LINK_GONE;
    if (size == 0 || size > WIRE_CONTENT_MAX)
        return LINK_INVALID;
    for (int kind = 0; kind < LINK_CLASSES; kind++) {
        struct link_queue *queue = &link->queues[kind];
        link->stats.commands_dropped += queue->commands;
        link_queue_drop(queue, queue->tail, queue->commands);
    }
    link->urgent = 1;
    return link_send(link, LINK_CONTROL, content, size, 0, 0, now);
}

static uint64_t queued_commands(const struct link *link) {
    return link->queues[LINK_MOTION].commands + link->queues[LINK_CONTROL].commands +
           link->queues[LINK_BULK].commands;
}

uint64_t link_pending(const struct link *link) {
    return queued_commands(link) + link->in_flight_commands;
}

// -------------------------------------------------------------------------------------------- transmission

static int may_probe(const struct link *link) {
    return link->first == link->next && queued_commands(link) > 0;
}

// Makes the next new block, if there is one to send. While the node's expected sequence is unknown it is
// empty: an answer with the next sequence does not show whether the block was accepted or out of order, and
// an empty block loses nothing.
static int make_block(struct link *link, uint64_t now, unsigned allowed) {
    struct link_plan plan = {.offer = {.kind = LINK_CONTROL}};
    if (link->state == LINK_RUNNING) {
        plan = link_plan_block(link, now, allowed);
        if (!link_may_go(link, &plan, now))
            return 0;
    } else if (!may_probe(link)) {
        return 0;
    }
    struct link_block *block = block_of(link, link->next);
    block->sent_ns = block->due_clock = 0;
    block->repeats = block->length = block->commands = block->leads = block->asks = 0;
    block->kind = plan.offer.kind;
    for (size_t i = 0; i < plan.classes; i++)
        link_take(link, plan.order[i], &plan.fronts[plan.order[i]], block);
    link->urgent = link->urgent && link->queues[LINK_CONTROL].commands;
    block->length =
        (uint8_t)wire_block_finish(block->bytes, block->length, (unsigned)(link->next % LINK_SLOTS));
    link->stats.commands_sent += block->commands;
    link->in_flight_commands += block->commands;
    if (link->first == link->next && link->state != LINK_CONFIRMING) // all of probing has to end in time
        link->progress_ns = now;
    link->next++;
    return 1;
}

static size_t lead_in_bytes(const struct link *link) {
    if (link->lead_in != LEAD_FLUSH)
        return link->lead_in;
    size_t bytes = 0;
    for (uint64_t i = link->first; i < link->next; i++)
        bytes += const_block_of(link, i)->length;
    return bytes < WIRE_BLOCK_MAX ? WIRE_BLOCK_MAX - bytes : 1;
}

// Bytes that complete a damaged block must not end it with a sync byte: then only its checksum, which fails
// to notice one error in 65,536, would keep the node from executing it. So only the last one is a sync byte.
// A node that misses nothing answers them with a nak. First contact, in which every answer counts, does
// without.
static void write_lead_in(const struct link *link, uint8_t *out, size_t size) {
    memset(out, link->lead_in == LEAD_FLUSH && link->state == LINK_RUNNING ? FILLER : WIRE_SYNC, size);
    if (size)
        out[size - 1] = WIRE_SYNC;
}

// A repeat that holds up all others goes twice when commands are due soon, and from its third transmission
// on.
static int goes_twice(const struct link *link, const struct link_block *block, uint64_t now) {
    if (link->cursor != link->first || !block->sent_ns || link->state != LINK_RUNNING)
        return 0;
    uint64_t due_ns = link_due(link);
    return block->repeats || (due_ns > now && due_ns - now < DOUBLE_NS);
}

// The copy begins in a frame of its own, behind a sync byte in that frame: no lost frame damages both. What
// the node misses of the first one it takes from the copy, so that it answers in any case.
static size_t gap_before_copy(size_t size) {
    return (FRAME_BYTES - size % FRAME_BYTES) % FRAME_BYTES + 1;
}

// Appends a copy of BLOCK to the SIZE bytes at OUT, if both fit into the window; returns the size then.
static size_t append_copy(struct link *link, const struct link_block *block, uint8_t *out, size_t size) {
    size_t gap = gap_before_copy(size), twice = size + gap + block->length;
    if (twice > link->settings.receive_window) // nothing else is in flight
        return size;
    memset(out + size, WIRE_SYNC, gap);
    memcpy(out + size + gap, block->bytes, block->length);
    link->naks_outstanding++;
    return twice;
}

// Returns the size of the transmission of BLOCK at OUT; 0: the window has no room.
static size_t write_block(struct link *link, const struct link_block *block, uint64_t now, uint8_t *out) {
    size_t lead_in = lead_in_bytes(link);
    int twice = goes_twice(link, block, now);
    // A gap as long as a frame would end with a sync byte what completes a block that lost a frame.
    lead_in += twice && gap_before_copy(lead_in + block->length) == FRAME_BYTES;
    size_t size = lead_in + block->length;
    if (!link_fits(link, size))
        return 0;
    write_lead_in(link, out, lead_in);
    memcpy(out + lead_in, block->bytes, block->length);
    return twice ? append_copy(link, block, out, size) : size;
}

size_t link_next_block(struct link *link, uint64_t now, unsigned allowed, uint8_t *out) {
    if (link->state == LINK_LOST || (link->cursor == link->next && !make_block(link, now, allowed)))
        return 0;
    struct link_block *block = block_of(link, link->cursor);
    size_t size = write_block(link, block, now, out);
    if (!size)
        return 0;
    if (block->sent_ns) {
        if (block->repeats < UINT8_MAX)
            block->repeats++;
        link->stats.blocks_repeated++;
        link->stats.bytes_repeated += size;
    }
    link->stats.blocks_sent++;
    link->stats.bytes_sent += size;
    link->lead_in = LEAD_NONE;
    block->sent_ns = now ? now : 1; // 0 means never sent
    block->wire_length = (uint8_t)size;
    link->in_flight_bytes += size;
    link->cursor++;
    return size;
}

// A repeat is sent at once, and before everything else if it contains motion or motion waits for it.
static int offer_repeat(const struct link *link, struct link_offer *out) {
    const struct link_block *block = const_block_of(link, link->cursor);
    *out = (struct link_offer){.kind = block->kind};
    struct link_command head = {.req_clock = 0};
    const struct link_queue *motion = &link->queues[LINK_MOTION];
    if (motion->commands)
        link_queue_peek(motion, motion->head, &head);
    out->urgent = block->leads > 0 || head.req_clock || link->urgent;
    return link_fits(link, lead_in_bytes(link) + block->length);
}

int link_next_offer(const struct link *link, uint64_t now, unsigned allowed, struct link_offer *out) {
    if (link->state == LINK_LOST)
        return 0;
    if (link->cursor < link->next)
        return offer_repeat(link, out);
    if (link->state != LINK_RUNNING) {
        *out = (struct link_offer){.kind = LINK_CONTROL};
        return may_probe(link);
    }
    struct link_plan plan = link_plan_block(link, now, allowed);
    *out = plan.offer;
    return link_may_go(link, &plan, now);
}

// ---------------------------------------------------------------------------------------------------- time

uint64_t link_rto(const struct link *link) {
    uint64_t rto_ns = link_first_rto(link);
    uint64_t most_ns = link->settings.lost_after_ns / TRIES;
    for (uint64_t i = 0; i < link->backoff && rto_ns < most_ns; i++)
        rto_ns *= 2;
    return rto_ns < most_ns ? rto_ns : most_ns;
}

void link_rewind(struct link *link, uint64_t now, enum lead_in lead_in) {
    // A node answers each block that it has already (or that comes out of order) with its expected sequence:
    // as many naks may follow as blocks were sent, and they say nothing about a loss after this repeat.
    // Acting on them would repeat good blocks, cause the same naks again, and so on for ever.
    uint64_t outstanding = link->naks_outstanding + (link->cursor - link->first);
    link->naks_outstanding = outstanding < 2UL * LINK_BLOCKS_MAX ? outstanding : 2UL * LINK_BLOCKS_MAX;
    link->outstanding_until_ns = now + link_rto(link);
    link->outstanding_until_seq = link->next;
    link->cursor = link->first;
    link->in_flight_bytes = link->late_bytes = link->ignored_nak_ns = 0;
    link->lead_in = (uint8_t)lead_in;
}

uint64_t link_unanswered_since(const struct link *link) {
    if (link->cursor == link->first)
        return LINK_NEVER;
    uint64_t sent_ns = const_block_of(link, link->first)->sent_ns;
    return sent_ns > link->progress_ns ? sent_ns : link->progress_ns;
}

int link_awaits_answer(const struct link *link) {
    int awaits = link->state == LINK_PROBING || link->state == LINK_CONFIRMING;
    for (uint64_t i = link->first; i < link->next; i++)
        awaits |= const_block_of(link, i)->asks;
    return awaits;
}

uint64_t link_due(const struct link *link) {
    if (!(link->clock_hz > 0))
        return 0;
    struct link_command head = {.req_clock = 0};
    const struct link_queue *motion = &link->queues[LINK_MOTION];
    if (motion->commands)
        link_queue_peek(motion, motion->head, &head);
    uint64_t due_clock = head.req_clock;
    for (uint64_t i = link->first; i < link->next; i++) {
        uint64_t block_clock = const_block_of(link, i)->due_clock;
        due_clock = block_clock && (!due_clock || block_clock < due_clock) ? block_clock : due_clock;
    }
    return due_clock ? link_clock_to_ns(link, due_clock) : 0;
}

// The timeout of what was sent at SINCE_NS.
static uint64_t timeout_of(const struct link *link, uint64_t since_ns) {
    uint64_t rto_ns = link_rto(link), due_ns = link_due(link), answer_ns = link_answer_time(link);
    if (due_ns <= since_ns) // nothing is due, or it is too late
        return rto_ns;
    uint64_t early_ns = (due_ns - since_ns) / EARLY_SHARE;
    early_ns = early_ns < answer_ns ? answer_ns : early_ns;
    return early_ns < rto_ns ? early_ns : rto_ns;
}

static uint64_t repeat_deadline(const struct link *link) {
    uint64_t since_ns = link_unanswered_since(link);
    if (since_ns == LINK_NEVER)
        return LINK_NEVER;
    uint64_t at_ns = since_ns + timeout_of(link, since_ns);
    if (!link->ignored_nak_ns)
        return at_ns;
    // The node answers, and did not have the first block then. If it has it now, that answer comes soon.
    uint64_t doublings = link->backoff < NAK_DOUBLINGS_MAX ? link->backoff : NAK_DOUBLINGS_MAX;
    uint64_t nak_at_ns = link->ignored_nak_ns + (link_answer_time(link) << doublings);
    return nak_at_ns < at_ns ? nak_at_ns : at_ns;
}

static uint64_t lost_deadline(const struct link *link) {
    int waiting = link->first < link->next || link->state == LINK_CONFIRMING;
    return waiting ? link->progress_ns + link->settings.lost_after_ns : LINK_NEVER;
}

// This computer slept much longer than it should (possible on a busy host of virtual machines): nothing was
// sent meanwhile, and answers may wait to be read. Only a quarter of the silence counts, so that the node is
// queried again before it counts as lost.
static void forgive_sleep(struct link *link, uint64_t now) {
    uint64_t lost_ns = lost_deadline(link), repeat_ns = repeat_deadline(link);
    uint64_t wake_ns = lost_ns < repeat_ns ? lost_ns : repeat_ns;
    uint64_t quarter_ns = link->settings.lost_after_ns / 4;
    if (now > wake_ns && now - wake_ns > quarter_ns)
        link->progress_ns = now - quarter_ns;
}

static uint64_t later_of(uint64_t a_ns, uint64_t b_ns) {
    return a_ns > b_ns ? a_ns : b_ns;
}

static void count_silence(struct link *link, uint64_t now) {
    uint64_t since_ns = later_of(link->silence_ns, later_of(link->heard_ns, link->progress_ns));
    if (link->state != LINK_RUNNING || now < since_ns + LINK_SILENCE_MS * NS_PER_MS)
        return;
    link->silence_ns = now;
    link->silences++;
}

void link_handle_timer(struct link *link, uint64_t now) {
    if (link->state == LINK_LOST)
        return;
    forgive_sleep(link, now);
    if (now >= lost_deadline(link)) {
        link->state = link_following(link->state, LINK_EVENT_SILENCE);
        link->cause = link->heard_ns > link->progress_ns ? LINK_CAUSE_STUCK : LINK_CAUSE_SILENT;
        return;
    }
    if (now >= repeat_deadline(link)) {
        link->stats.timeouts++;
        link->backoff++;
        count_silence(link, now);
        link_rewind(link, now, LEAD_FLUSH);
    }
}

static uint64_t next_deadline(const struct link *link, uint64_t now, unsigned allowed) {
    if (link->state == LINK_LOST)
        return LINK_NEVER;
    uint64_t at_ns = lost_deadline(link);
    const uint64_t others[] = {repeat_deadline(link), link_partial_deadline(link)};
    for (size_t i = 0; i < 2; i++)
        at_ns = others[i] < at_ns ? others[i] : at_ns;
    if (link->state != LINK_RUNNING || link->cursor < link->next)
        return at_ns;
    uint64_t gate_ns = link_plan_block(link, now, allowed).at_ns;
    return gate_ns > now && gate_ns < at_ns ? gate_ns : at_ns;
}

// A command that is due soon may make it time for a repeat: the owner has just called link_handle_timer().
uint64_t link_deadline(const struct link *link, uint64_t now, unsigned allowed) {
    uint64_t at_ns = next_deadline(link, now, allowed);
    return at_ns > now ? at_ns : now + 1;
}

void link_get_stats(const struct link *link, struct link_stats *out) {
    *out = link->stats;
    out->rto_ns = link_rto(link);
}
