// SPDX-License-Identifier: Apache-2.0
// A simulated world: nodes, wires and the host's adapters in one virtual time, from one seed.
//
// All times are true time in integer ns, which is also the host's CLOCK_MONOTONIC. world_run() advances it;
// all other functions act at the present. Returned pointers are valid until world_free(). Settings may be
// changed at any time through the pointers below, with effect from then on. NULL or -1: no memory, or a limit
// is reached; nothing was done.
//
// Latencies: a node's timers run exactly at their ticks and take no time; its receive interrupt comes
// 0..irq_jitter_ns after the frame; its tasks run after a latency. The host's I/O thread and its Python code
// have latencies of their own, and do not run while they are stalled.
#ifndef WORLD_WORLD_H
#define WORLD_WORLD_H

#include <stddef.h>
#include <stdint.h>

#include "boards/sim/sim.h"
#include "nodes/link/io/io_core.h"
#include "nodes/virtual/world/can_wire.h"

// cffi: begin
struct world;
struct world_can;
struct world_uart;
struct world_node;
struct world_port;

enum {
    WORLD_PORTS_MAX = 64,
    WORLD_PINS = 144,
    WORLD_RATES_MAX = 64,      // changes of a clock's rate, its start included
    WORLD_ACTIONS_MAX = 4096,  // planned changes of inputs
    WORLD_EDGES_MAX = 1 << 24, // recorded per node
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
// Runs the world up to and including UNTIL_NS. Returns 1 when it stopped earlier because Python is to be
// notified: world_noticed() returns the ports. 0: it is UNTIL_NS.
int world_run(struct world *world, uint64_t until_ns);
// Returns a port whose io_take() has something, once for each notice; NULL: no more.
struct world_port *world_noticed(struct world *world);
// Neither the I/O threads (IO) nor Python (PYTHON) run before UNTIL_NS.
void world_stall(struct world *world, uint64_t until_ns, int io, int python);
uint64_t world_python_stalled(const struct world *world); // until when
// Returns when Python code that waits until DUE_NS actually continues.
uint64_t world_python_wakes(struct world *world, uint64_t due_ns);
struct world_latency *world_python_latency(struct world *world);
uint64_t world_trace(const struct world *world); // hash of all events so far
uint64_t world_events(const struct world *world);

// ------------------------------------------------------------------------------------------------- CAN

struct world_can *world_add_can(struct world *world, const struct can_wire_settings *settings);
struct can_wire_settings *world_can_settings(struct world_can *can);
const struct can_wire_counters *world_can_counters(const struct world_can *can);

// ------------------------------------------------------------------------------------------------- UART

struct world_uart_settings {
    uint32_t baud;             // ten bits a byte
    double loss, corruption;   // probabilities per byte, either direction
    uint32_t noise_bytes;      // number of bytes that each end receives when the host opens it
    struct world_latency read; // from a received byte until the driver passes it to the host
};
struct world_uart_counters {
    uint64_t to_node, to_host; // bytes that arrived
    uint64_t lost, corrupted, noise;
    uint64_t overflow; // bytes lost because the host's driver was full
};
struct world_uart *world_add_uart(struct world *world, const struct world_uart_settings *settings);
struct world_uart_settings *world_uart_settings(struct world_uart *uart);
// Puts foreign bytes on the line, in the order of what is sent; returns how many had room.
size_t world_uart_inject(struct world_uart *uart, int to_node, const uint8_t *data, size_t size);
const struct world_uart_counters *world_uart_counters(const struct world_uart *uart);

// ------------------------------------------------------------------------------------------------- nodes

struct world_node_settings {
    double ppm; // rate error of its clock, at its start
    uint64_t irq_jitter_ns;
    struct world_latency task; // from the wish to run to the running of tasks
    uint64_t boot_ns;          // from power or reset to the start of the firmware
};
struct world_node_counters {
    uint64_t irq_overflow; // frames or bytes lost because the interrupt was too slow
    uint64_t edges, edges_lost;
    uint64_t resets, tasks;
    int powered, running;
};
// On CAN or UART, the other is NULL. OPTIONS: as for sim_new_with; start_clock is the node's clock now.
struct world_node *world_add_node(struct world *world, const struct sim_options *options,
                                  const struct world_node_settings *settings, struct world_can *can,
                                  struct world_uart *uart);
struct world_node_settings *world_node_settings(struct world_node *node);
struct sim_board *world_node_board(struct world_node *node);
struct can_controller *world_node_controller(struct world_node *node); // NULL on a UART
const struct world_node_counters *world_node_counters(const struct world_node *node);
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
// Computes the true times, in ps, at which the clock became CLOCKS (64 bits, since the last power on).
void world_node_true_ps(const struct world_node *node, const uint64_t *clocks, size_t count, int64_t *out);
// Changes an input at AT_NS. Returns -1: no such pin, or WORLD_ACTIONS_MAX changes are planned.
int world_node_set_input(struct world_node *node, uint32_t pin, int level, uint64_t at_ns);
int world_node_set_adc(struct world_node *node, uint32_t pin, uint16_t value, uint64_t at_ns);

// Changes of outputs, oldest first, since the node was made.
struct world_edge {
    int64_t true_ps;
    uint64_t clock;
    uint16_t pin;
    uint8_t level, padding;
    uint32_t life; // number of earlier resets and power cycles
};
const struct world_edge *world_node_edges(const struct world_node *node, size_t *count);

// ------------------------------------------------------------------------------------------------- the host

struct world_port_settings {
    struct world_latency wake; // of the I/O thread
    uint32_t receive_queue;    // frames the kernel holds for it
};
struct world_port_counters {
    uint64_t overflow;    // frames lost because the receive queue was full
    uint64_t receive_max; // largest number of frames in it
    uint64_t no_buffers;  // refused writes: the transmit queue was full (ENOBUFS)
    uint64_t wakeups;
};
struct world_port *world_add_can_port(struct world *world, struct world_can *can,
                                      const struct can_controller_settings *controller,
                                      const struct world_port_settings *settings);
struct world_port *world_add_uart_port(struct world *world, struct world_uart *uart,
                                       const struct world_port_settings *settings);
struct world_port_settings *world_port_settings(struct world_port *port);
struct can_controller *world_port_controller(struct world_port *port);
const struct world_port_counters *world_port_counters(const struct world_port *port);
// Whether the device is there.
int world_port_there(const struct world_port *port);
// Starts and ends a bus on the port. NULL: no memory, there is one, or no device.
struct io_bus *world_port_open(struct world_port *port, const struct io_settings *settings);
void world_port_close(struct world_port *port);
// Removes the adapter: the bus ends with CAUSE (an errno, 0: end of file).
void world_port_fail(struct world_port *port, int cause);

// Status of any controller, of a node or port.
struct can_controller_status {
    uint32_t tec, rec, retries, queued;
    int state; // enum can_state
};
void world_can_status(const struct can_controller *controller, struct can_controller_status *out);
const struct can_controller_counters *world_can_controller_counters(const struct can_controller *controller);
struct can_controller_settings *world_can_controller_settings(struct can_controller *controller);
int world_can_send(struct can_controller *controller, uint32_t id, const uint8_t *data, size_t size);
void world_can_babble(struct can_controller *controller, uint32_t id, const uint8_t *data, size_t size,
                      uint64_t until_ns);
// cffi: end

#endif
