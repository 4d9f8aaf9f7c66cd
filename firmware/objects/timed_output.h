// SPDX-License-Identifier: Apache-2.0
// What digital and PWM outputs share: a queue of values with clocks, and the safety net max_duration.
//
// A value other than the default must be followed by another within max_duration ticks (0: no such limit);
// when it is not, the node shuts down, and the shutdown hook of the object sets the default.
#ifndef OBJECTS_TIMED_OUTPUT_H
#define OBJECTS_TIMED_OUTPUT_H

#include "core/node.h"

struct timed_output;

struct timed_output_kind {
    // Sets VALUE at CLOCK; returns true when it is the default, which needs no renewal. Any context.
    bool (*apply)(struct node *node, struct timed_output *output, uint32_t value, uint32_t clock);
    // Optional: makes the level change that is due at CLOCK between two queued values (software PWM) ...
    void (*between)(struct node *node, struct timed_output *output, uint32_t clock);
    const uint16_t *missed, *exceeds; // what a shutdown says
};

struct timed_output {
    struct timer timer; // first: the timer leads back to the object
    const struct timed_output_kind *kind;
    struct move_queue queue;
    uint32_t max_duration, deadline;
    uint32_t between_clock; // ... which the object announces here
    bool has_deadline, has_between;
};

void timed_output_setup(struct timed_output *output, const struct timed_output_kind *kind,
                        uint32_t max_duration);
// Queues VALUE for CLOCK.
void timed_output_queue(struct node *node, struct timed_output *output, uint32_t clock, uint32_t value);
// Sets VALUE now; the queue is empty.
void timed_output_set(struct node *node, struct timed_output *output, uint32_t value);
// For shutdown hooks: gives up the queue.
void timed_output_stop(struct node *node, struct timed_output *output);

#endif
