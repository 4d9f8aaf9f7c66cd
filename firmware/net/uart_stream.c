// SPDX-License-Identifier: Apache-2.0
// UART: message blocks as they are. Received bytes go straight to node_receive().
#include "boards/board.h"
#include "core/node.h"

enum { PIECE = 64 };

void uart_stream_task(struct node *node) {
    if (node->can)
        return; // this node speaks CAN
    uint8_t data[PIECE];
    size_t size;
    while ((size = node_transmit_peek(node, data, sizeof(data)))) {
        size_t taken = board_uart_send(node, data, size);
        if (!taken)
            return;
        node_transmitted(node, taken);
    }
}
DECL_TASK(uart_stream_task);
