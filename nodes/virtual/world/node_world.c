// SPDX-License-Identifier: Apache-2.0
// Access to a node: inputs, clock, counters.
#include "nodes/virtual/world/parts.h"

_Static_assert((int)WORLD_RATES_MAX == (int)CLOCK_PIECES_MAX, "the limit is part of the interface");

// ------------------------------------------------------------------------------------------------- inputs

static void catch_up(struct world_node *node) {
    if (node->counters.running)
        sim_run_until(node->board, crystal_ticks(&node->crystal, node->world->agenda.now_ns));
}

void node_drive(struct world_node *node, uint32_t pin, uint16_t value, int adc) {
    catch_up(node); // events due before read the old value
    if (adc) {
        node->adc_set[pin] = 1;
        node->adc[pin] = value;
        sim_set_adc(node->board, pin, value);
    } else {
        node->driven[pin] = 1;
        node->input[pin] = (uint8_t)value;
        sim_set_input(node->board, pin, value);
    }
}

void node_reapply_inputs(struct world_node *node) {
    for (uint32_t pin = 0; pin < WORLD_PINS; pin++) {
        if (node->driven[pin])
            sim_set_input(node->board, pin, node->input[pin]);
        if (node->adc_set[pin])
            sim_set_adc(node->board, pin, node->adc[pin]);
    }
}

int world_node_set_input(struct world_node *node, uint32_t pin, int level, uint64_t at_ns) {
    return action_plan(node, pin, level != 0, 0, at_ns);
}

int world_node_set_adc(struct world_node *node, uint32_t pin, uint16_t value, uint64_t at_ns) {
    return value > 4095 ? -1 : action_plan(node, pin, value, 1, at_ns);
}

// -------------------------------------------------------------------------------------------------- clock

int world_node_set_rate(struct world_node *node, double ppm, double ppm_per_s) {
    struct agenda *agenda = &node->world->agenda;
    catch_up(node);
    if (crystal_change(&node->crystal, agenda->now_ns, ppm, ppm_per_s))
        return -1;
    if (event_planned(&node->timer)) // its time is computed again when it fires
        agenda_plan(agenda, &node->timer, agenda->now_ns);
    return 0;
}

double world_node_ppm(const struct world_node *node) {
    return crystal_ppm(&node->crystal, node->world->agenda.now_ns);
}

uint64_t world_node_clock(const struct world_node *node) {
    return crystal_ticks(&node->crystal, node->world->agenda.now_ns);
}

void world_node_true_ps(const struct world_node *node, const uint64_t *clocks, size_t count, int64_t *out) {
    for (size_t i = 0; i < count; i++)
        out[i] = crystal_time_ps(&node->crystal, clocks[i]);
}

// ------------------------------------------------------------------------------------------------- reading

struct world_node_settings *world_node_settings(struct world_node *node) {
    return &node->settings;
}

struct sim_board *world_node_board(struct world_node *node) {
    return node->board;
}

struct can_controller *world_node_controller(struct world_node *node) {
    return node->can ? &node->controller : NULL;
}

const struct world_node_counters *world_node_counters(const struct world_node *node) {
    return &node->counters;
}
