// SPDX-License-Identifier: Apache-2.0
// Runs a virtual CAN bus (hub.h) on sockets: one thread with ppoll, as precise as the kernel's scheduler
// allows.
#ifndef VIRTUAL_HUB_LOOP_H
#define VIRTUAL_HUB_LOOP_H

#include "nodes/virtual/hub.h"

// cffi: begin
struct hub_loop;

struct hub_client_report {
    int32_t place; // of 0..HUB_CLIENTS-1
    struct hub_client_counters counters;
};

struct hub_report {
    struct hub_counters counters;
    struct hub_rule_counters rules[HUB_RULES]; // as many as were set
    uint64_t late_ns_max;                      // greatest delay of the thread at the end of a frame
    bool realtime;                             // whether the thread was granted real-time priority
    int32_t client_count;
    struct hub_client_report clients[HUB_CLIENTS];
};

// Makes a bus whose clients connect to LISTEN_FD, a listening non-blocking stream socket which the
// caller owns. Returns NULL, and errno, when there is no memory or no file descriptor.
struct hub_loop *hub_loop_new(int listen_fd, const struct hub_config *config);

// Runs until hub_loop_stop(), in one thread. Returns 0, or the errno that ended it.
int hub_loop_run(struct hub_loop *loop);

// Makes hub_loop_run() return; from any thread.
void hub_loop_stop(struct hub_loop *loop);

// Replaces the rules (hub_faults.h); from any thread, also before hub_loop_run().
void hub_loop_set_rules(struct hub_loop *loop, const struct hub_rule *rules, size_t count);

// Reads the counters; from any thread.
void hub_loop_report(struct hub_loop *loop, struct hub_report *report);

// Closes the clients' connections and frees everything; not while hub_loop_run() is running.
void hub_loop_free(struct hub_loop *loop);
// cffi: end

#endif
