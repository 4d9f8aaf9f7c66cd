// SPDX-License-Identifier: Apache-2.0
// The sending half of a link: queues, packing, window, repeats, timers.
#include "nodes/link/link_core.h"

#include <math.h>
#include <string.h>

#include "nodes/link/batch.h"

// No command whose req_clock lies further ahead is sent: its 32-bit clocks would be ambiguous from 2^31 ticks
// on, and the other half of that range is left to times inside the command that lie behind req_clock.
#define CLOCK_REACH ((uint64_t)1 << 30)
// A block that could still be filled by commands whose min_clock comes soon waits for them, but not when its
// first command is due within this time: fewer, fuller blocks cost less of the bus.
#define PACK_LEAD_NS (100 * NS_PER_MS)
#define RTO_MIN_NS (20 * NS_PER_MS)    // below, a busy host or node would cause needless repeats
#define RTO_FIRST_NS (100 * NS_PER_MS) // until a round trip was measured
#define FIRST_SEQUENCE 16              // room below for the adoption of the node's

// -------------------------------------------------------------------------------------------------- set-up

void link_init(struct link *link, const struct link_settings *settings, uint8_t *control, size_t control_size,
               uint8_t *motion, size_t motion_size) {
    memset(link, 0, sizeof *link);
    link->settings = *settings;
    link_queue_init(&link->control, control, control_size);
    link_queue_init(&link->motion, motion, motion_size);
    link->first = link->cursor = link->next = FIRST_SEQUENCE;
    link->last_ack = LINK_NEVER;
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
    if (ahead) // rounded up: never a moment too early
        return away_ns < 9e18 ? link->clock_at_ns + (uint64_t)ceil(away_ns) : LINK_NEVER;
    return away_ns < (double)link->clock_at_ns ? link->clock_at_ns - (uint64_t)away_ns : 0;
}

// ------------------------------------------------------------------------------------------------ queueing

enum link_status link_send(struct link *link, const uint8_t *content, size_t size, uint64_t min_clock,
                           uint64_t req_clock) {
    if (link->state == LINK_LOST)
        return LINK_GONE;
    if (size == 0 || size > WIRE_CONTENT_MAX)
        return LINK_INVALID;
    uint8_t record[BATCH_HEADER + WIRE_CONTENT_MAX];
    size_t length = batch_write(record, min_clock, req_clock, content, (uint8_t)size);
    return link_queue_put(&link->control, record, length, 1) ? LINK_OK : LINK_FULL;
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
    return link_queue_put(&link->motion, batch, size, count) ? LINK_OK : LINK_FULL;
}

enum link_status link_send_urgent(struct link *link, const uint8_t *content, size_t size) {
    if (link->state == LINK_LOST)
        return LINK_GONE;
    if (size == 0 || size > WIRE_CONTENT_MAX)
        return LINK_INVALID;
    link->stats.commands_dropped += link->control.commands + link->motion.commands;
    link_queue_drop(&link->control, link->control.tail, link->control.commands);
    link_queue_drop(&link->motion, link->motion.tail, link->motion.commands);
    return link_send(link, content, size, 0, 0);
}

uint64_t link_pending(const struct link *link) {
    return link->control.commands + link->motion.commands + link->flying_commands;
}

// ------------------------------------------------------------------------------------------------- packing

// The records at the front of a queue that may go now and fit together.
struct front {
    uint64_t end; // position behind them
    uint64_t commands;
    size_t size;      // of their payloads
    uint64_t gate_ns; // when the next one may follow; LINK_NEVER: there is none, or it does not fit
    uint64_t due_ns;  // of the first; 0: at once or unknown
};

static uint64_t gate_of(const struct link *link, const struct link_command *command) {
    uint64_t reach = command->req_clock > CLOCK_REACH ? command->req_clock - CLOCK_REACH : 0;
    uint64_t ticks = command->min_clock > reach ? command->min_clock : reach;
    if (link->clock_hz > 0)
        return ticks ? link_clock_to_ns(link, ticks) : 0;
    return command->min_clock ? LINK_NEVER : 0;
}

static struct front ready(const struct link *link, const struct link_queue *queue, uint64_t now,
                          size_t room) {
    struct front front = {.end = queue->head, .gate_ns = LINK_NEVER};
    while (front.end < queue->tail) {
        struct link_command command;
        uint64_t behind = link_queue_peek(queue, front.end, &command);
        if (command.size > room - front.size)
            break;
        uint64_t gate_ns = gate_of(link, &command);
        if (gate_ns > now) {
            front.gate_ns = gate_ns;
            break;
        }
        if (!front.commands && command.req_clock && link->clock_hz > 0)
            front.due_ns = link_clock_to_ns(link, command.req_clock);
        front.end = behind;
        front.size += command.size;
        front.commands++;
    }
    return front;
}

