// SPDX-License-Identifier: Apache-2.0
// Contents and time of a link's next block: classes by urgency, clocks, packing.
#include "nodes/link/core/link_core.h"

// No command whose req_clock lies further ahead is sent: its 32-bit clocks would be ambiguous from 2^31 ticks
// on, and the other half of that range is left to times inside the command that are later than req_clock.
#define CLOCK_REACH ((uint64_t)1 << 30)
// A block that could still be filled by commands whose min_clock comes soon waits for them, but not when its
// first command is due within this time: fewer, fuller blocks cost less of the bus.
#define PACK_LEAD_NS (100 * NS_PER_MS)
// Longest time that a class waits for others that are due earlier. Control: a person or a control loop waits
// for the answer, and 5 ms are a few blocks of all others. Bulk: long enough to give way to whatever a plan
// does, below the seconds after which a transfer is given up.
#define CONTROL_DUE_NS (5 * NS_PER_MS)
#define BULK_DUE_NS (1000 * NS_PER_MS)
#define MARGIN_MAX_NS (100 * NS_PER_MS)
// Slots become free by timers, which a node may run up to 1 ms late, at a clock that the host only estimates.
#define GATE_MARGIN_NS (2 * NS_PER_MS)

// ------------------------------------------------------------------------------------------------- packing

// Returns when a node whose queue has room at MIN_CLOCK (0: now) certainly has it.
static uint64_t free_at(const struct link *link, uint64_t min_clock) {
    uint64_t free_ns = min_clock ? link_clock_to_ns(link, min_clock) : 0;
    return free_ns && free_ns < LINK_NEVER - GATE_MARGIN_NS ? free_ns + GATE_MARGIN_NS : free_ns;
}

uint64_t link_near_at(const struct link *link, enum link_class kind, uint64_t req_clock) {
    uint64_t near_ns = req_clock > CLOCK_REACH ? link_clock_to_ns(link, req_clock - CLOCK_REACH) : 0;
    uint64_t ahead_ns = link->settings.ahead_ns, step_ns = ahead_ns / 4;
    if (kind != LINK_MOTION || !step_ns || !req_clock)
        return near_ns;
    uint64_t due_ns = link_clock_to_ns(link, req_clock);
    uint64_t steps = due_ns > ahead_ns ? (due_ns - ahead_ns + step_ns - 1) / step_ns : 0;
    return steps * step_ns > near_ns ? steps * step_ns : near_ns;
}

static uint64_t gate_of(const struct link *link, enum link_class kind, uint64_t min_clock,
                        uint64_t req_clock) {
    if (!(link->clock_hz > 0))
        return min_clock ? LINK_NEVER : 0;
    uint64_t free_ns = free_at(link, min_clock), near_ns = link_near_at(link, kind, req_clock);
    return free_ns > near_ns ? free_ns : near_ns;
}

static struct link_front ready(const struct link *link, enum link_class kind, uint64_t now, size_t room) {
    const struct link_queue *queue = &link->queues[kind];
    struct link_front front = {.end = queue->head, .gate_ns = LINK_NEVER};
    while (front.end < queue->tail) {
        struct link_command command;
        uint64_t behind = link_queue_peek(queue, front.end, &command);
        if (command.size > room - front.size)
            break;
        uint64_t gate_ns = gate_of(link, kind, command.min_clock, command.req_clock);
        if (gate_ns > now) {
            front.gate_ns = gate_ns;
            break;
        }
        front.end = behind;
        front.size += command.size;
    }
    return front;
}

// Returns when the last of the motion commands that fit into the block may be sent.
static uint64_t filled_at(const struct link *link, const struct link_front *front) {
    const struct link_queue *motion = &link->queues[LINK_MOTION];
    uint64_t latest = front->gate_ns;
    size_t size = front->size;
    for (uint64_t at = front->end; at < motion->tail;) {
        struct link_command command;
        at = link_queue_peek(motion, at, &command);
        if (command.size > WIRE_CONTENT_MAX - size)
            break;
        uint64_t gate_ns = gate_of(link, LINK_MOTION, command.min_clock, command.req_clock);
        if (gate_ns > latest)
            latest = gate_ns;
        size += command.size;
    }
    return latest;
}

uint64_t link_motion_due(const struct link *link, uint64_t req_clock) {
    if (!req_clock || !(link->clock_hz > 0))
        return 0;
    uint64_t due_ns = link_clock_to_ns(link, req_clock);
    uint64_t margin_ns = link->stats.srtt_ns + link_first_rto(link);
    margin_ns = margin_ns < MARGIN_MAX_NS ? margin_ns : MARGIN_MAX_NS;
    return due_ns > margin_ns ? due_ns - margin_ns : 1;
}

static struct link_offer offer_of(const struct link *link, enum link_class kind,
                                  const struct link_command *head, uint64_t now) {
    struct link_offer offer = {.kind = (uint8_t)kind};
    uint64_t due_ns = kind == LINK_BULK ? 0 : link_motion_due(link, head->req_clock);
    if (kind == LINK_MOTION) {
        offer.due_ns =
            due_ns ? due_ns : now; // the clock is unknown: at once, but not before what waited longer
        offer.urgent = due_ns && due_ns <= now;
        return offer;
    }
    offer.due_ns = head->queued_ns + (kind == LINK_BULK ? BULK_DUE_NS : CONTROL_DUE_NS);
    if (due_ns && due_ns < offer.due_ns)
        offer.due_ns = due_ns;
    if (kind == LINK_CONTROL && link->urgent) {
        offer.due_ns = 0;
        offer.urgent = 1;
    }
    return offer;
}

