// SPDX-License-Identifier: Apache-2.0
// Downloaded tables: see table.h.
//
// A table has three buffers, so that a transmission that fails harms neither the table that is kept nor the
// one in use: the receiver writes to the one that is neither.
#include "objects/table.h"

#include "boards/board.h"
#include "objects/mt.h"
#include "objects/stepper.h"

DECL_CONSTANT("MT_AXLES", 28);
_Static_assert(MT_AXLE_MAX == 28, "the constant above tells the host");

DECL_ENUMERATION("table_status", "ok", 0);
DECL_ENUMERATION("table_status", "transmitting", 1);
DECL_ENUMERATION("table_status", "checksum_error", 2);
DECL_ENUMERATION("table_status", "length_error", 3);
_Static_assert(MT_OK == 0 && MT_TRANSMITTING == 1 && MT_CHECKSUM_ERROR == 2 && MT_LENGTH_ERROR == 3, "above");

// What became of the last table_activate.
enum { NEVER, WAITING, DONE, LATE, MOVING, REPLACED };
DECL_ENUMERATION("table_activation", "never", 0);
DECL_ENUMERATION("table_activation", "waiting", 1);
DECL_ENUMERATION("table_activation", "done", 2);
DECL_ENUMERATION("table_activation", "late", 3);
DECL_ENUMERATION("table_activation", "moving", 4);
DECL_ENUMERATION("table_activation", "replaced", 5);

DECL_STATIC_STRING(invalid_axle, "Not a valid axle or size of a table");

DECL_RESPONSE(table_state,
              "table_state oid=%c table_status=%c generation=%u length=%hu checksum=%u digest=%u words=%u");
DECL_RESPONSE(table_active, "table_active oid=%c table_activation=%c generation=%u length=%hu clock=%u");
DECL_RESPONSE(table_pair, "table_pair oid=%c index=%hu x=%i y=%i");
DECL_RESPONSE(table_found, "table_found axle=%c oid=%c capacity=%hu");

enum { BUFFERS = 3, NO_STEPPER = 255, NO_TABLE = 255, BYTE_GAP_HZ = 10 };

struct table {
    struct timer timer; // of an activation
    struct mt_receiver receiver;
    struct mt_bytes bytes;         // of what comes through the link
    const struct stepper *stepper; // null: none has to stand
    struct mt_pair *buffers[BUFFERS];
    const struct mt_pair *active; // null: none
    uint32_t active_generation, active_length, active_clock;
    uint32_t wanted_generation; // 0: none shall be active
    uint32_t words;             // heard, by whatever way
    uint8_t activation;
};

static const struct oid_type table_type = {"table"};

static struct table *find(struct node *node, uint32_t oid) {
    return oid_find(node, oid, &table_type);
}

// ------------------------------------------------------------------------------------------------- receiving

static void choose_shadow(struct table *table) {
    for (unsigned i = 0; i < BUFFERS; i++)
        if (table->buffers[i] != table->receiver.table && table->buffers[i] != table->active)
            table->receiver.shadow = table->buffers[i];
}

// Interrupts must be off.
static void take_word(struct table *table, uint32_t word) {
    table->words++;
    if (mt_word(&table->receiver, word))
        choose_shadow(table);
}

void table_receive_frame(struct node *node, const uint8_t *data, size_t size) {
    if (node->config.legacy || size % MT_WORD_SIZE)
        return; // not of ours: the checksum finds what is missing
    struct table *table;
    for (unsigned oid = 0; (table = oid_next(node, &oid, &table_type));)
        for (size_t at = 0; at < size; at += MT_WORD_SIZE)
            take_word(table, data[at] | (uint32_t)data[at + 1] << 8 | (uint32_t)data[at + 2] << 16 |
                                 (uint32_t)data[at + 3] << 24);
}

// The stream of bytes that goes over serial lines, in the link's blocks.
void command_table_bytes(struct node *node, const struct wire_arg *args) {
    uint32_t irq = board_irq_save(node);
    struct table *table;
    for (unsigned oid = 0; (table = oid_next(node, &oid, &table_type));)
        for (uint32_t i = 0; i < args[0].value; i++) {
            uint32_t word;
            if (mt_byte(&table->bytes, args[0].data[i], board_clock(node), &word))
                take_word(table, word);
        }
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_table_bytes, "table_bytes data=%*s", 0);

// ------------------------------------------------------------------------------------------------ activation

static uint8_t activate(struct table *table) {
    if (table->stepper && stepper_moves(table->stepper))
        return MOVING;
    if (table->wanted_generation && table->wanted_generation != table->receiver.generation)
        return REPLACED;
    table->active = table->wanted_generation ? table->receiver.table : NULL;
    table->active_length = table->active ? table->receiver.length : 0;
    table->active_generation = table->wanted_generation;
    table->active_clock = table->timer.waketime;
    return DONE;
}

static enum timer_result activation_due(struct node *node, struct timer *timer) {
    struct table *table = (struct table *)timer;
    (void)node;
    table->activation = activate(table);
    return TIMER_DONE;
}