// When the last of the records that fit into the block may go.
static uint64_t filled_at(const struct link *link, const struct front *front, size_t room) {
    uint64_t latest = 0;
    size_t size = front->size;
    for (uint64_t at = front->end; at < link->motion.tail;) {
        struct link_command command;
        at = link_queue_peek(&link->motion, at, &command);
        if (command.size > room - size)
            break;
        uint64_t gate_ns = gate_of(link, &command);
        if (gate_ns > latest)
            latest = gate_ns;
        size += command.size;
    }
    return latest;
}

struct plan {
    uint64_t at_ns;  // when the next new block may go; <= NOW: it may, as far as clocks are concerned
    uint64_t due_ns; // host time at which it is due, 0: at once
    struct front control, motion;
};

static struct plan plan_block(const struct link *link, uint64_t now) {
    struct plan plan = {.control = ready(link, &link->control, now, WIRE_CONTENT_MAX)};
    size_t room = WIRE_CONTENT_MAX - plan.control.size;
    plan.motion = ready(link, &link->motion, now, room);
    plan.at_ns = plan.control.gate_ns;
    if (plan.control.commands || (plan.motion.commands && plan.motion.gate_ns == LINK_NEVER)) {
        plan.at_ns = 0;
    } else if (plan.motion.commands) {
        uint64_t due_ns = plan.motion.due_ns;
        uint64_t pressing_ns = due_ns > PACK_LEAD_NS ? due_ns - PACK_LEAD_NS : 0;
        uint64_t full_ns = filled_at(link, &plan.motion, room);
        uint64_t hold_ns = full_ns < pressing_ns ? full_ns : pressing_ns;
        plan.at_ns = hold_ns < plan.at_ns ? hold_ns : plan.at_ns;
    } else if (plan.motion.gate_ns < plan.at_ns) {
        plan.at_ns = plan.motion.gate_ns;
    }
    plan.due_ns = plan.control.commands ? 0 : plan.motion.due_ns;
    return plan;
}

static void take(struct link_queue *queue, const struct front *front, struct link_block *block, int motion) {
    while (queue->head < front->end) {
        struct link_command command;
        uint64_t behind = link_queue_peek(queue, queue->head, &command);
        link_queue_payload(queue, queue->head, &command, block->bytes + WIRE_HEADER + block->length);
        block->length = (uint8_t)(block->length + command.size);
        block->commands++;
        if (motion && command.req_clock)
            block->req_clock[block->leads++] = command.req_clock;
        link_queue_drop(queue, behind, 1);
    }
}

// -------------------------------------------------------------------------------------------- transmission

static int fits(const struct link *link, size_t bytes) {
    return link->flying_bytes == 0 || link->flying_bytes + bytes <= link->settings.receive_window;
}

static int may_probe(const struct link *link) {
    return link->first == link->next && link->control.commands + link->motion.commands > 0;
}

static int may_go(const struct link *link, const struct plan *plan, uint64_t now) {
    size_t length = WIRE_BLOCK_MIN + plan->control.size + plan->motion.size;
    return plan->at_ns <= now && link->next - link->first < LINK_BLOCKS_MAX && fits(link, length);
}

