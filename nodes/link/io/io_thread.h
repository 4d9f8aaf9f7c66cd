// SPDX-License-Identifier: Apache-2.0
// The I/O thread of a bus: drives its core (io_core.h) over a transport's file descriptor. The manual is in
// io_api.h.
//
// One mutex guards everything of one bus; the thread holds it except while it sleeps, and nothing blocks
// under it. The file descriptor io_notice_fd() becomes readable when io_take() has something.
#ifndef LINK_IO_THREAD_H
#define LINK_IO_THREAD_H

#include "nodes/link/io/io_api.h"

// cffi: begin
struct io_thread;

// Starts the thread. FD belongs to the caller, is non-blocking, and outlives the bus. NULL: no memory, or no
// thread.
struct io_thread *io_start(int fd, enum io_kind kind, const struct io_settings *settings);

// Ends and joins the thread, and frees the bus with its links.
void io_stop(struct io_thread *thread);

struct io_bus *io_thread_bus(struct io_thread *thread);
int io_notice_fd(struct io_thread *thread);
// cffi: end

#endif
