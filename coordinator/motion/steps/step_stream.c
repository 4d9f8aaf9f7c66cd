// SPDX-License-Identifier: Apache-2.0
// Segments into each node's stream: commands encoded, merged by req_clock, held until a queue slot is free.
#include "coordinator/motion/steps/step_internal.h"
#include "nodes/link/core/batch.h"
#include "wire/wire.h"

enum { ROOM_PER_SEGMENT = COMMANDS_PER_SEGMENT * (BATCH_HEADER + PREFIX_MAX + 3 * WIRE_VLQ_MAX) };

void step_make_prefix(struct prefix *prefix, int32_t id, int32_t oid) {
    const size_t size = wire_vlq_encode(prefix->bytes, id);
    prefix->size = (uint8_t)(size + wire_vlq_encode(prefix->bytes + size, oid));
}

// ------------------------------------------------------------------------------------------------- slots

static uint64_t least(const struct clocks *c) {
    return c->at[c->first];
}

static void drop_least(struct clocks *c) {
    c->first = c->first + 1 < c->room ? c->first + 1 : 0;
    c->count--;
}

// Segments come nearly in the order in which they finish: few have to make way.
static void put_clock(struct clocks *c, uint64_t clock) {
    uint32_t at = c->first + c->count++;
    at = at < c->room ? at : at - c->room;
    for (uint32_t left = c->count - 1; left; left--) {
        const uint32_t before = at ? at - 1 : c->room - 1;
        if (c->at[before] <= clock)
            break;
        c->at[at] = c->at[before];
        at = before;
    }
    c->at[at] = clock;
}

// Takes a slot until FINISH for a command that needs it at DUE; returns the clock at which one is free.
// Every earlier command that no longer counts has finished by an earlier min_clock, and the node receives in
// order: so when this command arrives at its min_clock, at most move_count − 1 others hold a slot.
static uint64_t take_slot(struct node *node, uint64_t req, uint64_t due, uint64_t finish) {
    struct clocks *slots = &node->slots, *busy = &node->busy;
    uint64_t min_clock = 0;
    if (slots->count == slots->room) {
        min_clock = least(slots);
        drop_least(slots);
    }
    put_clock(slots, finish);
    node->stats.late_slots += min_clock > due;
    while (busy->count && (least(busy) <= req || busy->count == busy->room))
        drop_least(busy);
    put_clock(busy, finish);
    if ((int32_t)busy->count > node->stats.max_slots)
        node->stats.max_slots = (int32_t)busy->count;
    return min_clock;
}

// ----------------------------------------------------------------------------------------------- records

static void emit(struct node *node, uint64_t min_clock, const uint8_t *payload, size_t size) {
    node->out_to += batch_write(node->out + node->out_to, min_clock, node->last_req, payload, (uint8_t)size);
    node->stats.commands++;
    node->stats.content_bytes += size;
    if (!node->block_used || node->block_used + size > WIRE_CONTENT_MAX) {
        node->stats.framed_bytes += WIRE_BLOCK_MIN;
        node->block_used = 0;
    }
    node->block_used += (uint32_t)size;
    node->stats.framed_bytes += size;
}

static void emit_for(struct node *node, struct stepper *s, uint64_t min_clock, const struct prefix *prefix,
                     const int64_t *values, size_t count) {
    uint8_t payload[PREFIX_MAX + 3 * WIRE_VLQ_MAX];
    size_t size = prefix->size;
    memcpy(payload, prefix->bytes, PREFIX_MAX);
    for (size_t i = 0; i < count; i++)
        size += wire_vlq_encode(payload + size, (int32_t)(uint32_t)values[i]);
    s->stats.commands++;
    s->stats.content_bytes += size;
    emit(node, min_clock, payload, size);
}

static uint64_t positive(int64_t clock) {
    return clock > 0 ? (uint64_t)clock : 0;
}