// Makes the next new block, if there is one to send. While the node's expected sequence is unknown it is
// empty: an answer that names the next sequence cannot tell whether the block was taken or was out of order,
// and of an empty one nothing can be lost.
static int make_block(struct link *link, uint64_t now) {
    struct plan plan = {.control = {.end = link->control.head}, .motion = {.end = link->motion.head}};
    if (link->state == LINK_RUNNING) {
        if (link->flying_bytes && !fits(link, WIRE_BLOCK_MIN + 1))
            return 0;
        plan = plan_block(link, now);
        if (!may_go(link, &plan, now))
            return 0;
    } else if (!may_probe(link)) {
        return 0;
    }
    struct link_block *block = block_of(link, link->next);
    block->sent_ns = 0;
    block->repeated = block->length = block->commands = block->leads = 0;
    take(&link->control, &plan.control, block, 0);
    take(&link->motion, &plan.motion, block, 1);
    block->length =
        (uint8_t)wire_block_finish(block->bytes, block->length, (unsigned)(link->next % LINK_SLOTS));
    link->stats.commands_sent += block->commands;
    link->flying_commands += block->commands;
    if (link->first == link->next && !link->probe_answered) // probing as a whole has to end in time
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

size_t link_next_block(struct link *link, uint64_t now, uint8_t *out) {
    if (link->state == LINK_LOST || (link->cursor == link->next && !make_block(link, now)))
        return 0;
    struct link_block *block = block_of(link, link->cursor);
    size_t lead_in = lead_in_bytes(link), size = lead_in + block->length;
    if (!fits(link, size))
        return 0;
    memset(out, WIRE_SYNC, lead_in);
    memcpy(out + lead_in, block->bytes, block->length);
    if (block->sent_ns) {
        block->repeated = 1;
        link->stats.blocks_repeated++;
        link->stats.bytes_repeated += size;
    }
    link->stats.blocks_sent++;
    link->stats.bytes_sent += size;
    link->lead_in = LEAD_NONE;
    block->sent_ns = now ? now : 1; // 0 means never sent
    block->wire_length = (uint8_t)size;
    link->flying_bytes += size;
    link->cursor++;
    return size;
}

uint64_t link_next_due(const struct link *link, uint64_t now) {
    if (link->state == LINK_LOST)
        return LINK_NEVER;
    if (link->cursor < link->next)
        return fits(link, lead_in_bytes(link) + const_block_of(link, link->cursor)->length) ? 0 : LINK_NEVER;
    if (link->state == LINK_PROBING)
        return may_probe(link) ? 0 : LINK_NEVER;
    struct plan plan = plan_block(link, now);
    return may_go(link, &plan, now) ? plan.due_ns : LINK_NEVER;
}

// ---------------------------------------------------------------------------------------------------- time

uint64_t link_rto(const struct link *link) {
    const struct link_stats *stats = &link->stats;
    uint64_t rto_ns = stats->srtt_ns ? stats->srtt_ns + 4 * stats->rttvar_ns : RTO_FIRST_NS;
    uint64_t most_ns = link->settings.lost_after_ns / 4; // several tries before the link counts as lost
    rto_ns = rto_ns < RTO_MIN_NS ? RTO_MIN_NS : rto_ns;
    for (uint64_t i = 0; i < link->backoff && rto_ns < most_ns; i++)
        rto_ns *= 2;
    return rto_ns < most_ns ? rto_ns : most_ns;
}

void link_rewind(struct link *link, uint64_t now, enum lead_in lead_in) {
    // A node answers each block that it has already (or that comes out of order) with its expected sequence:
    // as many naks may still come as blocks were sent, and they tell nothing about a loss after this repeat.
    // Acting on them would repeat good blocks, cause the same naks again, and so on for ever.
    uint64_t owed = link->naks_owed + (link->cursor - link->first);
    link->naks_owed = owed < 2 * LINK_BLOCKS_MAX ? owed : 2 * LINK_BLOCKS_MAX;
    link->owed_until_ns = now + link_rto(link);
    link->owed_until_seq = link->next;
    link->cursor = link->first;
    link->flying_bytes = 0;
    if (link->lead_in < lead_in)
        link->lead_in = (uint8_t)lead_in;
}

static uint64_t repeat_deadline(const struct link *link) {
    if (link->cursor == link->first)
        return LINK_NEVER;
    uint64_t sent_ns = const_block_of(link, link->first)->sent_ns;
    return (sent_ns > link->progress_ns ? sent_ns : link->progress_ns) + link_rto(link);
}

static uint64_t lost_deadline(const struct link *link) {
    int waiting = link->first < link->next || link->probe_answered;
    return waiting ? link->progress_ns + link->settings.lost_after_ns : LINK_NEVER;
}

void link_handle_timer(struct link *link, uint64_t now) {
    if (link->state == LINK_LOST)
        return;
    if (now >= lost_deadline(link)) {
        link->state = LINK_LOST;
        link->cause = link->heard_ns > link->progress_ns ? LINK_CAUSE_STUCK : LINK_CAUSE_SILENT;
        return;
    }
    if (now >= repeat_deadline(link)) {
        link->stats.timeouts++;
        link->backoff++;
        link_rewind(link, now, LEAD_FLUSH);
    }
}

uint64_t link_deadline(const struct link *link, uint64_t now) {
    if (link->state == LINK_LOST)
        return LINK_NEVER;
    uint64_t at_ns = lost_deadline(link);
    const uint64_t others[] = {repeat_deadline(link), link_partial_deadline(link)};
    for (size_t i = 0; i < 2; i++)
        at_ns = others[i] < at_ns ? others[i] : at_ns;
    if (link->state != LINK_RUNNING || link->cursor < link->next)
        return at_ns;
    uint64_t gate_ns = plan_block(link, now).at_ns;
    return gate_ns > now && gate_ns < at_ns ? gate_ns : at_ns;
}

void link_get_stats(const struct link *link, struct link_stats *out) {
    *out = link->stats;
    out->rto_ns = link_rto(link);
}
