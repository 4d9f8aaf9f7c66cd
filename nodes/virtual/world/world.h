// SPDX-License-Identifier: Apache-2.0
// A simulated world: nodes, wires and the host's adapters in one time, from one seed. This header is its
// manual.
//
// All times are true time in integer ns, which is also the host's CLOCK_MONOTONIC. world_run() moves it; all
// else acts at the present. Pointers handed out live until world_free(). Settings may be changed at any time
// through the pointers below and count from then on. NULL or -1: no memory, or a limit is reached; nothing
// was done.
//
// What runs how fast: a node's timers run exactly at their ticks and take no time; its receive interrupt
// comes 0..irq_jitter_ns after the frame; its tasks run after a latency. The host's I/O thread and its Python
// run after latencies of their own, and not while they are stalled.
#ifndef WORLD_WORLD_H
#define WORLD_WORLD_H

#include <stddef.h>
#include <stdint.h>

#include "boards/sim/sim.h"
#include "nodes/link/io_core.h"
#include "nodes/virtual/world/can_wire.h"

// cffi: begin
struct world;
struct world_can;
struct world_uart;
struct world_node;
struct world_port;
struct can_controller;

enum {
    WORLD_PORTS_MAX = 64,
    WORLD_PINS = 144,
    WORLD_RATES_MAX = 64,      // changes of a clock's rate, its start included
    WORLD_AXES_MAX = 32,       // per node
    WORLD_ACTIONS_MAX = 4096,  // planned changes of inputs
    WORLD_EDGES_MAX = 1 << 24, // remembered per node
    WORLD_RECEIVE_MAX = 4096,  // longest receive queue of a port, in frames
    WORLD_UART_MAX = 4096,     // bytes a UART's driver holds in each direction
};

// min + an exponentially distributed part with the given mean, at most max in all.
struct world_latency {
    uint64_t min_ns, mean_ns, max_ns;
};

struct world *world_new(uint64_t seed, uint64_t start_ns);
void world_free(struct world *world);
uint64_t world_now(const struct world *world);
// Lets everything happen up to and including UNTIL_NS. Returns 1 when it stopped earlier because Python is to
// be woken: world_noticed() tells by which ports. 0: it is UNTIL_NS.
int world_run(struct world *world, uint64_t until_ns);
// A port whose io_take() has something, each notice once; NULL: no more.
struct world_port *world_noticed(struct world *world);
// Neither the I/O threads (IO) nor Python (PYTHON) run before UNTIL_NS.
void world_stall(struct world *world, uint64_t until_ns, int io, int python);
uint64_t world_python_stalled(const struct world *world); // until when
// When a Python that waits for DUE_NS really goes on.
uint64_t world_python_wakes(struct world *world, uint64_t due_ns);
struct world_latency *world_python_latency(struct world *world);
uint64_t world_trace(const struct world *world); // hash of all that happened so far
uint64_t world_events(const struct world *world);

// ------------------------------------------------------------------------------------------------- CAN

struct world_can *world_add_can(struct world *world, const struct can_wire_settings *settings);
struct can_wire_settings *world_can_settings(struct world_can *can);
void world_can_counters(const struct world_can *can, struct can_wire_counters *out);

// ------------------------------------------------------------------------------------------------- UART

struct world_uart_settings {
    uint32_t baud;             // ten bits a byte
    double loss, corruption;   // probabilities per byte, either direction
    uint32_t noise_bytes;      // either end hears so many when the host opens it
    struct world_latency read; // until the driver hands a received byte to the host
};
struct world_uart_counters {
    uint64_t to_node, to_host; // bytes that arrived
    uint64_t lost, corrupted, noise;
    uint64_t overflow; // bytes that found the host's driver full
};
struct world_uart *world_add_uart(struct world *world, const struct world_uart_settings *settings);
struct world_uart_settings *world_uart_settings(struct world_uart *uart);
void world_uart_counters(const struct world_uart *uart, struct world_uart_counters *out);

// ------------------------------------------------------------------------------------------------- nodes

struct world_node_settings {
    double ppm; // rate error of its clock, at its start
    uint64_t irq_jitter_ns;
    struct world_latency task; // from the wish to run to the running of tasks
    uint64_t boot_ns;          // from power or reset to the start of the firmware
};
struct world_node_counters {
    uint64_t irq_overflow; // frames or bytes that came too fast for the interrupt
    uint64_t edges, edges_lost;
    uint64_t resets, tasks;
    int powered, running;
};
// At one of CAN and UART, the other NULL. OPTIONS: as for sim_new_with; its start_clock is the clock now.
struct world_node *world_add_node(struct world *world, const struct sim_options *options,
                                  const struct world_node_settings *settings, struct world_can *can,
                                  struct world_uart *uart);
