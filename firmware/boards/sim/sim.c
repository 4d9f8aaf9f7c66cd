// SPDX-License-Identifier: Apache-2.0
// The simulated board: see sim.h.
#include "boards/sim/sim.h"

#include "boards/virtual/virtual.h"
#include "net/can_stream.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { EDGES_AT_FIRST = 1024, ARENA = 64 * 1024, NS_PER_S = 1000000000 };

struct sim_board {
    struct virtual_board virtual;
    struct can_stream can;
    uint64_t clock;
    uint64_t edges_lost;
    struct node_config config; // but for clock_high, which every start sets anew
    uint8_t on_can, reset_wanted;
    uint8_t talks; // it runs tasks or takes a frame: what it reads of its clock may be wrong
    int64_t lie;   // ticks
    uint32_t lie_spread, lie_chance;
    struct sim_owner owner; // all null: none
    uint8_t out[SIM_OUT_ROOM];
    size_t out_size;
    struct sim_plant *plant;
    _Alignas(16) uint8_t arena[ARENA];
};

// ------------------------------------------------------------------------------------------------- plant

struct sim_plant {
    struct plant plant;
    struct plant_page page;
    struct sim_board *peers[PLANT_PEERS];
};
_Static_assert((int)SIM_ERROR == (int)PLANT_ERROR, "its sentences fit");

int sim_plant_start(struct sim_board *board, uint64_t now_ns, const char *text, size_t size, char *error) {
    struct sim_plant *plant = board->plant ? NULL : calloc(1, sizeof(*plant));
    if (!plant) {
        snprintf(error, SIM_ERROR, "%s", board->plant ? "it has a plant already" : "out of memory");
        return -1;
    }
    if (plant_read(&plant->plant, text, size, VIRTUAL_ADC_MAX, VIRTUAL_PWM_MAX, error)) {
        free(plant);
        return -1;
    }
    plant_start(&plant->plant, &plant->page, now_ns ? now_ns : virtual_true_ns(&board->virtual));
    board->plant = plant;
    board->virtual.plant = &plant->plant;
    return 0;
}

// All boards of a world come to an instant together: their steps are in, only heat is worked out when asked.
static void refresh_peer(void *context, unsigned number, uint64_t ns) {
    const struct sim_plant *plant = context;
    if (plant->peers[number])
        plant_update(&plant->peers[number]->plant->plant, ns);
}

int sim_plant_peer(struct sim_board *board, const char *name, struct sim_board *peer) {
    struct sim_plant *plant = board->plant;
    for (int i = 0; plant && peer->plant && i < plant->plant.peer_count; i++) {
        if (strcmp(plant->plant.peers[i].node, name) != 0)
            continue;
        plant->peers[i] = peer;
        plant->plant.peers[i].page = &peer->plant->page;
        plant->plant.host = (struct plant_host){.context = plant, .refresh = refresh_peer};
        return 0;
    }
    return -1;
}

void sim_plant_update(struct sim_board *board, uint64_t now_ns) {
    if (board->plant)
        plant_update(&board->plant->plant, now_ns ? now_ns : virtual_true_ns(&board->virtual));
}

void *sim_plant_page(struct sim_board *board, size_t *size) {
    *size = sizeof(struct plant_page);
    return board->plant ? &board->plant->page : NULL;
}

// ------------------------------------------------------------------------------------------- life and time

static void start(struct sim_board *board) {
    board->config.clock_high = (uint32_t)(board->clock >> 32);
    board->reset_wanted = 0;
    virtual_pins_reset(&board->virtual);
    if (board->on_can)
        can_stream_attach(&board->virtual.node, &board->can);
    node_start(&board->virtual.node, &board->config);
    if (!board->owner.context)
        node_run_tasks(&board->virtual.node);
}

static void run_tasks(struct sim_board *board) {
    struct node *node = &board->virtual.node;
    virtual_irq_check(&board->virtual);
    if (board->owner.context)
        return; // it says when
    if (node->tasks_pending)
        node_run_tasks(node);
    virtual_irq_check(&board->virtual);
    if (board->reset_wanted)
        start(board);
}

static void configure(struct sim_board *board, const struct sim_options *options) {
    board->config = (struct node_config){
        .clock_freq = options->clock_freq ? options->clock_freq : virtual_variant.clock_freq,
        .move_count = options->move_count ? options->move_count : virtual_variant.move_count,
        .arena = board->arena,
        .arena_size = sizeof(board->arena),
        .dictionary = options->dictionary,
        .dictionary_size = options->dictionary_size,
        .legacy = options->legacy != 0,
    };
    memcpy(board->config.uuid, options->uuid, sizeof(board->config.uuid));
}

const uint8_t *sim_dictionary(uint32_t *size) {
    *size = node_tables.dictionary_size;
    return node_tables.dictionary;
}

