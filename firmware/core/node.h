// SPDX-License-Identifier: Apache-2.0
// The core of a node: scheduler, commands, configuration. This header is its manual.
//
// A node is one struct node that the board owns; nothing here allocates or keeps state elsewhere, so a
// process may hold as many nodes as it likes. Chip-free: whatever touches hardware goes through
// boards/board.h.
//
// Contexts. Timers and shutdown hooks run "in interrupt context": short, never answering the host. Tasks and
// command handlers run from node_run_tasks(); only they may RESPOND. What both touch is touched by tasks and
// commands between board_irq_save() and board_irq_restore().
//
// A board's loop, in words: take input from the wire (can_stream_receive, or node_receive for a UART); while
// a timer is due, sched_run_first(); node_run_tasks(); sleep until node_next_deadline() or input.
#ifndef CORE_NODE_H
#define CORE_NODE_H

#include "core/declare.h"
#include "wire/wire.h"

#include <stddef.h>
#include <stdint.h>

struct node;

// ------------------------------------------------------------------------------------------------------ time

// Is clock A before clock B? The one way to compare clocks: right over the 32-bit rollover, as long as both
// lie within 2^31 ticks of each other.
static inline int clock_before(uint32_t a, uint32_t b) {
    return (int32_t)(a - b) < 0;
}

// ---------------------------------------------------------------------------------------------------- timers

enum timer_result { TIMER_DONE, TIMER_AGAIN };

// The owner embeds a timer in its own struct; FUNCTION runs at WAKETIME in interrupt context and either is
// done or has set a later (or equal) waketime. Timers of equal waketime run in the order they were added.
struct timer {
    struct timer *next;
    enum timer_result (*function)(struct node *node, struct timer *timer);
    uint32_t waketime;
};

// Queues TIMER (not queued yet). A waketime in the past shuts the node down with "Timer too close"; while the
// node is shut down nothing is queued. Interrupts must be off.
void sched_add_timer(struct node *node, struct timer *timer);
// Queues TIMER (not queued yet) for TICKS from now. Never too close: with interrupts off nothing comes
// between on a chip, and on a board that may be kept waiting it is late. Interrupts must be off.
void sched_add_timer_in(struct node *node, struct timer *timer, uint32_t ticks);
// Removes TIMER; nothing happens when it is not queued. Interrupts must be off.
void sched_delete_timer(struct node *node, struct timer *timer);
// Runs the first timer, which must exist and be due. A waketime set further back than the config's slack
// shuts the node down with "Rescheduled timer in the past".
void sched_run_first(struct node *node);

// -------------------------------------------------------------------------------------------------- shutdown

// Stops everything: forgets all timers, runs the hooks (outputs go to their defaults) and reports the text
// REASON (STRING(...)). From any context; the caller returns at once afterwards. The first reason counts.
void node_shutdown(struct node *node, uint16_t reason);

// -------------------------------------------------------------------------------------------------- messages

enum { NODE_ARGS_MAX = 12 };

struct node_command {
    void (*handler)(struct node *node, const struct wire_arg *args);
    const uint8_t *types;
    uint8_t arg_count, flags;
};

struct node_response {
    const uint8_t *types;
    int16_t id;
    uint8_t arg_count;
};

// Sends a response to the host. Returns 0, or -1 when it was dropped (counted in tx_dropped) because the
// bounded transmit buffer is full. Commands start only when a whole response fits, so one response per
// command always goes out; tasks with something that must not get lost ask node_can_respond() first.
int node_respond(struct node *node, const struct node_response *response, const struct wire_arg *args,
                 size_t count);
int node_can_respond(const struct node *node);

#define INT(number)                                                                                          \
    (struct wire_arg) {                                                                                      \
        .value = (uint32_t)(number)                                                                          \
    }
#define BYTES(bytes, size)                                                                                   \
    (struct wire_arg) {                                                                                      \
        .value = (uint32_t)(size), .data = (bytes)                                                           \
    }
#define RESPOND(node, symbol, ...)                                                                           \
    node_respond(node, &response_##symbol, (const struct wire_arg[]){__VA_ARGS__},                           \
                 sizeof((const struct wire_arg[]){__VA_ARGS__}) / sizeof(struct wire_arg))
#define RESPOND_EMPTY(node, symbol) node_respond(node, &response_##symbol, NULL, 0)

// ---------------------------------------------------------------------------------------------------- tables

// What tools/gen_dictionary.py makes of the declarations of a build. Commands are indexed by id; a slot
// without handler is not in use.
struct node_tables {
    const struct node_command *commands;
    void (*const *tasks)(struct node *node);
    void (*const *inits)(struct node *node);
    void (*const *hooks)(struct node *node);
    const uint8_t *dictionary; // zlib-compressed JSON
    uint32_t dictionary_size;
    uint16_t command_count, task_count, init_count, hook_count;
};
extern const struct node_tables node_tables;

// ----------------------------------------------------------------------------------------------------- state

enum {
    NODE_RECEIVE_WINDOW = 192, // bytes the host may have unacknowledged in flight
    NODE_TRANSMIT_SIZE = 512,  // bytes of answers waiting for the wire; a power of two
    NODE_UUID_SIZE = 6,
    NODE_STATS_SECONDS = 5, // between two stats reports; in ticks less than 2^31
    NODE_MOVE_SIZE = 24,    // largest record in a slot of the move queue
};

