// SPDX-License-Identifier: Apache-2.0
// One CAN controller: its transmit queue, its error counters, its states.
#include "nodes/virtual/world/can_wire.h"

#include <stdlib.h>
#include <string.h>

enum {
    TEC_OFF = 256,
    COUNT_PASSIVE = 128,
    COUNT_WARN = 96,
    REC_AFTER_PASSIVE = 119, // a good frame brings the counter back to between 119 and 127
    SEQUENCE_BITS = 11,
    URGENT_END = 0x100,
};

static struct agenda *agenda_of(const struct can_controller *controller) {
    return controller->wire->agenda;
}

static int is_passive(const struct can_controller *controller) {
    return controller->tec >= COUNT_PASSIVE || controller->rec >= COUNT_PASSIVE;
}

enum can_state can_state_of(const struct can_controller *controller) {
    if (controller->off)
        return CAN_OFF;
    if (is_passive(controller))
        return CAN_PASSIVE;
    return controller->tec >= COUNT_WARN || controller->rec >= COUNT_WARN ? CAN_WARN : CAN_ACTIVE;
}

// -------------------------------------------------------------------------------------------- the queue

static void remove_slot(struct can_controller *controller, uint32_t at) {
    controller->count--;
    memmove(controller->slots + at, controller->slots + at + 1,
            (controller->count - at) * sizeof(controller->slots[0]));
}

static void forget_queue(struct can_controller *controller) {
    controller->counters.dropped += controller->count;
    controller->count = 0;
    controller->on_wire = 0;
}

// Urgent frames go before all others; where a chip has mailboxes, one is reserved for them.
static uint32_t place_for(const struct can_controller *controller, const struct can_bits *frame) {
    uint32_t at = controller->count;
    if (frame->id >= URGENT_END)
        return at;
    while (at > 0 && controller->slots[at - 1].frame.id >= URGENT_END)
        at--;
    return at;
}

int can_offer(struct can_controller *controller, const struct can_bits *frame) {
    const struct can_controller_settings *settings = &controller->settings;
    if (!controller->powered || (controller->off && settings->drops_when_off)) {
        controller->counters.dropped++;
        return 0;
    }
    uint32_t room = frame->id < URGENT_END ? settings->queue : settings->queue - settings->reserved;
    if (controller->count >= room) {
        controller->counters.refused++;
        return -1;
    }
    uint32_t at = place_for(controller, frame);
    memmove(controller->slots + at + 1, controller->slots + at,
            (controller->count - at) * sizeof(controller->slots[0]));
    controller->slots[at] = (struct can_slot){*frame, ++controller->last_number};
    controller->count++;
    if (controller->count > controller->counters.queue_max)
        controller->counters.queue_max = controller->count;
    can_wire_plan(controller);
    return 0;
}

const struct can_bits *can_controller_offer(const struct can_controller *controller, uint64_t now_ns,
                                            uint64_t *number) {
    if (!can_controller_hears(controller))
        return NULL;
    const struct can_slot *best = NULL;
    uint32_t mailboxes = controller->settings.mailboxes;
    for (uint32_t i = 0; i < controller->count && i < mailboxes; i++)
        if (!best || controller->slots[i].frame.id < best->frame.id)
            best = &controller->slots[i];
    if (now_ns < controller->babble_until_ns && (!best || controller->babble.id <= best->frame.id)) {
        *number = UINT64_MAX;
        return &controller->babble;
    }
    *number = best ? best->number : 0;
    return best ? &best->frame : NULL;
}

void can_clear(struct can_controller *controller) {
    if (controller->on_wire)
        can_wire_abort(controller);
    forget_queue(controller);
}

void can_babble(struct can_controller *controller, const struct can_bits *frame, uint64_t until_ns) {
    controller->babble = *frame;
    controller->babble_until_ns = until_ns;
    can_wire_plan(controller);
}

// ------------------------------------------------------------------------------------------- good frames

void can_controller_sent(struct can_controller *controller) {
    uint64_t number = controller->on_wire;
    controller->on_wire = 0;
    controller->counters.sent++;
    if (controller->tec > 0)
        controller->tec--;
    for (uint32_t i = 0; i < controller->count; i++)
        if (controller->slots[i].number == number) {
            remove_slot(controller, i);
            break;
        }
}

// Flips a bit of the payload, undetected by the checksum.
static void corrupt(struct can_controller *controller, struct can_bits *frame) {
    if (frame->size == 0)
        return;
    uint64_t bit = chance_below(&controller->chance, 8UL * frame->size);
    frame->data[bit / 8] ^= (uint8_t)(1u << bit % 8);
    controller->counters.corrupted++;
}

void can_controller_received(struct can_controller *controller, const struct can_bits *frame) {
    if (controller->rec >= COUNT_PASSIVE)
        controller->rec = REC_AFTER_PASSIVE;
    else if (controller->rec > 0)
        controller->rec--;
    if (chance_happens(&controller->chance, controller->settings.loss)) {
        controller->counters.lost++;
        return;
    }
    struct can_bits seen = *frame;
    if (chance_happens(&controller->chance, controller->settings.corruption))
        corrupt(controller, &seen);
    controller->counters.received++;
    controller->on_frame(controller->owner, &seen);
}

