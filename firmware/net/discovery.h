// SPDX-License-Identifier: Apache-2.0
// Who is on the bus: nodes without an id answer QUERY_UNASSIGNED, nodes with one answer WHO_IS_HERE.
//
// All answers have one CAN id, so answers that start in the same bit time destroy each other. Each node
// therefore waits a random time first, drawn from its uuid and the clock, anew for each query. (With the
// clock, two chips with one uuid answer apart, and the host can notice.) A query that comes while an answer
// waits is answered by that answer.
#ifndef NET_DISCOVERY_H
#define NET_DISCOVERY_H

#include <stddef.h>
#include <stdint.h>

struct node;

enum {
    QUERY_UNASSIGNED = 0x00,
    WHO_IS_HERE = 0x41,
    NEED_NODEID = 0x20, // uuid, the set command this node understands
    NODE_HERE = 0x21,   // uuid, node id
};

enum { REPLY_SPREAD_PER_S = 250 }; // the reciprocal of the longest wait: 4 ms

// Part of struct can_stream.
struct discovery {
    uint32_t random;
    uint32_t reply_clock; // when the reply is due
    uint8_t reply;        // NEED_NODEID, NODE_HERE, or 0: none
    uint8_t due;          // it only waits for the board
};

// QUERY_UNASSIGNED or WHO_IS_HERE came. Interrupt context.
void discovery_query(struct node *node, uint8_t query);
// Sends the reply when it is due. From tasks.
void discovery_run(struct node *node);

#endif