static int is_before(const struct link_offer *a, const struct link_offer *b) {
    return a->urgent != b->urgent ? a->urgent : a->due_ns < b->due_ns;
}

// Finds the classes that have something to send now, in order.
static void order_classes(const struct link *link, uint64_t now, unsigned allowed, struct link_plan *plan) {
    static const enum link_class ranks[LINK_CLASSES] = {LINK_CONTROL, LINK_MOTION, LINK_BULK}; // if equal
    struct link_offer offers[LINK_CLASSES];
    for (size_t rank = 0; rank < LINK_CLASSES; rank++) {
        enum link_class kind = ranks[rank];
        const struct link_queue *queue = &link->queues[kind];
        if (queue->head == queue->tail || (kind != LINK_MOTION && !(allowed & 1u << kind)))
            continue;
        struct link_command head;
        link_queue_peek(queue, queue->head, &head);
        uint64_t gate_ns = gate_of(link, kind, head.min_clock, head.req_clock);
        if (gate_ns > now) {
            plan->at_ns = gate_ns < plan->at_ns ? gate_ns : plan->at_ns;
            continue;
        }
        offers[kind] = offer_of(link, kind, &head, now);
        if (!(allowed & 1u << kind) && !offers[kind].urgent) { // motion may not be sent ahead
            // Motion whose time is unknown waits for the budget alone; its due_ns is now, and a plan for now
            // without a command would be an empty block.
            if (offers[kind].due_ns > now && offers[kind].due_ns < plan->at_ns)
                plan->at_ns = offers[kind].due_ns;
            continue;
        }
        size_t at = plan->classes++;
        for (; at > 0 && is_before(&offers[kind], &offers[plan->order[at - 1]]); at--)
            plan->order[at] = plan->order[at - 1];
        plan->order[at] = kind;
    }
    if (plan->classes)
        plan->offer = offers[plan->order[0]];
}

// A block of motion alone that could still be filled waits, within bounds.
static uint64_t hold_motion(const struct link *link, const struct link_front *front) {
    if (front->gate_ns == LINK_NEVER)
        return 0;
    struct link_command head;
    const struct link_queue *motion = &link->queues[LINK_MOTION];
    link_queue_peek(motion, motion->head, &head);
    // With a gate, the clock is known.
    uint64_t due_ns = head.req_clock ? link_clock_to_ns(link, head.req_clock) : 0;
    uint64_t urgent_ns = due_ns > PACK_LEAD_NS ? due_ns - PACK_LEAD_NS : 0;
    uint64_t full_ns = filled_at(link, front);
    return full_ns < urgent_ns ? full_ns : urgent_ns;
}

static struct link_plan plan_allowed(const struct link *link, uint64_t now, unsigned allowed) {
    struct link_plan plan = {.at_ns = LINK_NEVER};
    order_classes(link, now, allowed, &plan);
    size_t filled = 0;
    for (size_t i = 0; i < plan.classes; i++) {
        enum link_class kind = plan.order[i];
        plan.fronts[kind] = ready(link, kind, now, WIRE_CONTENT_MAX - plan.size);
        plan.size += plan.fronts[kind].size;
        filled += plan.fronts[kind].size > 0;
    }
    if (filled == 1 && plan.fronts[LINK_MOTION].size) {
        uint64_t hold_ns = hold_motion(link, &plan.fronts[LINK_MOTION]);
        plan.at_ns = hold_ns < plan.at_ns ? hold_ns : plan.at_ns;
    } else if (filled) {
        plan.at_ns = 0;
    }
    return plan;
}

void link_take(struct link *link, enum link_class kind, const struct link_front *front,
               struct link_block *block) {
    struct link_queue *queue = &link->queues[kind];
    while (queue->head < front->end) {
        struct link_command command;
        uint64_t behind = link_queue_peek(queue, queue->head, &command);
        link_queue_payload(queue, queue->head, &command, block->bytes + WIRE_HEADER + block->length);
        block->length = (uint8_t)(block->length + command.size);
        block->commands++;
        if (command.req_clock && (!block->due_clock || command.req_clock < block->due_clock))
            block->due_clock = command.req_clock;
        if (kind == LINK_MOTION) {
            link->motion_content += command.size;
            if (command.req_clock)
                block->req_clock[block->leads++] = command.req_clock;
        } else {
            block->asks = 1;
        }
        link_queue_drop(queue, behind, 1);
    }
}

// Bulk leaves room for a block of something else in the node's buffer: without it, motion that becomes ready
// would wait for a round trip.
static int room_for(const struct link *link, const struct link_plan *plan) {
    size_t spare = plan->offer.kind == LINK_BULK ? WIRE_BLOCK_MAX : 0;
    return link_fits(link, WIRE_BLOCK_MIN + plan->size + spare);
}

struct link_plan link_plan_block(const struct link *link, uint64_t now, unsigned allowed) {
    struct link_plan plan = plan_allowed(link, now, allowed);
    if (plan.offer.kind == LINK_BULK && !room_for(link, &plan))
        plan = plan_allowed(link, now, allowed & ~(1u << LINK_BULK));
    return plan;
}

int link_may_go(const struct link *link, const struct link_plan *plan, uint64_t now) {
    return plan->at_ns <= now && link->next - link->first < LINK_BLOCKS_MAX && room_for(link, plan);
}