// ------------------------------------------------------------------------------------------------ errors

static void plan_recovery(struct can_controller *controller, uint64_t free_ns) {
    uint64_t wait_ns = can_wire_bits_ns(controller->wire, controller->left * SEQUENCE_BITS);
    agenda_plan(agenda_of(controller), &controller->recovery, free_ns + wait_ns);
}

void can_restart(struct can_controller *controller) {
    if (!controller->off || controller->recovering || !controller->powered)
        return;
    const struct can_segment *segment = &controller->wire->segments[controller->segment];
    uint64_t now = agenda_of(controller)->now_ns;
    controller->recovering = 1;
    controller->left = CAN_RECOVERY_SEQUENCES;
    controller->counts_from_ns = now > segment->free_ns ? now : segment->free_ns;
    // While the bus is busy, sequences are counted as they occur.
    if (segment->phase != CAN_BUSY)
        plan_recovery(controller, controller->counts_from_ns);
}

void can_controller_idle(struct can_controller *controller, uint64_t free_ns, uint64_t start_ns) {
    if (!controller->recovering)
        return;
    uint64_t from_ns = free_ns > controller->counts_from_ns ? free_ns : controller->counts_from_ns;
    uint64_t sequence_ns = can_wire_bits_ns(controller->wire, SEQUENCE_BITS);
    uint64_t seen = start_ns > from_ns ? (start_ns - from_ns) / sequence_ns : 0;
    controller->left -= seen < controller->left ? seen : controller->left;
    agenda_cancel(agenda_of(controller), &controller->recovery);
}

void can_controller_sequence(struct can_controller *controller, uint64_t free_ns) {
    if (!controller->recovering)
        return;
    controller->left -= controller->left > 0;
    controller->counts_from_ns = free_ns;
    plan_recovery(controller, free_ns);
}

// The delay before the recovery is over, or the recovery itself.
static void recovery_due(void *owner) {
    struct can_controller *controller = owner;
    if (!controller->recovering) {
        can_restart(controller);
        return;
    }
    controller->off = controller->recovering = 0;
    controller->tec = controller->rec = 0;
    controller->ready_ns = 0;
    can_wire_plan(controller);
    controller->on_sent(controller->owner); // the owner can use it again
}

static void go_off(struct can_controller *controller) {
    controller->off = 1;
    controller->recovering = 0;
    controller->counters.off++;
    if (controller->settings.drops_when_off)
        forget_queue(controller);
    if (controller->settings.restart_ns != UINT64_MAX)
        agenda_plan(agenda_of(controller), &controller->recovery,
                    agenda_of(controller)->now_ns + controller->settings.restart_ns);
}

void can_controller_send_failed(struct can_controller *controller, uint32_t added) {
    int passive = is_passive(controller);
    controller->on_wire = 0;
    controller->counters.retries++;
    controller->tec = (uint16_t)(controller->tec + added);
    if (is_passive(controller) && !passive)
        controller->counters.passive++;
    if (controller->tec >= TEC_OFF)
        go_off(controller);
}

void can_controller_receive_failed(struct can_controller *controller) {
    int passive = is_passive(controller);
    if (controller->rec < COUNT_PASSIVE)
        controller->rec++;
    if (is_passive(controller) && !passive)
        controller->counters.passive++;
}

// -------------------------------------------------------------------------------------- power and cables

void can_power(struct can_controller *controller, int on) {
    if (!on)
        can_clear(controller);
    else if (!controller->powered)
        controller->joined_ns = agenda_of(controller)->now_ns;
    controller->powered = on != 0;
    controller->off = controller->recovering = 0;
    controller->tec = controller->rec = 0;
    controller->ready_ns = 0;
    controller->babble_until_ns = 0;
    agenda_cancel(agenda_of(controller), &controller->recovery);
}

void can_cut(struct can_controller *controller, uint32_t segment) {
    if (segment == controller->segment)
        return;
    if (controller->on_wire)
        can_wire_abort(controller);
    controller->segment = (uint8_t)segment;
    controller->joined_ns = agenda_of(controller)->now_ns;
    if (controller->recovering) {
        agenda_cancel(agenda_of(controller), &controller->recovery);
        controller->recovering = 0;
        can_restart(controller); // sequences seen on the other wire do not count
    }
    can_wire_plan(controller);
}

int can_wire_join(struct can_wire *wire, struct can_controller *controller) {
    if (wire->count == CAN_CONTROLLERS_MAX || agenda_reserve(wire->agenda, 1))
        return -1;
    controller->slots = calloc(controller->settings.queue, sizeof(controller->slots[0]));
    if (!controller->slots)
        return -1;
    controller->wire = wire;
    controller->recovery = (struct event){.fire = recovery_due, .owner = controller};
    wire->controllers[wire->count++] = controller;
    can_power(controller, 1);
    return 0;
}

void can_controller_free(struct can_controller *controller) {
    free(controller->slots);
    controller->slots = NULL;
}
