// SPDX-License-Identifier: Apache-2.0
// Signals from node to node: see bus_signals.h.
#include "core/bus_signals.h"

#include "boards/board.h"
#include "net/can_stream.h"
#include "objects/trsync.h"

DECL_CONSTANT("CAN_BUS_STOP", 1);
DECL_CONSTANT("CAN_SYNC_PULSE", 1);
DECL_CONSTANT("CAN_TRIGGER_GROUPS", 16);
_Static_assert(TRIGGER_GROUPS == 16, "the constant above tells the host");

DECL_STATIC_STRING(bus_stop, "Bus-wide emergency stop");
DECL_STATIC_STRING(command_request, "Command request");

DECL_RESPONSE(sync_pulse, "sync_pulse seq=%c clock=%u");

enum { ID_STOP = 0x010, ID_TRIGGER = 0x020 };
enum { SIGNAL_SIZE = 6, PULSE_SIZE = 2 };

// ------------------------------------------------------------------------------------------------- receiving

void bus_signals_receive(struct node *node, uint32_t id, const uint8_t *data, size_t size) {
    if (node->config.legacy)
        return;
    // The stop is obeyed whatever the frame carries: reason and origin are for whoever looks on.
    if (id == ID_STOP)
        node_shutdown(node, STRING(bus_stop));
    else if (id - ID_TRIGGER < TRIGGER_GROUPS && size >= SIGNAL_SIZE && data[0] == id - ID_TRIGGER)
        trsync_trigger_group(node, data[0], data[1]);
}

// A pulse may come twice: when a receiver finds the very end of a frame damaged, the sender repeats it, and
// nodes that had nothing to complain of have then heard both. All hear the last one, so it is the one to
// keep.
void bus_signals_pulse(struct node *node, const uint8_t *data, size_t size) {
    if (node->config.legacy || size < PULSE_SIZE || !data[1])
        return;
    node->can->signals.pulse_clock = board_clock(node);
    node->can->signals.pulse_seq = data[1];
}

// --------------------------------------------------------------------------------------------------- sending

// Two bytes and a clock.
static int send_signal(struct node *node, uint32_t id, uint8_t first, uint8_t second, uint32_t clock) {
    const uint8_t data[SIGNAL_SIZE] = {
        first, second, (uint8_t)clock, (uint8_t)(clock >> 8), (uint8_t)(clock >> 16), (uint8_t)(clock >> 24),
    };
    return board_can_send(node, id, data, sizeof(data));
}

static int send_stop(struct node *node) {
    const struct bus_signals *signals = &node->can->signals;
    return send_signal(node, ID_STOP, signals->stop_reason, signals->stop_origin, signals->stop_clock);
}

static int send_trigger(struct node *node, uint8_t group) {
    const struct bus_signals *signals = &node->can->signals;
    return send_signal(node, (uint32_t)ID_TRIGGER + group, group, signals->triggers[group].reason,
                       signals->triggers[group].clock);
}

void bus_signals_trigger(struct node *node, uint8_t group, uint8_t reason, uint32_t clock) {
    if (!node->can || node->config.legacy)
        return;
    struct bus_signals *signals = &node->can->signals;
    signals->triggers[group].reason = reason;
    signals->triggers[group].clock = clock;
    if (send_trigger(node, group))
        signals->triggers_waiting |= (uint16_t)(1u << group);
}

void bus_signals_forget_trigger(struct node *node, uint8_t group) {
    if (node->can)
        node->can->signals.triggers_waiting &= (uint16_t)~(1u << group);
}

int bus_signals_flush(struct node *node) {
    struct bus_signals *signals = &node->can->signals;
    uint32_t irq = board_irq_save(node);
    // A stop that was cleared meanwhile must not come after all.
    if (signals->stop_waiting && (!node->shutdown.active || send_stop(node) == 0))
        signals->stop_waiting = 0;
    for (uint8_t group = 0; group < TRIGGER_GROUPS && !signals->stop_waiting; group++) {
        uint16_t bit = (uint16_t)(1u << group);
        if ((signals->triggers_waiting & bit) && send_trigger(node, group) == 0)
            signals->triggers_waiting &= (uint16_t)~bit;
    }
    int waiting = signals->stop_waiting || signals->triggers_waiting;
    board_irq_restore(node, irq);
    return waiting;
}

// The host's own emergency_stop is no reason to stop others: the host stops whom it wants to stop.
void bus_signals_shutdown(struct node *node) {
    uint16_t reason = node->shutdown.reason;
    if (!node->shutdown.active || !node->objects.stops_bus || !node->can || node->config.legacy)
        return;
    if (reason == STRING(bus_stop) || reason == STRING(command_request))
        return;
    struct bus_signals *signals = &node->can->signals;
    signals->stop_reason = reason > UINT8_MAX ? 0 : (uint8_t)reason;
    signals->stop_origin = node->can->node_id;
    signals->stop_clock = node->shutdown.clock;
    signals->stop_waiting = send_stop(node) != 0;
}
DECL_SHUTDOWN_HOOK(bus_signals_shutdown);

// -------------------------------------------------------------------------------------------------- commands

void command_set_bus_stop(struct node *node, const struct wire_arg *args) {
    node->objects.stops_bus = args[0].value != 0;
}
DECL_COMMAND(command_set_bus_stop, "set_bus_stop enable=%c", 0);

void command_get_sync_pulse(struct node *node, const struct wire_arg *args) {
    (void)args;
    uint8_t seq = 0;
    uint32_t clock = 0;
    if (node->can) {
        uint32_t irq = board_irq_save(node);
        seq = node->can->signals.pulse_seq;
        clock = node->can->signals.pulse_clock;
        board_irq_restore(node, irq);
    }
    RESPOND(node, sync_pulse, INT(seq), INT(clock));
}
DECL_COMMAND(command_get_sync_pulse, "get_sync_pulse", ALLOWED_IN_SHUTDOWN | FREQUENT);