static void advance_req(struct node *node, uint64_t req) {
    node->last_req = req > node->last_req ? req : node->last_req;
}

static void emit_segment(struct node *node, struct stepper *s) {
    const struct segment *g = step_segment(s, s->segments_from);
    advance_req(node, positive(g->req));
    if (g->flags & SEGMENT_RESET)
        emit_for(node, s, positive(g->reset_min), &s->reset_clock, &g->reset_clock, 1);
    if (g->flags & SEGMENT_SET_DIR) {
        const int64_t value = (g->flags & SEGMENT_DIR_VALUE) != 0;
        emit_for(node, s, 0, &s->set_dir, &value, 1);
    }
    const uint64_t min_clock = take_slot(node, node->last_req, positive(g->first), positive(g->finish));
    const int64_t values[] = {g->interval, g->count, g->add};
    emit_for(node, s, min_clock, &s->queue_step, values, 3);
    s->stats.issued += g->flags & SEGMENT_BACK ? -(int64_t)g->count : g->count;
    s->stats.issued_clock = g->finish;
    s->segments_from++;
}

// ------------------------------------------------------------------------------------------------- merge

static bool has_room(struct node *node) {
    if (node->out_to + ROOM_PER_SEGMENT <= STEP_OUT_BYTES)
        return true;
    memmove(node->out, node->out + node->out_from, node->out_to - node->out_from);
    node->out_to -= node->out_from;
    node->out_from = 0;
    return node->out_to + ROOM_PER_SEGMENT <= STEP_OUT_BYTES;
}

// The earliest req_clock that segments not yet made may have.
static int64_t horizon(const struct step_gen *gen, const struct stepper *s) {
    const double earliest = s->count ? s->ticks[0] - s->max_error_ticks
                                     : clock_relative(s->clock, s->curve ? s->border : gen->slice, s->base);
    return s->base + (int64_t)floor(earliest) - s->lead_ticks - 1;
}

static size_t merge_node(struct step_gen *gen, struct node *node, bool flush) {
    struct stepper *mine[STEP_MAX_STEPPERS];
    size_t count = 0, moved = 0;
    int64_t steps_until = INT64_MAX;
    for (struct stepper *s = gen->steppers; s < gen->steppers + gen->stepper_count; s++)
        if (s->clock == &node->clock) {
            mine[count++] = s;
            const int64_t h = flush && !s->count ? INT64_MAX : horizon(gen, s);
            steps_until = h < steps_until ? h : steps_until;
        }
    for (node->jammed = false;; moved++) {
        struct stepper *first = NULL;
        int64_t req = steps_until;
        for (size_t i = 0; i < count; i++)
            if (mine[i]->segments_from < mine[i]->segments_to &&
                step_segment(mine[i], mine[i]->segments_from)->req < req) {
                first = mine[i];
                req = step_segment(first, first->segments_from)->req;
            }
        if (!first)
            return moved;
        if (!has_room(node)) {
            node->jammed = true;
            return moved;
        }
        emit_segment(node, first);
    }
}

size_t step_merge(struct step_gen *gen, bool flush) {
    size_t moved = 0;
    for (int i = 0; i < gen->node_count; i++)
        moved += merge_node(gen, &gen->nodes[i], flush);
    return moved;
}

size_t step_take_batch(struct step_gen *gen, int index, uint8_t *out, size_t room) {
    if (index < 0 || index >= gen->node_count)
        return 0;
    struct node *node = &gen->nodes[index];
    size_t taken = 0;
    struct batch_record record;
    for (;;) {
        const uint8_t *at = node->out + node->out_from + taken;
        const size_t size = batch_read(at, node->out_to - node->out_from - taken, &record);
        if (!size || taken + size > room)
            break;
        taken += size;
    }
    memcpy(out, node->out + node->out_from, taken);
    node->out_from += taken;
    if (node->out_from == node->out_to)
        node->out_from = node->out_to = 0;
    return taken;
}
