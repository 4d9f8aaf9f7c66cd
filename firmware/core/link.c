// SPDX-License-Identifier: Apache-2.0
// The node's end of the link: obeys each block once and in order, acknowledges, naks.
#include "core/link.h"

#include <string.h>

#include "boards/board.h"

DECL_CONSTANT("RECEIVE_WINDOW", 192);
_Static_assert(LINK_RECEIVE_WINDOW == 192, "the constant above is what the host may have in flight");

// ------------------------------------------------------------------------------------------------- transmit

DECL_TASK(link_receive_task);
DECL_TASK(link_transmit_task); // after reception: an answer and its ack leave in the same frames
void link_transmit_task(struct node *node) {
    node->config.transport->transmit(node);
}

void link_send(struct node *node, uint8_t *block, size_t content_length) {
    struct link *link = &node->link;
    size_t length = wire_block_finish(block, content_length, link->expected_seq);
    if (length > LINK_TRANSMIT_ROOM - (link->transmit_tail - link->transmit_head)) {
        link->transmit_dropped++;
        return;
    }
    for (size_t i = 0; i < length; i++)
        link->transmit[link->transmit_tail++ % LINK_TRANSMIT_ROOM] = block[i];
    WAKE(node, link_transmit_task);
}

void link_transmit_ready(struct node *node) {
    WAKE(node, link_transmit_task);
}

size_t link_peek(const struct node *node, uint8_t *out, size_t room) {
    const struct link *link = &node->link;
    size_t size = link->transmit_tail - link->transmit_head;
    if (size > room)
        size = room;
    for (size_t i = 0; i < size; i++)
        out[i] = link->transmit[(link->transmit_head + i) % LINK_TRANSMIT_ROOM];
    return size;
}

void link_consume(struct node *node, size_t size) {
    node->link.transmit_head += (uint32_t)size;
}

void link_discard(struct node *node) {
    uint32_t irq = board_irq_save(node);
    node->link.transmit_head = node->link.transmit_tail;
    node->link.received_size = 0;
    node->link.scanner = (struct wire_scanner){0};
    board_irq_restore(node, irq);
}

// -------------------------------------------------------------------------------------------------- receive

void link_receive(struct node *node, const uint8_t *data, size_t size) {
    struct link *link = &node->link;
    size_t room = sizeof(link->received) - link->received_size;
    size_t taken = size < room ? size : room;
    memcpy(link->received + link->received_size, data, taken);
    link->received_size = (uint16_t)(link->received_size + taken);
    link->receive_dropped += (uint32_t)(size - taken);
    WAKE(node, link_receive_task);
}

static void acknowledge(struct node *node) {
    uint8_t block[WIRE_BLOCK_MIN];
    link_send(node, block, 0);
}

static void accept(struct node *node, const uint8_t *block, size_t length) {
    struct link *link = &node->link;
    if ((block[1] & WIRE_SEQ_MASK) == link->expected_seq) {
        link->blocks++;
        link->expected_seq = (link->expected_seq + 1) & WIRE_SEQ_MASK;
        command_dispatch(node, block + WIRE_HEADER, length - WIRE_BLOCK_MIN);
    } else {
        link->out_of_order++;
    }
    acknowledge(node);
}

// Drops the first SIZE received bytes; an interrupt may append meanwhile.
static void drop_received(struct node *node, size_t size) {
    struct link *link = &node->link;
    uint32_t irq = board_irq_save(node);
    if (size > link->received_size) // a command discarded what was received
        size = link->received_size;
    link->received_size = (uint16_t)(link->received_size - size);
    memmove(link->received, link->received + size, link->received_size);
    board_irq_restore(node, irq);
}

void link_receive_task(struct node *node) {
    struct link *link = &node->link;
    uint8_t block[WIRE_BLOCK_MAX];
    for (;;) {
        size_t skip, length, size = link->received_size;
        enum wire_scan found = wire_scan(&link->scanner, link->received, size, &skip, &length);
        if (found == WIRE_BLOCK)
            memcpy(block, link->received + skip, length);
        if (skip + length)
            drop_received(node, skip + length);
        if (found == WIRE_MORE)
            return;
        if (found == WIRE_BLOCK) {
            accept(node, block, length);
        } else {
            link->losses++;
            acknowledge(node); // with the old sequence: a nak
        }
    }
}
