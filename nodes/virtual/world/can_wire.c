// SPDX-License-Identifier: Apache-2.0
// The wire between the controllers: arbitration and the outcome of frames. See can_wire.h.
#include "nodes/virtual/world/can_wire.h"

#include "nodes/support/can_bits.h"

#include <math.h>
#include <string.h>

enum outcome { GOOD, COLLISION, DISTURBED, UNACKNOWLEDGED };

enum {
    GAP_BITS = 3,        // intermission, the last part of a frame
    AFTER_ACK_BITS = 11, // of a frame, after its acknowledge slot
    TEC_STEP = 8,
    TEC_PASSIVE = 128,
};

// -------------------------------------------------------------------------------------------------- time

uint64_t can_wire_bits_ns(const struct can_wire *wire, uint64_t bits) {
    return bits * NS_PER_S / wire->settings.bitrate;
}

// Returns when bit BITS of the frame that began at start_ns begins. The remainder of the division is carried
// over from frame to frame, so that rounding causes no drift of the rate.
static uint64_t bit_time(const struct can_segment *segment, uint64_t bits, uint64_t *rest) {
    uint64_t scaled = bits * NS_PER_S + segment->start_carry, bitrate = segment->wire->settings.bitrate;
    if (rest)
        *rest = scaled % bitrate;
    return segment->start_ns + scaled / bitrate;
}

static int is_on(const struct can_controller *controller, const struct can_segment *segment) {
    return controller->segment == segment->number && can_controller_hears(controller);
}

// --------------------------------------------------------------------------------------------- beginning

// Returns when the first waiting controller can start.
static uint64_t next_start(const struct can_segment *segment) {
    const struct can_wire *wire = segment->wire;
    uint64_t now = wire->agenda->now_ns, start_ns = AGENDA_NEVER, number;
    uint64_t free_ns = now > segment->free_ns ? now : segment->free_ns;
    for (uint32_t i = 0; i < wire->count; i++) {
        const struct can_controller *controller = wire->controllers[i];
        if (!is_on(controller, segment) || !can_controller_offer(controller, now, &number))
            continue;
        uint64_t at_ns = free_ns > controller->ready_ns ? free_ns : controller->ready_ns;
        start_ns = at_ns < start_ns ? at_ns : start_ns;
    }
    return start_ns;
}

static void plan(struct can_segment *segment) {
    struct agenda *agenda = segment->wire->agenda;
    int started = segment->phase == CAN_STARTING && agenda->now_ns >= segment->start_ns;
    if (segment->phase == CAN_BUSY || started)
        return; // a new frame takes part in the current arbitration, or waits
    uint64_t start_ns = next_start(segment);
    if (start_ns == AGENDA_NEVER) {
        segment->phase = CAN_IDLE;
        agenda_cancel(agenda, &segment->event);
        return;
    }
    segment->phase = CAN_STARTING;
    segment->start_ns = start_ns;
    segment->start_carry = start_ns == segment->free_ns ? segment->carry : 0;
    agenda_plan(agenda, &segment->event, bit_time(segment, 1, NULL));
}

void can_wire_plan(struct can_controller *controller) {
    plan(&controller->wire->segments[controller->segment]);
}

// Returns the frame of CONTROLLER that takes part in the arbitration now, or NULL. A suspended controller
// cannot take part once another has begun.
static const struct can_bits *contender(const struct can_controller *controller,
                                        const struct can_segment *segment, uint64_t *number) {
    if (!is_on(controller, segment) || controller->ready_ns > segment->start_ns)
        return NULL;
    return can_controller_offer(controller, segment->start_ns, number);
}

// Starts all controllers with the lowest id; returns their number. The segment's frame is that of the first.
static uint32_t arbitrate(struct can_segment *segment) {
    struct can_wire *wire = segment->wire;
    uint32_t lowest = UINT32_MAX, senders = 0;
    uint64_t number;
    for (uint32_t i = 0; i < wire->count; i++) {
        const struct can_bits *frame = contender(wire->controllers[i], segment, &number);
        if (frame && frame->id < lowest)
            lowest = frame->id;
    }
    for (uint32_t i = 0; i < wire->count; i++) {
        const struct can_bits *frame = contender(wire->controllers[i], segment, &number);
        if (!frame || frame->id != lowest)
            continue;
        wire->controllers[i]->on_wire = number;
        if (senders++ == 0)
            segment->frame = *frame;
    }
    return senders;
}

// ----------------------------------------------------------------------------------------------- outcome

struct rivals {
    struct can_controller *controllers[CAN_CONTROLLERS_MAX];
    const struct can_bits *frames[CAN_CONTROLLERS_MAX];
    uint8_t levels[CAN_CONTROLLERS_MAX][CAN_LEVELS_MAX];
    uint32_t count;
};

