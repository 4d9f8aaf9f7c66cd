// SPDX-License-Identifier: Apache-2.0
// Signals from node to node, past the host: emergency stop of the whole bus, triggers of stop groups, and the
// pulse at which all nodes latch their clocks. They act in the receive interrupt and leave from interrupt
// context; with ids below CAN_ID_URGENT_END they win against all data.
//
//   id 0x010         reason, origin's id and clock   receivers shut down, and do not pass it on
//   id 0x020 + group group, reason, origin's clock   every armed trsync of that group triggers
//   admin 0x40       sequence number 1..255          every node latches its clock
//
// Nothing is sent unless the host asked for it (set_bus_stop, trsync_set_group); a node with config.legacy
// neither sends nor hears any of it. On a UART there is nobody to signal to.
#ifndef CORE_BUS_SIGNALS_H
#define CORE_BUS_SIGNALS_H

#include <stddef.h>
#include <stdint.h>

struct node;

enum { TRIGGER_GROUPS = 16, TRIGGER_GROUP_NONE = 255 };

// Part of struct can_stream. Frames which the board refused wait here for the next task.
struct bus_signals {
    struct {
        uint8_t reason;
        uint32_t clock;
    } triggers[TRIGGER_GROUPS];
    uint16_t triggers_waiting; // a bit for each group
    uint8_t stop_waiting, stop_reason, stop_origin;
    uint8_t pulse_seq; // 0: there was none yet
    uint32_t stop_clock, pulse_clock;
};

// A frame with an urgent id came. Interrupt context.
void bus_signals_receive(struct node *node, uint32_t id, const uint8_t *data, size_t size);
// SYNC_PULSE came, with all its bytes. Interrupt context.
void bus_signals_pulse(struct node *node, const uint8_t *data, size_t size);
// Tells the bus that GROUP (below TRIGGER_GROUPS) triggered here at CLOCK. Interrupts must be off.
void bus_signals_trigger(struct node *node, uint8_t group, uint8_t reason, uint32_t clock);
// A new round begins: a trigger of GROUP that still waits would end it at once. Interrupts must be off.
void bus_signals_forget_trigger(struct node *node, uint8_t group);
// Offers the board again what it refused; returns whether something still waits. From tasks.
int bus_signals_flush(struct node *node);

#endif
