// SPDX-License-Identifier: Apache-2.0
// The UART transport: bytes of blocks, as many as the board takes.
#include "net/uart_stream.h"

#include "boards/board.h"

static void transmit(struct node *node) {
    uint8_t bytes[WIRE_BLOCK_MAX];
    size_t size;
    while ((size = link_peek(node, bytes, sizeof(bytes)))) {
        uint32_t sent = board_uart_send(node, bytes, (uint32_t)size);
        link_consume(node, sent);
        if (sent < size)
            return;
    }
}

const struct transport uart_stream_transport = {transmit};