static void find_rivals(const struct can_segment *segment, struct rivals *rivals) {
    const struct can_wire *wire = segment->wire;
    rivals->count = 0;
    for (uint32_t i = 0; i < wire->count; i++) {
        struct can_controller *controller = wire->controllers[i];
        uint64_t number;
        if (!controller->on_wire || controller->segment != segment->number)
            continue;
        const struct can_bits *frame = contender(controller, segment, &number);
        if (!frame)
            continue;
        uint32_t at = rivals->count++;
        rivals->controllers[at] = controller;
        rivals->frames[at] = frame;
        memset(rivals->levels[at], 1, CAN_LEVELS_MAX);
        can_frame_levels(frame->id, frame->size, frame->data, rivals->levels[at]);
    }
}

// An error-passive sender whose recessive bit is overwritten cannot disturb the others: it gives up, and does
// not receive the frame that continues.
static void give_up(struct can_segment *segment, struct can_controller *controller) {
    can_controller_send_failed(controller, TEC_STEP);
    controller->joined_ns = segment->wire->agenda->now_ns;
    segment->wire->counters.yielded++;
}

// Evaluates BIT: senders of a recessive bit detect a dominant one. Returns whether an active error flag
// follows; error-passive senders leave the rivals.
static int collide(struct can_segment *segment, struct rivals *rivals, uint32_t bit) {
    uint32_t dominant = 0, left = 0;
    for (uint32_t i = 0; i < rivals->count; i++)
        dominant += rivals->levels[i][bit] == 0;
    if (dominant == 0 || dominant == rivals->count)
        return 0;
    for (uint32_t i = 0; i < rivals->count; i++)
        if (rivals->levels[i][bit] && can_state_of(rivals->controllers[i]) != CAN_PASSIVE)
            return 1;
    for (uint32_t i = 0; i < rivals->count; i++) {
        if (rivals->levels[i][bit]) {
            give_up(segment, rivals->controllers[i]);
            continue;
        }
        rivals->controllers[left] = rivals->controllers[i];
        rivals->frames[left] = rivals->frames[i];
        memmove(rivals->levels[left++], rivals->levels[i], CAN_LEVELS_MAX);
    }
    rivals->count = left;
    return 0;
}

// Returns the bit at which senders of one id destroy each other's frames; UINT32_MAX: none, the segment's
// frame is the one that survives.
static uint32_t first_collision(struct can_segment *segment) {
    struct rivals rivals;
    find_rivals(segment, &rivals);
    for (uint32_t bit = 0; bit < CAN_LEVELS_MAX && rivals.count > 1; bit++)
        if (collide(segment, &rivals, bit))
            return bit;
    // There is one: arbitration found it. NOLINTNEXTLINE(clang-analyzer-core.NullDereference)
    segment->frame = *rivals.frames[0];
    segment->wire->counters.same += rivals.count > 1;
    return UINT32_MAX;
}

// Returns the first disturbed bit of BITS (geometrically distributed), or UINT32_MAX.
static uint32_t first_disturbed(struct can_wire *wire, uint32_t bits) {
    double probability = wire->settings.bit_errors;
    if (!(probability > 0))
        return UINT32_MAX;
    if (probability >= 1)
        return 0;
    double bit = log(1.0 - chance_fraction(&wire->chance)) / log1p(-probability);
    return bit < bits ? (uint32_t)bit : UINT32_MAX;
}

static int is_acknowledged(const struct can_segment *segment) {
    const struct can_wire *wire = segment->wire;
    for (uint32_t i = 0; i < wire->count; i++)
        if (is_on(wire->controllers[i], segment) && !wire->controllers[i]->on_wire &&
            wire->controllers[i]->joined_ns <= segment->start_ns)
            return 1;
    return 0;
}

// Determines the outcome of the frame that begins; returns the number of bits until it is known.
static uint32_t decide(struct can_segment *segment, uint32_t senders) {
    uint32_t wrong = senders > 1 ? first_collision(segment) : UINT32_MAX;
    const struct can_bits *frame = &segment->frame;
    uint32_t bits = can_frame_bits(frame->id, frame->size, frame->data);
    segment->outcome = wrong == UINT32_MAX ? GOOD : COLLISION;
    uint32_t disturbed = first_disturbed(segment->wire, bits - GAP_BITS);
    if (disturbed < wrong) {
        segment->outcome = DISTURBED;
        wrong = disturbed;
    }
    uint32_t ack_bits = bits - AFTER_ACK_BITS;
    if (wrong >= ack_bits && !is_acknowledged(segment)) {
        segment->outcome = UNACKNOWLEDGED;
        segment->free_bits = ack_bits + CAN_LONELY_ERROR_BITS;
        return ack_bits;
    }
    if (wrong != UINT32_MAX) {
        segment->free_bits = wrong + 1 + CAN_ERROR_BITS;
        return wrong + 1;
    }
    segment->free_bits = bits;
    return bits - GAP_BITS;
}

