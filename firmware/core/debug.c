// SPDX-License-Identifier: Apache-2.0
// Reading and writing of memory by the host, to look for faults: only where the board allows it.
#include "boards/board.h"
#include "core/node.h"

DECL_STATIC_STRING(debug_address, "Debug address not accessible");

DECL_RESPONSE(debug_result, "debug_result val=%u");

enum { ORDER_MAX = 2 }; // 2^order bytes: 1, 2 or 4

// The memory of 2^order bytes at ADDR; null (and a shutdown) where the board gives none, or ADDR is not
// aligned.
static volatile void *memory_at(struct node *node, uint32_t order, uint32_t addr, int write) {
    volatile void *memory = NULL;
    if (order <= ORDER_MAX && addr % (1u << order) == 0)
        memory = board_memory(node, addr, 1u << order, write);
    if (!memory)
        node_shutdown(node, STRING(debug_address));
    return memory;
}

// Each is one access of its width, as registers need.
void command_debug_read(struct node *node, const struct wire_arg *args) {
    uint32_t order = args[0].value, value = 0;
    const volatile void *memory = memory_at(node, order, args[1].value, 0);
    if (!memory)
        return;
    if (order == 0)
        value = *(const volatile uint8_t *)memory;
    else if (order == 1)
        value = *(const volatile uint16_t *)memory;
    else
        value = *(const volatile uint32_t *)memory;
    RESPOND(node, debug_result, INT(value));
}
DECL_COMMAND(command_debug_read, "debug_read order=%c addr=%u", ALLOWED_IN_SHUTDOWN);

void command_debug_write(struct node *node, const struct wire_arg *args) {
    uint32_t order = args[0].value, value = args[2].value;
    volatile void *memory = memory_at(node, order, args[1].value, 1);
    if (!memory)
        return;
    uint32_t irq = board_irq_save(node);
    if (order == 0)
        *(volatile uint8_t *)memory = (uint8_t)value;
    else if (order == 1)
        *(volatile uint16_t *)memory = (uint16_t)value;
    else
        *(volatile uint32_t *)memory = value;
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_debug_write, "debug_write order=%c addr=%u val=%u", ALLOWED_IN_SHUTDOWN);
