// SPDX-License-Identifier: Apache-2.0
// What all timed outputs share: a queue of values with their clocks, and the safety net max_duration: a value
// other than the default must be renewed within so many ticks, or the node shuts down.
#ifndef OBJECTS_TIMED_OUTPUT_H
#define OBJECTS_TIMED_OUTPUT_H

#include "core/node.h"

// First member of the object. APPLY drives the pin from CLOCK (now, but for the interrupt's delay) on;
// it runs in interrupt context.
struct timed_output {
    struct timer timer;
    struct move_queue queue;
    void (*apply)(struct node *node, struct timed_output *output, uint32_t clock, uint32_t value);
    uint32_t max_duration; // 0: no limit
    uint32_t default_value;
    uint32_t end_clock;        // when has_end: the value must be renewed by then
    uint16_t missed, exceeded; // texts of the two shutdowns
    uint8_t has_end;
};

// Call after the members above are set (timer and queue zero).
void timed_output_init(struct timed_output *output);
// Queues VALUE for CLOCK. Interrupts must be off.
void timed_output_queue(struct node *node, struct timed_output *output, uint32_t clock, uint32_t value);
// Sets VALUE now; the queue must be empty. Interrupts must be off.
void timed_output_update(struct node *node, struct timed_output *output, uint32_t value);
// Forgets the queue and applies the default value. For shutdown hooks.
void timed_output_stop(struct node *node, struct timed_output *output);

#endif
