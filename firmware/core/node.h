// SPDX-License-Identifier: Apache-2.0
// The core of a node: the manual.
//
// A node is one `struct node`. The caller owns it; everything the firmware knows stands in it or hangs off it
// (arena, transport state, board), so one process can hold many. There are no mutable globals.
//
// Contexts. Timers run in interrupt context, in the order of their wake-up clocks, and take microseconds.
// Commands and tasks run one after the other, interrupts on, and may be interrupted by timers and by
// reception. Responses are sent from commands and tasks only; a timer that has something to say wakes a task.
// Data shared with a timer is touched between board_irq_save() and board_irq_restore().
//
// A board does: node_init(), then for ever
//     sched_dispatch() while a timer is due (from its timer interrupt),
//     link_receive() / can_stream_receive() for what arrives (from its receive interrupt),
//     node_run_tasks() while it returns true, then sleep until the next interrupt.
//
// Failing. node_shutdown() stops all timers, runs every shutdown hook (outputs go to their defaults) and
// returns; whoever calls it returns at once. Until clear_shutdown or config_reset only commands declared
// COMMAND_IN_SHUTDOWN are obeyed, the others are answered with is_shutdown.
//
// Memory. Nothing allocates but configuration: objects and the slots of the move queue come from one arena
// that the caller hands over; config_reset empties it.
#ifndef CORE_NODE_H
#define CORE_NODE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "core/declare.h"
#include "wire/wire.h"

struct node;

// --------------------------------------------------------------------------------------------------- clocks

// The one comparison of 32-bit clocks: A is earlier than B. Both lie within 2^31 ticks of each other.
static inline bool clock_before(uint32_t a, uint32_t b) {
    return (int32_t)(a - b) < 0;
}

// --------------------------------------------------------------------------------------------------- timers

enum timer_result { TIMER_DONE, TIMER_RESCHEDULE };

// Owned by whoever embeds it. RUN is called when the clock reaches WAKE_CLOCK; to run again it sets
// WAKE_CLOCK and returns TIMER_RESCHEDULE. It may add and remove any timer, its own included.
struct timer {
    struct timer *next;
    enum timer_result (*run)(struct node *node, struct timer *timer);
    uint32_t wake_clock;
};

// Adds a timer that is not in the list. A wake-up in the past shuts the node down ("Timer too close").
void sched_add_timer(struct node *node, struct timer *timer);
// Removes a timer; does nothing when it is not in the list. Cost: one pass over the timers.
void sched_del_timer(struct node *node, struct timer *timer);
// Runs the earliest timer. A node always has one: the core's own.
void sched_dispatch(struct node *node);
// Forgets all timers (node_init, shutdown and config_reset do).
void sched_reset(struct node *node);

// ---------------------------------------------------------------------------------------------------- tasks

#define WAKE(node, task) node_wake(node, task##_index)
// Any context. INDEX: see WAKE.
void node_wake(struct node *node, uint8_t index);
// Runs each woken task once, in turn. Returns true when some have been woken meanwhile.
bool node_run_tasks(struct node *node);

// ------------------------------------------------------------------------------------------------- messages

struct command {
    void (*run)(struct node *node, const struct wire_arg *args); // NULL: no command has this id
    const uint8_t *types;
    uint8_t count, flags;
};

struct response {
    int16_t id;
    uint8_t count;
    const uint8_t *types;
};

// The most parameters a command or response may have.
enum { MESSAGE_ARGS_MAX = 12 };

#define ARG(number) {.value = (uint32_t)(number), .data = NULL}
#define ARG_BYTES(bytes, length) {.value = (uint32_t)(length), .data = (bytes)}
// Sends the response NAME with one ARG or ARG_BYTES per parameter.
#define RESPOND(node, name, ...)                                                                             \
    node_respond(node, &response_##name, (const struct wire_arg[]){__VA_ARGS__},                             \
                 sizeof((const struct wire_arg[]){__VA_ARGS__}) / sizeof(struct wire_arg))
void node_respond(struct node *node, const struct response *response, const struct wire_arg *args,
                  size_t count);

// Obeys the commands in the content of one block.
void command_dispatch(struct node *node, const uint8_t *content, size_t length);

// ----------------------------------------------------------------------------------------------------- link

enum {
    LINK_RECEIVE_WINDOW = 192, // bytes the host may have in flight; what does not fit is dropped
    LINK_TRANSMIT_ROOM = 2048, // a power of two; holds the answers to a full window of identify commands
};

// How bytes leave: TRANSMIT moves what it can from the transmit buffer (link_peek, link_consume) to the board
// and is called again when more was queued or link_transmit_ready() was called.
struct transport {
    void (*transmit)(struct node *node);
};

