// SPDX-License-Identifier: Apache-2.0
// The node's end of the link: blocks come in, are checked, acknowledged and executed; answers go out.
//
// A sound block with the expected sequence number is accepted: the expected number moves on, its commands
// run, and an empty block with the new number acknowledges it. Everything else is dropped and answered by an
// empty block with the unchanged number, which the host takes as "not this one". Each answer carries the
// number too.
//
// A host repeats a block byte by byte. A repeat that differs from the block it would be a repeat of shows
// that another host has sent that one, and that the commands in this one would be lost: the node shuts down.
// Only a host that has just begun may take a number by chance; it begins after a pause.
//
// Back-pressure: a command only starts while the transmit buffer has room for a response. Otherwise its block
// waits, half executed, until bytes have left; new bytes gather in the receive buffer, whose size the host
// knows.
#include "boards/board.h"
#include "core/node.h"

#include <string.h>

DECL_CONSTANT("RECEIVE_WINDOW", 192);

DECL_STATIC_STRING(invalid_command, "Invalid command");
DECL_STATIC_STRING(parser_error, "Command parser error");
DECL_STATIC_STRING(encode_error, "Message encode error");
DECL_STATIC_STRING(second_host, "Another host sends to this node");

DECL_RESPONSE(is_shutdown, "is_shutdown static_string_id=%hu");

enum { REPEATS_PER_SECOND = 10 }; // at least: a block that comes later is not taken for a repeat

_Static_assert(NODE_RECEIVE_WINDOW == 192, "the constant above tells the host");
_Static_assert((NODE_TRANSMIT_SIZE & (NODE_TRANSMIT_SIZE - 1)) == 0, "the ring is indexed by a mask");

// ------------------------------------------------------------------------------------------------- answering

static size_t tx_room(const struct node *node) {
    return NODE_TRANSMIT_SIZE - (uint16_t)(node->tx.head - node->tx.tail);
}

int node_can_respond(const struct node *node) {
    // One block for the response and one for the acknowledgement behind it.
    return tx_room(node) >= WIRE_BLOCK_MAX + WIRE_BLOCK_MIN;
}

// Frames CONTENT_SIZE bytes standing at block + WIRE_HEADER and queues the block.
static int queue_block(struct node *node, uint8_t *block, size_t content_size) {
    size_t size = wire_block_finish(block, content_size, node->rx.expected);
    if (size > tx_room(node)) {
        node->stats.tx_dropped++;
        return -1;
    }
    for (size_t i = 0; i < size; i++)
        node->tx.buffer[node->tx.head++ & (NODE_TRANSMIT_SIZE - 1)] = block[i];
    node_wake_tasks(node); // the link offers it to the board
    return 0;
}

int node_respond(struct node *node, const struct node_response *response, const struct wire_arg *args,
                 size_t count) {
    uint8_t block[WIRE_BLOCK_MAX];
    uint8_t *content = block + WIRE_HEADER;
    size_t size = wire_vlq_encode(content, response->id);
    size_t packed = 0;
    if (count == response->arg_count)
        packed = wire_pack(response->types, count, args, content + size, WIRE_CONTENT_MAX - size);
    if (count != response->arg_count || (count && !packed)) {
        node_shutdown(node, STRING(encode_error));
        return -1;
    }
    return queue_block(node, block, size + packed);
}

static void acknowledge(struct node *node) {
    uint8_t block[WIRE_BLOCK_MIN];
    queue_block(node, block, 0);
}

size_t node_transmit_peek(const struct node *node, uint8_t *out, size_t size) {
    size_t waiting = (uint16_t)(node->tx.head - node->tx.tail);
    if (size > waiting)
        size = waiting;
    for (size_t i = 0; i < size; i++)
        out[i] = node->tx.buffer[(node->tx.tail + i) & (NODE_TRANSMIT_SIZE - 1)];
    return size;
}

void node_transmitted(struct node *node, size_t size) {
    node->tx.tail = (uint16_t)(node->tx.tail + size);
    node_wake_tasks(node); // someone may wait for the room
}

// ------------------------------------------------------------------------------------------------- receiving

