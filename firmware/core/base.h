// SPDX-License-Identifier: Apache-2.0
// The commands every node has; what core/node.c needs of them.
#ifndef CORE_BASE_H
#define CORE_BASE_H

#include "core/node.h"

enum { STATS_SUMSQ_BASE = 256, STATS_PERIOD_S = 5 };

// Begins the housekeeping and announces `starting`.
void base_start(struct node *node);
// Puts the housekeeping timer back after all timers were forgotten.
void base_restart_housekeeping(struct node *node);
// Has a task report the shutdown.
void base_report_shutdown(struct node *node);

#endif