// What the board decides before node_start(); the node keeps a copy.
struct node_config {
    uint32_t clock_freq;  // ticks per second
    uint32_t timer_slack; // ticks by which a timer may be rescheduled behind the clock
    uint32_t clock_high;  // upper half of the 64-bit clock at start, for get_uptime
    uint16_t move_count;  // slots of the move queue
    uint8_t uuid[NODE_UUID_SIZE];
    void *arena; // memory for configured objects and the move queue, aligned for any type
    size_t arena_size;
    const uint8_t *dictionary; // what identify gives, zlib-compressed; null: that of node_tables
    uint32_t dictionary_size;
    uint8_t legacy; // 1: behave as firmware without this project's CAN extensions (core/bus_signals.h)
};

struct oid_slot {
    const struct oid_type *type;
    void *object;
};

struct move {
    struct move *next;
};

// First in, first out; zero-initialised is empty.
struct move_queue {
    struct move *first, *last;
};

struct node_stats {
    uint32_t rx_overflow_bytes; // did not fit into the receive buffer
    uint32_t rx_lost;           // damaged stretches
    uint32_t rx_out_of_order;   // sound blocks with another sequence number than the expected one
    uint32_t rx_blocks;
    uint32_t tx_dropped; // responses
    uint32_t timers_run;
};

struct node {
    struct node_config config;
    struct can_stream *can; // set by net/can_stream; null on a node without CAN
    struct node_stats stats;
    uint8_t tasks_pending; // something waits for node_run_tasks()

    struct {
        struct timer *first;
        uint32_t last_clock, run_at_once; // timers run since the clock last moved
    } sched;
    struct {
        uint8_t active, reported;
        uint16_t reason;
        uint32_t clock;
    } shutdown;
    struct {
        uint8_t buffer[NODE_RECEIVE_WINDOW];
        uint16_t size;              // bytes in buffer
        uint8_t block_size;         // of the accepted block at the front that is being executed; 0: none
        uint8_t block_at;           // its next command
        uint8_t expected;           // sequence number, 4 bits
        uint16_t accepted_checksum; // of the last accepted block
        uint32_t accepted_clock;
        struct wire_scanner scanner;
    } rx;
    struct {
        uint8_t buffer[NODE_TRANSMIT_SIZE];
        uint16_t head, tail; // free-running; head - tail bytes are waiting
    } tx;
    struct {
        size_t arena_used;
        struct oid_slot *oids;
        struct move *free_moves;
        uint32_t crc;
        uint16_t move_count;
        uint8_t oid_count, oids_allocated, finalized;
        uint8_t stops_bus; // a shutdown is told to the whole bus (core/bus_signals.h)
    } objects;
    struct {
        uint32_t clock;
        uint8_t set;
    } alarm;
    struct {
        uint32_t last_clock, clock_high; // 64-bit uptime
        uint32_t report_clock, count, sum, sumsq;
        uint8_t starting; // "starting" still has to be said
    } base;
};

// ------------------------------------------------------------------------------------------ for boards and
// nets

// Starts (or restarts) NODE: everything in it is set anew; node->can is left to the board.
void node_start(struct node *node, const struct node_config *config);
// Runs every task once, and again while one left something pending.
void node_run_tasks(struct node *node);
// From any context: node_run_tasks() has something to do.
static inline void node_wake_tasks(struct node *node) {
    node->tasks_pending = 1;
}
// Tasks are to run at CLOCK, which may be now. There is one such alarm, the link's. Unlike a timer it
// outlives a shutdown and a config_reset, since a node that is shut down still has to be found on its bus.
static inline void node_set_alarm(struct node *node, uint32_t clock) {
    node->alarm.clock = clock;
    node->alarm.set = 1;
}
// The clock at which the node next wants to be called without input.
uint32_t node_next_deadline(const struct node *node);

// Appends bytes from the host; what does not fit is dropped and counted. Interrupt context allowed.
void node_receive(struct node *node, const uint8_t *data, size_t size);
// Copies up to SIZE bytes waiting for the host to OUT; returns how many. They leave with node_transmitted().
size_t node_transmit_peek(const struct node *node, uint8_t *out, size_t size);
void node_transmitted(struct node *node, size_t size);

// ------------------------------------------------------------------------------------------------- for
// objects

// A kind of configured object; its address tells kinds apart.
struct oid_type {
    const char *name;
};

// Makes object OID of SIZE zeroed bytes. Null (and a shutdown) when the oid is unusable or memory is out.
void *oid_create(struct node *node, uint32_t oid, const struct oid_type *type, size_t size);
// Object OID; null (and a shutdown, "Invalid oid type") when it is of another type or does not exist.
void *oid_find(struct node *node, uint32_t oid, const struct oid_type *type);
// The next object of TYPE from *OID on, which moves behind it; null at the end. Start with *oid = 0.
void *oid_next(const struct node *node, unsigned *oid, const struct oid_type *type);
// SIZE zeroed bytes until the next config_reset; null (and a shutdown) when there are none.
void *node_alloc(struct node *node, size_t size);

// A slot of the move queue shared by steppers and timed outputs: at most NODE_MOVE_SIZE bytes, uninitialised.
// Null (and a shutdown, "Move queue overflow") when none is free. Interrupts must be off.
void *move_alloc(struct node *node);
void move_free(struct node *node, void *move);
static inline int move_queue_push(struct move_queue *queue, struct move *move) {
    int was_empty = queue->first == NULL;
    move->next = NULL;
    if (was_empty)
        queue->first = move;
    else
        queue->last->next = move;
    queue->last = move;
    return was_empty;
}
static inline struct move *move_queue_pop(struct move_queue *queue) {
    struct move *move = queue->first;
    if (move)
        queue->first = move->next;
    return move;
}
void move_queue_clear(struct node *node, struct move_queue *queue);

// --------------------------------------------------------------------------------------------- within the
// core

void node_forget_objects(struct node *node);

#endif