void command_table_activate(struct node *node, const struct wire_arg *args) {
    struct table *table = find(node, args[0].value);
    if (!table)
        return;
    uint32_t irq = board_irq_save(node);
    sched_delete_timer(node, &table->timer);
    table->timer.waketime = args[1].value;
    table->wanted_generation = args[2].value;
    table->activation = LATE;
    if (!clock_before(table->timer.waketime, board_clock(node))) {
        table->activation = WAITING;
        sched_add_timer(node, &table->timer);
    }
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_table_activate, "table_activate oid=%c clock=%u generation=%u", 0);

// What was to come does not: timers are forgotten.
void table_shutdown(struct node *node) {
    struct table *table;
    for (unsigned oid = 0; (table = oid_next(node, &oid, &table_type));)
        if (table->activation == WAITING)
            table->activation = LATE;
}
DECL_SHUTDOWN_HOOK(table_shutdown);

// ------------------------------------------------------------------------------------------------- questions

void command_table_query(struct node *node, const struct wire_arg *args) {
    const struct table *table = find(node, args[0].value);
    if (!table)
        return;
    uint32_t irq = board_irq_save(node);
    struct mt_receiver state = table->receiver;
    uint32_t words = table->words;
    board_irq_restore(node, irq);
    RESPOND(node, table_state, INT(args[0].value), INT(state.status), INT(state.generation),
            INT(state.length), INT(state.checksum), INT(state.digest), INT(words));
}
DECL_COMMAND(command_table_query, "table_query oid=%c", ALLOWED_IN_SHUTDOWN);

void command_table_query_active(struct node *node, const struct wire_arg *args) {
    const struct table *table = find(node, args[0].value);
    if (!table)
        return;
    uint32_t irq = board_irq_save(node);
    uint8_t activation = table->activation;
    uint32_t generation = table->active_generation, length = table->active_length;
    uint32_t clock = table->active_clock;
    board_irq_restore(node, irq);
    RESPOND(node, table_active, INT(args[0].value), INT(activation), INT(generation), INT(length),
            INT(clock));
}
DECL_COMMAND(command_table_query_active, "table_query_active oid=%c", ALLOWED_IN_SHUTDOWN);

// Who sends a table and did not configure the node knows axles, and no oids. Of several the first is told.
void command_table_find(struct node *node, const struct wire_arg *args) {
    const struct table *table;
    uint32_t found = NO_TABLE, capacity = 0;
    for (unsigned oid = 0; (table = oid_next(node, &oid, &table_type));)
        if (table->receiver.axle == args[0].value) {
            found = oid - 1;
            capacity = table->receiver.capacity;
            break;
        }
    RESPOND(node, table_found, INT(args[0].value), INT(found), INT(capacity));
}
DECL_COMMAND(command_table_find, "table_find axle=%c", ALLOWED_IN_SHUTDOWN);

// A pair of the table that is kept; zeros beyond its end.
void command_table_read(struct node *node, const struct wire_arg *args) {
    const struct table *table = find(node, args[0].value);
    if (!table)
        return;
    uint32_t irq = board_irq_save(node);
    struct mt_pair pair = {0, 0};
    if (args[1].value < table->receiver.length)
        pair = table->receiver.table[args[1].value];
    board_irq_restore(node, irq);
    RESPOND(node, table_pair, INT(args[0].value), INT(args[1].value), INT(pair.x), INT(pair.y));
}
DECL_COMMAND(command_table_read, "table_read oid=%c index=%hu", ALLOWED_IN_SHUTDOWN);

// --------------------------------------------------------------------------------------------- configuration

void command_config_table(struct node *node, const struct wire_arg *args) {
    uint32_t axle = args[1].value, capacity = args[2].value, stepper_oid = args[3].value;
    if (axle < MT_AXLE_MIN || axle > MT_AXLE_MAX || !capacity) {
        node_shutdown(node, STRING(invalid_axle));
        return;
    }
    const struct stepper *stepper = NULL;
    if (stepper_oid != NO_STEPPER && !(stepper = stepper_find(node, stepper_oid)))
        return;
    struct mt_pair *pairs = node_alloc(node, (size_t)BUFFERS * capacity * sizeof(*pairs));
    if (!pairs)
        return;
    struct table *table = oid_create(node, args[0].value, &table_type, sizeof(*table));
    if (!table)
        return;
    uint32_t irq = board_irq_save(node);
    for (unsigned i = 0; i < BUFFERS; i++)
        table->buffers[i] = pairs + (size_t)i * capacity;
    mt_start(&table->receiver, (uint8_t)axle, table->buffers[0], table->buffers[1], capacity);
    table->bytes.gap = node->config.clock_freq / BYTE_GAP_HZ;
    table->stepper = stepper;
    table->timer.function = activation_due;
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_config_table, "config_table oid=%c axle=%c capacity=%hu stepper_oid=%c", 0);