static void begin(struct can_segment *segment) {
    struct can_wire *wire = segment->wire;
    uint32_t senders = arbitrate(segment);
    if (senders == 0) { // the controllers that wanted to send are gone
        segment->phase = CAN_IDLE;
        plan(segment);
        return;
    }
    segment->phase = CAN_BUSY;
    for (uint32_t i = 0; i < wire->count; i++)
        if (wire->controllers[i]->segment == segment->number)
            can_controller_idle(wire->controllers[i], segment->free_ns, segment->start_ns);
    agenda_plan(wire->agenda, &segment->event, bit_time(segment, decide(segment, senders), NULL));
}

// ------------------------------------------------------------------------------------------------ ending

static void count(struct can_wire *wire, const struct can_segment *segment) {
    struct can_wire_counters *counters = &wire->counters;
    counters->bits += segment->free_bits;
    counters->frames += segment->outcome == GOOD;
    counters->errors += segment->outcome != GOOD;
    counters->collisions += segment->outcome == COLLISION;
    counters->disturbed += segment->outcome == DISTURBED;
    counters->unacknowledged += segment->outcome == UNACKNOWLEDGED;
    uint64_t data = 0;
    memcpy(&data, segment->frame.data, segment->frame.size);
    agenda_note(wire->agenda, segment->frame.id | (uint64_t)segment->outcome << 16);
    agenda_note(wire->agenda, data);
}

// Error-passive senders suspend transmission, so that others can start first.
static void suspend(struct can_controller *controller, uint64_t free_ns) {
    if (can_state_of(controller) == CAN_PASSIVE)
        controller->ready_ns = free_ns + can_wire_bits_ns(controller->wire, CAN_SUSPEND_BITS);
}

static void end_badly(struct can_segment *segment) {
    struct can_wire *wire = segment->wire;
    for (uint32_t i = 0; i < wire->count; i++) {
        struct can_controller *controller = wire->controllers[i];
        if (!is_on(controller, segment))
            continue;
        if (!controller->on_wire) {
            can_controller_receive_failed(controller);
            continue;
        }
        // Alone on the bus, a sender stays error-passive (ISO 11898-1).
        int stays = segment->outcome == UNACKNOWLEDGED && controller->tec >= TEC_PASSIVE;
        can_controller_send_failed(controller, stays ? 0 : TEC_STEP);
        suspend(controller, segment->free_ns);
    }
}

static void end_well(struct can_segment *segment) {
    struct can_wire *wire = segment->wire;
    const struct can_bits frame = segment->frame;
    for (uint32_t i = 0; i < wire->count; i++) {
        struct can_controller *controller = wire->controllers[i];
        if (!is_on(controller, segment))
            continue;
        if (controller->on_wire) {
            can_controller_sent(controller);
            suspend(controller, segment->free_ns);
            controller->on_sent(controller->owner);
        } else if (controller->joined_ns <= segment->start_ns) {
            can_controller_received(controller, &frame);
        }
    }
}

static void segment_due(void *owner) {
    struct can_segment *segment = owner;
    struct can_wire *wire = segment->wire;
    if (segment->phase == CAN_STARTING) {
        begin(segment);
        return;
    }
    segment->free_ns = bit_time(segment, segment->free_bits, &segment->carry);
    count(wire, segment);
    if (segment->outcome == GOOD)
        end_well(segment);
    else
        end_badly(segment);
    for (uint32_t i = 0; i < wire->count; i++)
        if (wire->controllers[i]->segment == segment->number)
            can_controller_sequence(wire->controllers[i], segment->free_ns);
    segment->phase = CAN_IDLE;
    plan(segment);
}

void can_wire_abort(struct can_controller *controller) {
    struct can_wire *wire = controller->wire;
    struct can_segment *segment = &wire->segments[controller->segment];
    controller->on_wire = 0;
    if (segment->phase != CAN_BUSY)
        return;
    uint64_t now = wire->agenda->now_ns;
    uint64_t passed = (now - segment->start_ns) * wire->settings.bitrate / NS_PER_S + 1;
    segment->outcome = DISTURBED;
    segment->free_bits = (uint32_t)passed + CAN_ERROR_BITS;
    agenda_plan(wire->agenda, &segment->event, bit_time(segment, passed, NULL));
}

int can_wire_start(struct can_wire *wire, struct agenda *agenda, struct chance chance,
                   const struct can_wire_settings *settings) {
    memset(wire, 0, sizeof(*wire));
    wire->agenda = agenda;
    wire->settings = *settings;
    wire->chance = chance;
    for (unsigned i = 0; i < CAN_SEGMENTS_MAX; i++)
        wire->segments[i] = (struct can_segment){
            .wire = wire,
            .number = (uint8_t)i,
            .event = {.fire = segment_due, .owner = &wire->segments[i]},
        };
    return agenda_reserve(agenda, CAN_SEGMENTS_MAX);
}