struct world_node_settings *world_node_settings(struct world_node *node);
struct sim_board *world_node_board(struct world_node *node);
struct can_controller *world_node_controller(struct world_node *node); // NULL on a UART
void world_node_counters(const struct world_node *node, struct world_node_counters *out);
void world_node_reset(struct world_node *node);
void world_node_power_off(struct world_node *node);
void world_node_power_on(struct world_node *node, uint64_t start_clock);
// From now on the clock runs PPM above nominal, rising by PPM_PER_S.
int world_node_set_rate(struct world_node *node, double ppm, double ppm_per_s);
// The host's PORT is a USB device on this board: it disappears when the board is reset or loses its power,
// and comes back GONE_NS after the reset or the power.
void world_node_carries(struct world_node *node, struct world_port *port, uint64_t gone_ns);
double world_node_ppm(const struct world_node *node);
uint64_t world_node_clock(const struct world_node *node);
// The instants at which the clock became CLOCKS (64 bits, of the present life), in ps.
void world_node_true_ps(const struct world_node *node, const uint64_t *clocks, size_t count, int64_t *out);
// A change of an input at AT_NS. -1: no such pin, or WORLD_ACTIONS_MAX are planned.
int world_node_set_input(struct world_node *node, uint32_t pin, int level, uint64_t at_ns);
int world_node_set_adc(struct world_node *node, uint32_t pin, uint16_t value, uint64_t at_ns);

// Changes of outputs, oldest first, since the node was made.
struct world_edge {
    int64_t true_ps;
    uint64_t clock;
    uint16_t pin;
    uint8_t level, padding;
    uint32_t life; // 0, 1, …: resets and power cycles before
};
const struct world_edge *world_node_edges(const struct world_node *node, size_t *count);

// A mechanical axis: counts the steps of a stepper, and holds an input at 1 while its position is at or
// beyond AT (>= AT for direction 1, <= AT for -1), else at 0; the input follows DELAY_NS after the step.
struct world_axis {
    uint32_t step_pin, dir_pin;
    int dir_inverted;  // forward is dir = 0
    int step_inverted; // a step is a fall of its pin, not a rise
    int both_edges;    // each change of the step pin is a step, not only its rise
    int64_t position, at;
    int direction;
    int input_inverted;
    struct world_node *target;
    uint32_t target_pin;
    uint64_t delay_ns;
};
// Returns the axis's number, or -1. Its state can be read at any time.
int world_node_add_axis(struct world_node *node, const struct world_axis *axis);
const struct world_axis *world_node_axis(const struct world_node *node, int number);

// ------------------------------------------------------------------------------------------------- the host

struct world_port_settings {
    struct world_latency wake; // of the I/O thread
    uint32_t receive_queue;    // frames the kernel holds for it
};
struct world_port_counters {
    uint64_t overflow;    // frames that found the receive queue full
    uint64_t receive_max; // most that ever waited there
    uint64_t no_buffers;  // writes refused: the transmit queue was full (ENOBUFS)
    uint64_t wakeups;
};
struct world_port *world_add_can_port(struct world *world, struct world_can *can,
                                      const struct can_controller_settings *controller,
                                      const struct world_port_settings *settings);
struct world_port *world_add_uart_port(struct world *world, struct world_uart *uart,
                                       const struct world_port_settings *settings);
struct world_port_settings *world_port_settings(struct world_port *port);
struct can_controller *world_port_controller(struct world_port *port);
void world_port_counters(const struct world_port *port, struct world_port_counters *out);
// Whether the device is there.
int world_port_there(const struct world_port *port);
// Starts a bus on the port, ends it. NULL: no memory, there is one, or no device.
struct io_bus *world_port_open(struct world_port *port, const struct io_settings *settings);
void world_port_close(struct world_port *port);
// The adapter is pulled out: the bus ends with CAUSE (an errno, 0: end of file).
void world_port_fail(struct world_port *port, int cause);

// Of every controller.
struct can_controller_status {
    uint32_t tec, rec, retries, queued;
    int state; // enum can_state
};
void world_can_status(const struct can_controller *controller, struct can_controller_status *out);
void world_can_controller_counters(const struct can_controller *controller,
                                   struct can_controller_counters *out);
struct can_controller_settings *world_can_controller_settings(struct can_controller *controller);
int world_can_send(struct can_controller *controller, uint32_t id, const uint8_t *data, size_t size);
void world_can_babble(struct can_controller *controller, uint32_t id, const uint8_t *data, size_t size,
                      uint64_t until_ns);
void world_can_cut(struct can_controller *controller, uint32_t segment);
void world_can_restart(struct can_controller *controller);
// cffi: end

#endif