struct sim_board *sim_new_with(const struct sim_options *options) {
    struct sim_board *board = calloc(1, sizeof(*board));
    if (!board)
        return NULL;
    board->virtual.edges = malloc(EDGES_AT_FIRST * sizeof(uint64_t));
    if (!board->virtual.edges) {
        free(board);
        return NULL;
    }
    board->virtual.edge_room = EDGES_AT_FIRST;
    board->clock = options->start_clock;
    board->on_can = options->on_can != 0;
    configure(board, options);
    start(board);
    return board;
}

struct sim_board *sim_new(const uint8_t *uuid, uint64_t start_clock, int on_can) {
    const struct sim_options options = {.uuid = uuid, .start_clock = start_clock, .on_can = on_can};
    return sim_new_with(&options);
}

void sim_free(struct sim_board *board) {
    free(board->plant);
    free(board->virtual.edges);
    free(board);
}

void sim_restart(struct sim_board *board) {
    start(board);
}

static uint64_t extend(const struct sim_board *board, uint32_t clock) {
    return board->clock + (uint64_t)(int64_t)(int32_t)(clock - (uint32_t)board->clock);
}

uint64_t sim_next_deadline(const struct sim_board *board) {
    const struct node *node = &board->virtual.node;
    // With an owner, tasks that are wanted already run when it says so: only timers are due by themselves.
    if (board->owner.context && node->tasks_pending)
        return node->sched.first ? extend(board, node->sched.first->waketime) : UINT64_MAX;
    return extend(board, node_next_deadline(node));
}

void sim_run_until(struct sim_board *board, uint64_t clock) {
    struct node *node = &board->virtual.node;
    for (;;) {
        uint64_t deadline = sim_next_deadline(board);
        if (deadline > clock)
            break;
        if (deadline > board->clock)
            board->clock = deadline;
        const struct timer *first = node->sched.first;
        if (first && first->waketime == (uint32_t)deadline)
            sched_run_first(node);
        else
            node_wake_tasks(node); // the periodic report
        run_tasks(board);
    }
    if (clock > board->clock)
        board->clock = clock;
}

uint32_t sim_node_id(const struct sim_board *board) {
    return board->can.node_id;
}

uint64_t sim_clock(const struct sim_board *board) {
    return board->clock;
}

uint32_t sim_expected(const struct sim_board *board) {
    return board->virtual.node.rx.expected;
}

void sim_lie(struct sim_board *board, int64_t offset, uint32_t spread) {
    board->lie = offset;
    board->lie_spread = spread;
    board->lie_chance = 1;
}

uint32_t board_clock(struct node *node) {
    struct sim_board *board = (struct sim_board *)node;
    uint32_t clock = (uint32_t)board->clock;
    if (!board->talks)
        return clock;
    clock += (uint32_t)board->lie;
    if (board->lie_spread) {
        board->lie_chance = board->lie_chance * 1664525 + 1013904223;
        clock += (uint32_t)((uint64_t)board->lie_chance * board->lie_spread >> 32);
    }
    return clock;
}

uint64_t virtual_clock(struct virtual_board *virtual) {
    return ((struct sim_board *)virtual)->clock;
}

uint64_t virtual_true_ns(struct virtual_board *virtual) {
    const struct sim_board *board = (const struct sim_board *)virtual;
    if (board->owner.true_ns)
        return board->owner.true_ns(board->owner.context, board->clock);
    uint64_t second = board->config.clock_freq;
    return board->clock / second * NS_PER_S + board->clock % second * NS_PER_S / second;
}

void board_reset(struct node *node) {
    ((struct sim_board *)node)->reset_wanted = 1;
}

// ----------------------------------------------------------------------------------------------------- owner

static void tell_edge(struct virtual_board *virtual, uint32_t pin, int level) {
    struct sim_board *board = (struct sim_board *)virtual;
    virtual->edge_count = 0; // the owner keeps it
    board->owner.edge(board->owner.context, board->clock, pin, level);
}

static void ask_can_status(struct virtual_board *virtual, struct board_can_status *out) {
    const struct sim_owner *owner = &((struct sim_board *)virtual)->owner;
    owner->can_status(owner->context, out);
}

void sim_own(struct sim_board *board, const struct sim_owner *owner) {
    board->owner = *owner;
    board->out_size = 0;
    board->virtual.on_edge = tell_edge;
    if (board->on_can)
        board->virtual.can_status = ask_can_status;
}

int sim_tasks_wanted(const struct sim_board *board) {
    return board->virtual.node.tasks_pending;
}

int sim_reset_wanted(const struct sim_board *board) {
    return board->reset_wanted;
}

void sim_run_tasks(struct sim_board *board) {
    board->talks = 1;
    node_run_tasks(&board->virtual.node);
    board->talks = 0;
    virtual_irq_check(&board->virtual);
}

void sim_sent(struct sim_board *board) {
    node_wake_tasks(&board->virtual.node);
}

void sim_power_off(struct sim_board *board) {
    virtual_pins_reset(&board->virtual);
    board->virtual.node.tasks_pending = 0;
    board->virtual.node.sched.first = NULL;
}

