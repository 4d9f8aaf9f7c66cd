// SPDX-License-Identifier: Apache-2.0
// A register through which MT's words come one at a time, as old drives have it: it is polled, and only a
// change of it is a word. Whoever writes it waits at least one rest between two words.
#include "boards/board.h"
#include "objects/mt.h"
#include "objects/table.h"

enum { BYTE_BITS = 8 };

struct table_register {
    struct timer timer;
    struct mt_register poll;
    uint32_t value, rest_ticks;
};

static const struct oid_type register_type = {"table_register"};

static enum timer_result poll_due(struct node *node, struct timer *timer) {
    struct table_register *reg = (struct table_register *)timer;
    if (mt_poll(&reg->poll, reg->value)) {
        uint8_t data[MT_WORD_SIZE];
        for (unsigned i = 0; i < MT_WORD_SIZE; i++)
            data[i] = (uint8_t)(reg->value >> (BYTE_BITS * i));
        table_receive_frame(node, data, sizeof(data));
    }
    timer->waketime += reg->rest_ticks;
    return TIMER_AGAIN;
}

void command_config_table_register(struct node *node, const struct wire_arg *args) {
    struct table_register *reg = oid_create(node, args[0].value, &register_type, sizeof(*reg));
    if (reg)
        reg->timer.function = poll_due;
}
DECL_COMMAND(command_config_table_register, "config_table_register oid=%c", 0);

// Polls from CLOCK on, every REST_TICKS; 0: no longer.
void command_table_register_poll(struct node *node, const struct wire_arg *args) {
    struct table_register *reg = oid_find(node, args[0].value, &register_type);
    if (!reg)
        return;
    uint32_t irq = board_irq_save(node);
    sched_delete_timer(node, &reg->timer);
    reg->timer.waketime = args[1].value;
    reg->rest_ticks = args[2].value;
    reg->poll = (struct mt_register){0};
    if (reg->rest_ticks)
        sched_add_timer(node, &reg->timer);
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_table_register_poll, "table_register_poll oid=%c clock=%u rest_ticks=%u", 0);

void command_table_register_write(struct node *node, const struct wire_arg *args) {
    struct table_register *reg = oid_find(node, args[0].value, &register_type);
    if (reg)
        reg->value = args[1].value;
}
DECL_COMMAND(command_table_register_write, "table_register_write oid=%c value=%u", 0);