struct link {
    uint8_t received[LINK_RECEIVE_WINDOW];
    uint16_t received_size;
    uint8_t expected_seq;
    struct wire_scanner scanner;
    uint8_t transmit[LINK_TRANSMIT_ROOM];
    uint32_t transmit_head, transmit_tail; // free-running; tail - head bytes wait
    // Counters since node_init.
    uint32_t receive_dropped;  // bytes that found the receive buffer full
    uint32_t losses;           // framing and checksum errors
    uint32_t out_of_order;     // sound blocks with an unexpected sequence
    uint32_t blocks;           // blocks obeyed
    uint32_t transmit_dropped; // blocks that found the transmit buffer full
};

// Interrupt context: appends what arrived.
void link_receive(struct node *node, const uint8_t *data, size_t size);
// Interrupt context: the board can take bytes or frames again.
void link_transmit_ready(struct node *node);
// For transports. Copies up to ROOM waiting bytes to OUT; consuming is separate, so a busy board loses none.
size_t link_peek(const struct node *node, uint8_t *out, size_t room);
void link_consume(struct node *node, size_t size);
// Forgets what waits in both directions (a new node id, no node id).
void link_discard(struct node *node);

// --------------------------------------------------------------------------------------------------- memory

// Memory until config_reset, zeroed, aligned for any object. NULL after a shutdown ("alloc_chunk failed").
void *arena_alloc(struct node *node, size_t size);

// The type of an object is the address of its `struct oid_type`; the texts help debuggers only.
struct oid_type {
    const char *name;
};
struct oid_entry {
    const struct oid_type *type;
    void *object;
};
// Allocates the object OID. NULL after a shutdown ("Can't assign oid", "alloc_chunk failed").
void *oid_alloc(struct node *node, uint8_t oid, const struct oid_type *type, size_t size);
// Finds the object OID. NULL after a shutdown ("Invalid oid type").
void *oid_lookup(struct node *node, uint8_t oid, const struct oid_type *type);
// Walks over all objects of a type: start with *oid = 0; NULL at the end. *oid is the object's number + 1.
void *oid_next(struct node *node, const struct oid_type *type, uint16_t *oid);

// One slot of the move queue: what is due later, of any object.
struct move {
    struct move *next;
    union {
        struct {
            uint32_t interval;
            int16_t add;
            uint16_t count;
            uint8_t flags;
        } step;
        struct {
            uint32_t clock, value;
        } output;
    };
};
struct move_queue {
    struct move *first, *last;
};
// Takes a slot. NULL after a shutdown ("Move queue overflow").
struct move *move_alloc(struct node *node);
void move_free(struct node *node, struct move *move);
void move_push(struct move_queue *queue, struct move *move);
struct move *move_pop(struct move_queue *queue);
void move_clear(struct node *node, struct move_queue *queue);

// ----------------------------------------------------------------------------------------------------- node

struct node_config {
    const uint8_t *dictionary; // compressed; NULL: the one generated at build time
    uint32_t dictionary_size;
    uint32_t clock_freq;
    uint8_t *arena; // aligned for pointers
    uint32_t arena_size;
    uint16_t move_count;        // slots wanted; there are fewer when the arena is too small
    uint32_t timer_slack_ticks; // a timer that reschedules itself this far into the past is an error
    uint32_t uptime_high;       // upper half of the 64-bit clock at start
    const struct transport *transport;
    void *transport_state;
    void *board;
};

struct node {
    struct node_config config;

    struct timer *timers;  // sorted, earliest first
    struct timer *running; // popped for its run; NULL when it was removed or added meanwhile
    uint32_t standstill;   // runs in a row that a timer wanted to repeat at the same clock
    uint32_t tasks_woken;  // one bit each

    struct link link;

    uint32_t arena_used;
    struct oid_entry *oids;
    uint16_t oid_count;
    struct move *free_moves;
    uint16_t move_count;

    bool is_configured, is_shutdown;
    uint32_t config_crc;
    uint16_t shutdown_reason;
    uint32_t shutdown_clock;

    // Housekeeping: upper clock half, load figures.
    struct timer housekeeping;
    uint32_t uptime_high, uptime_last;
    uint32_t load_count, load_sum, load_sumsq;
    uint8_t load_periods;
};

// Starts a node, as after power-on. CONFIG is copied; what it points to stays the caller's.
void node_init(struct node *node, const struct node_config *config);
// Any context. REASON is a string_... number. A node that is shut down keeps its first reason.
void node_shutdown(struct node *node, uint16_t reason);
// Empties the arena and forgets the configuration.
void node_reset_config(struct node *node);

#endif
