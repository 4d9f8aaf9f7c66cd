// SPDX-License-Identifier: Apache-2.0
// Internals of a simulated world, shared by its files.
#ifndef WORLD_PARTS_H
#define WORLD_PARTS_H

#include "nodes/link/io/io_api.h"
#include "nodes/virtual/world/clock.h"
#include "nodes/virtual/world/world.h"

enum { IRQ_RING = 8, HOST_OUT = IO_OUT_FRAMES * 16, UART_FIFO = 64 };

struct world_can {
    struct can_wire wire;
    struct world *world;
    struct world_can *next;
};

struct byte_ring {
    uint8_t bytes[WORLD_UART_MAX];
    uint32_t first, count, room;
};

// One direction: bytes are sent one after the other.
struct uart_way {
    struct world_uart *uart;
    struct byte_ring queue;
    struct event byte; // the first byte arrives
    void (*arrived)(struct world_uart *uart, uint8_t byte);
    uint64_t carry;
};

struct world_uart {
    struct world *world;
    struct world_uart *next;
    struct world_uart_settings settings;
    struct world_uart_counters counters;
    struct chance chance;
    struct uart_way to_node, to_host;
    struct byte_ring received; // by the host's driver, not yet passed on
    struct event pass_on;
    struct world_node *node;
    struct world_port *port;
};

struct pending_frame {
    uint64_t at_ns;
    struct can_bits frame;
};

struct world_node {
    struct world *world;
    struct world_node *next;
    struct world_node_settings settings;
    struct world_node_counters counters;
    struct sim_board *board;
    struct world_can *can;
    struct world_uart *uart;
    struct can_controller controller;
    struct world_port *device; // of the host, on this board; or null
    uint64_t device_gone_ns;
    struct chance chance;
    struct crystal crystal;
    uint32_t number, life;
    uint64_t boot_clock; // its clock at power on
    struct event timer, tasks, irq, boot;
    struct pending_frame frames[IRQ_RING];
    uint32_t frame_first, frame_count;
    struct world_edge *edges;
    size_t edge_room;
    uint8_t driven[WORLD_PINS], input[WORLD_PINS], adc_set[WORLD_PINS];
    uint16_t adc[WORLD_PINS];
};

struct world_port {
    struct world *world;
    struct world_port *next;
    struct world_port_settings settings;
    struct world_port_counters counters;
    struct chance chance;
    struct world_can *can;
    struct world_uart *uart;
    struct can_controller controller;
    struct io_bus *bus;
    uint32_t number;
    uint8_t noticed; // Python has not been notified yet
    struct event wake, notice;
    struct can_bits *received;
    uint32_t received_first, received_count;
    uint8_t out[HOST_OUT]; // what the transmit queue did not accept
    size_t out_at, out_size;
    uint64_t retry_ns;
    uint64_t back_ns; // there is no such device before
};

// A planned change of an input.
struct action {
    struct world *world;
    struct action *next_free;
    struct event event;
    struct world_node *node;
    uint32_t pin;
    uint16_t value;
    uint8_t adc;
};

struct world {
    struct agenda agenda;
    uint64_t seed;
    uint32_t can_count, uart_count, node_count, port_count;
    struct world_can *cans;
    struct world_uart *uarts;
    struct world_node *nodes;
    struct world_port *ports;
    struct action *actions, *free_action;
    uint64_t io_stalled_ns, python_stalled_ns;
    struct world_latency python;
    struct chance python_chance;
    uint8_t stop; // Python is to be notified
};

uint64_t latency_draw(struct chance *chance, const struct world_latency *latency);
void node_free(struct world_node *node);
void port_free(struct world_port *port);
void actions_start(struct world *world);
// Changes an input now; the change persists over resets.
void node_drive(struct world_node *node, uint32_t pin, uint16_t value, int adc);
void node_reapply_inputs(struct world_node *node);
int action_plan(struct world_node *node, uint32_t pin, uint16_t value, int adc, uint64_t at_ns);

// uart.c. Return how many bytes were accepted.
size_t uart_to_node(struct world_uart *uart, const uint8_t *data, size_t size);
size_t uart_to_host(struct world_uart *uart, const uint8_t *data, size_t size);
void uart_noise(struct world_uart *uart);
void uart_clear_to_host(struct world_uart *uart);
void node_uart_byte(struct world_node *node, uint8_t byte);
void node_uart_room(struct world_node *node);
void port_uart_bytes(struct world_port *port);
size_t ring_take(struct byte_ring *ring, uint8_t *out, size_t size);

#endif