void sim_power_on(struct sim_board *board, uint64_t start_clock) {
    board->clock = start_clock;
    start(board);
}

// ----------------------------------------------------------------------------------------------------- wires

void sim_receive_frame(struct sim_board *board, uint32_t id, const uint8_t *data, size_t size) {
    if (!board->on_can)
        return;
    board->talks = 1;
    can_stream_receive(&board->virtual.node, id, data, size);
    board->talks = 0;
    run_tasks(board);
}

void sim_receive_bytes(struct sim_board *board, const uint8_t *data, size_t size) {
    if (board->on_can)
        return;
    node_receive(&board->virtual.node, data, size);
    run_tasks(board);
}

// Bytes of urgent frames at the front of what waits: data never goes before them.
static size_t urgent_size(const struct sim_board *board) {
    size_t at = 0;
    for (uint32_t id; at < board->out_size; at += SIM_FRAME_SIZE) {
        memcpy(&id, board->out + at, sizeof(id));
        if (id >= CAN_ID_URGENT_END)
            break;
    }
    return at;
}

int board_can_send(struct node *node, uint32_t id, const uint8_t *data, size_t size) {
    uint8_t record[SIM_FRAME_SIZE] = {0};
    memcpy(record, &id, sizeof(id));
    record[4] = (uint8_t)size;
    memcpy(record + 8, data, size);
    struct sim_board *board = (struct sim_board *)node;
    if (board->owner.context)
        return board->owner.send_frame(board->owner.context, id, data, size);
    size_t at = id < CAN_ID_URGENT_END ? urgent_size(board) : board->out_size;
    if (sizeof(record) > SIM_OUT_ROOM - board->out_size)
        return -1;
    memmove(board->out + at + sizeof(record), board->out + at, board->out_size - at);
    memcpy(board->out + at, record, sizeof(record));
    board->out_size += sizeof(record);
    return 0;
}

size_t board_uart_send(struct node *node, const uint8_t *data, size_t size) {
    struct sim_board *board = (struct sim_board *)node;
    if (board->owner.context)
        return board->owner.send_bytes(board->owner.context, data, size);
    if (size > SIM_OUT_ROOM - board->out_size)
        return 0;
    memcpy(board->out + board->out_size, data, size);
    board->out_size += size;
    return size;
}

size_t sim_take(struct sim_board *board, uint8_t *out, size_t size) {
    if (size > board->out_size)
        size = board->out_size;
    if (board->on_can)
        size -= size % SIM_FRAME_SIZE;
    memcpy(out, board->out, size);
    board->out_size -= size;
    memmove(board->out, board->out + size, board->out_size);
    node_wake_tasks(&board->virtual.node); // there is room again
    run_tasks(board);
    return size;
}

// ------------------------------------------------------------------------------------------------------ pins

int sim_set_input(struct sim_board *board, uint32_t pin, int level) {
    if (pin >= VIRTUAL_PINS)
        return -1;
    board->virtual.level[pin] = level != 0;
    return 0;
}

int sim_set_adc(struct sim_board *board, uint32_t pin, uint16_t value) {
    if (pin >= VIRTUAL_PINS || value > VIRTUAL_ADC_MAX)
        return -1;
    board->virtual.adc[pin] = value;
    return 0;
}

int sim_level(const struct sim_board *board, uint32_t pin) {
    return pin < VIRTUAL_PINS ? board->virtual.level[pin] : -1;
}

int sim_pwm(const struct sim_board *board, uint32_t pin) {
    return pin < VIRTUAL_PINS ? board->virtual.pwm[pin] : -1;
}

void virtual_edges_full(struct virtual_board *virtual) {
    uint64_t *more = realloc(virtual->edges, 2 * virtual->edge_room * sizeof(uint64_t));
    if (more) {
        virtual->edges = more;
        virtual->edge_room *= 2;
    } else {
        ((struct sim_board *)virtual)->edges_lost += virtual->edge_count;
        virtual->edge_count = 0;
    }
}

const uint64_t *sim_edges(const struct sim_board *board, size_t *count) {
    *count = board->virtual.edge_count;
    return board->virtual.edges;
}

void sim_edges_forget(struct sim_board *board) {
    board->virtual.edge_count = 0;
}

uint64_t sim_edges_lost(const struct sim_board *board) {
    return board->edges_lost;
}

void sim_counters(const struct sim_board *board, struct sim_counters *out) {
    const struct node *node = &board->virtual.node;
    *out = (struct sim_counters){
        .rx_overflow_bytes = node->stats.rx_overflow_bytes,
        .rx_lost = node->stats.rx_lost,
        .rx_out_of_order = node->stats.rx_out_of_order,
        .rx_blocks = node->stats.rx_blocks,
        .tx_dropped = node->stats.tx_dropped,
        .timers_run = node->stats.timers_run,
        .clock_freq = node->config.clock_freq,
        .node_id = board->can.node_id,
        .is_shutdown = node->shutdown.active,
    };
}
