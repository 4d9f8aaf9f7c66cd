// SPDX-License-Identifier: Apache-2.0
// A serial line: two independent directions, a byte at a time.
#include "nodes/virtual/world/parts.h"

#include <stdlib.h>

enum { BITS_PER_BYTE = 10, EVENTS = 3 };

// -------------------------------------------------------------------------------------------------- rings

static int ring_put(struct byte_ring *ring, uint8_t byte) {
    if (ring->count == ring->room)
        return -1;
    ring->bytes[(ring->first + ring->count++) % WORLD_UART_MAX] = byte;
    return 0;
}

size_t ring_take(struct byte_ring *ring, uint8_t *out, size_t size) {
    size_t taken = 0;
    for (; taken < size && ring->count; taken++, ring->count--) {
        out[taken] = ring->bytes[ring->first];
        ring->first = (ring->first + 1) % WORLD_UART_MAX;
    }
    return taken;
}

// ----------------------------------------------------------------------------------------------- the line

// Plans the arrival of the next byte, ten bits after FROM_NS; the remainder of the division is carried over.
static void plan_byte(struct uart_way *way, uint64_t from_ns) {
    uint64_t scaled = BITS_PER_BYTE * NS_PER_S + way->carry, baud = way->uart->settings.baud;
    way->carry = scaled % baud;
    agenda_plan(&way->uart->world->agenda, &way->byte, from_ns + scaled / baud);
}

static size_t way_put(struct uart_way *way, const uint8_t *data, size_t size) {
    size_t taken = 0;
    while (taken < size && ring_put(&way->queue, data[taken]) == 0)
        taken++;
    if (taken && !event_planned(&way->byte)) {
        way->carry = 0;
        plan_byte(way, way->uart->world->agenda.now_ns);
    }
    return taken;
}

static void byte_due(void *owner) {
    struct uart_way *way = owner;
    struct world_uart *uart = way->uart;
    uint8_t byte = 0;
    ring_take(&way->queue, &byte, 1);
    if (way->queue.count)
        plan_byte(way, uart->world->agenda.now_ns);
    agenda_note(&uart->world->agenda, byte);
    if (chance_happens(&uart->chance, uart->settings.loss)) {
        uart->counters.lost++;
        return;
    }
    if (chance_happens(&uart->chance, uart->settings.corruption)) {
        uart->counters.corrupted++;
        byte ^= (uint8_t)(1u << chance_below(&uart->chance, 8));
    }
    way->arrived(uart, byte);
}

static void at_node(struct world_uart *uart, uint8_t byte) {
    if (!uart->node)
        return;
    uart->counters.to_node++;
    node_uart_byte(uart->node, byte);
}

static void at_host(struct world_uart *uart, uint8_t byte) {
    struct agenda *agenda = &uart->world->agenda;
    if (ring_put(&uart->received, byte)) {
        uart->counters.overflow++;
        return;
    }
    uart->counters.to_host++;
    // The driver collects bytes for a while and passes them on together.
    if (!event_planned(&uart->pass_on))
        agenda_plan(agenda, &uart->pass_on,
                    agenda->now_ns + latency_draw(&uart->chance, &uart->settings.read));
}

static void room_at_node(struct world_uart *uart) {
    if (uart->node)
        node_uart_room(uart->node);
}

static void to_host_arrived(struct world_uart *uart, uint8_t byte) {
    at_host(uart, byte);
    room_at_node(uart);
}

static void pass_on_due(void *owner) {
    struct world_uart *uart = owner;
    if (uart->port && uart->port->bus)
        port_uart_bytes(uart->port);
    else
        uart->received.count = 0; // the line is not open
}

size_t uart_to_node(struct world_uart *uart, const uint8_t *data, size_t size) {
    return way_put(&uart->to_node, data, size);
}

size_t uart_to_host(struct world_uart *uart, const uint8_t *data, size_t size) {
    return way_put(&uart->to_host, data, size);
}

size_t world_uart_inject(struct world_uart *uart, int to_node, const uint8_t *data, size_t size) {
    return to_node ? uart_to_node(uart, data, size) : uart_to_host(uart, data, size);
}

void uart_clear_to_host(struct world_uart *uart) {
    uart->to_host.queue.count = 0;
    agenda_cancel(&uart->world->agenda, &uart->to_host.byte);
}

void uart_noise(struct world_uart *uart) {
    uart->received.count = 0;
    for (uint32_t i = 0; i < uart->settings.noise_bytes; i++) {
        uart->counters.noise += 2;
        at_node(uart, (uint8_t)chance_bits(&uart->chance));
        at_host(uart, (uint8_t)chance_bits(&uart->chance));
    }
}

// ---------------------------------------------------------------------------------------------- creation

static void way_start(struct world_uart *uart, struct uart_way *way, uint32_t room,
                      void (*arrived)(struct world_uart *uart, uint8_t byte)) {
    way->uart = uart;
    way->queue.room = room;
    way->arrived = arrived;
    way->byte = (struct event){.fire = byte_due, .owner = way};
}

struct world_uart *world_add_uart(struct world *world, const struct world_uart_settings *settings) {
    struct world_uart *uart = calloc(1, sizeof(*uart));
    if (!uart || agenda_reserve(&world->agenda, EVENTS)) {
        free(uart);
        return NULL;
    }
    uart->world = world;
    uart->settings = *settings;
    uart->chance = chance_of(world->seed, CHANCE_UART, world->uart_count++);
    uart->received.room = WORLD_UART_MAX;
    uart->pass_on = (struct event){.fire = pass_on_due, .owner = uart};
    way_start(uart, &uart->to_node, WORLD_UART_MAX, at_node);
    way_start(uart, &uart->to_host, UART_FIFO, to_host_arrived);
    uart->next = world->uarts;
    return world->uarts = uart;
}

struct world_uart_settings *world_uart_settings(struct world_uart *uart) {
    return &uart->settings;
}

const struct world_uart_counters *world_uart_counters(const struct world_uart *uart) {
    return &uart->counters;
}