void node_receive(struct node *node, const uint8_t *data, size_t size) {
    size_t room = sizeof(node->rx.buffer) - node->rx.size;
    if (size > room) {
        node->stats.rx_overflow_bytes += (uint32_t)(size - room);
        size = room;
    }
    if (size)
        memcpy(node->rx.buffer + node->rx.size, data, size);
    node->rx.size = (uint16_t)(node->rx.size + size);
    node_wake_tasks(node);
}

static void consume(struct node *node, size_t size) {
    uint32_t irq = board_irq_save(node);
    node->rx.size = (uint16_t)(node->rx.size - size);
    memmove(node->rx.buffer, node->rx.buffer + size, node->rx.size);
    board_irq_restore(node, irq);
}

static const struct node_command *command_of(uint32_t id) {
    if (id >= node_tables.command_count || !node_tables.commands[id].handler)
        return NULL;
    return &node_tables.commands[id];
}

// Executes the command at AT; returns where the next one begins, or END after an unreadable one.
static const uint8_t *execute(struct node *node, const uint8_t *at, const uint8_t *end) {
    struct wire_arg args[NODE_ARGS_MAX];
    uint32_t id = 0;
    const struct node_command *command = wire_vlq_decode(&at, end, &id) ? NULL : command_of(id);
    if (!command) {
        node_shutdown(node, STRING(invalid_command));
        return end;
    }
    if (wire_unpack(command->types, command->arg_count, &at, end, args)) {
        node_shutdown(node, STRING(parser_error));
        return end;
    }
    if (node->shutdown.active && !(command->flags & ALLOWED_IN_SHUTDOWN))
        RESPOND(node, is_shutdown, INT(node->shutdown.reason));
    else
        command->handler(node, args);
    return at;
}

// Goes on with the accepted block at the front. Returns 0 when it has to wait for room to answer.
static int execute_block(struct node *node) {
    const uint8_t *block = node->rx.buffer;
    const uint8_t *end = block + node->rx.block_size - WIRE_TRAILER;
    while (block + node->rx.block_at < end) {
        if (!node_can_respond(node))
            return 0;
        const uint8_t *next = execute(node, block + node->rx.block_at, end);
        node->rx.block_at = (uint8_t)(next - block);
    }
    if (!node_can_respond(node))
        return 0;
    acknowledge(node);
    consume(node, node->rx.block_size);
    node->rx.block_size = 0;
    return 1;
}

static uint16_t checksum_of(const uint8_t *block, size_t size) {
    return (uint16_t)(block[size - WIRE_TRAILER] << 8 | block[size - WIRE_TRAILER + 1]);
}

// Is the sound block at the front, of the last accepted block's number, another one than that? An empty block
// loses nothing.
static int contradicts(const struct node *node, size_t size, uint32_t now) {
    return size > WIRE_BLOCK_MIN && node->objects.finalized && !node->config.legacy &&
           now - node->rx.accepted_clock < node->config.clock_freq / REPEATS_PER_SECOND &&
           checksum_of(node->rx.buffer, size) != node->rx.accepted_checksum;
}

static void judge_block(struct node *node, size_t size) {
    uint8_t number = node->rx.buffer[1] & WIRE_SEQ_MASK;
    uint32_t now = board_clock(node);
    if (number != node->rx.expected) {
        node->stats.rx_out_of_order++;
        if (number == ((node->rx.expected - 1) & WIRE_SEQ_MASK) && contradicts(node, size, now))
            node_shutdown(node, STRING(second_host));
        acknowledge(node);
        consume(node, size);
        return;
    }
    node->stats.rx_blocks++;
    node->rx.accepted_checksum = checksum_of(node->rx.buffer, size);
    node->rx.accepted_clock = now;
    node->rx.expected = (node->rx.expected + 1) & WIRE_SEQ_MASK;
    node->rx.block_size = (uint8_t)size;
    node->rx.block_at = WIRE_HEADER;
}

void command_task(struct node *node) {
    for (;;) {
        if (node->rx.block_size && !execute_block(node))
            return;
        if (!node_can_respond(node))
            return;
        size_t skip, size;
        enum wire_scan found = wire_scan(&node->rx.scanner, node->rx.buffer, node->rx.size, &skip, &size);
        if (skip)
            consume(node, skip);
        if (found == WIRE_MORE)
            return;
        if (found == WIRE_BLOCK) {
            judge_block(node, size);
        } else {
            node->stats.rx_lost++;
            acknowledge(node);
        }
    }
}
DECL_TASK(command_task);
