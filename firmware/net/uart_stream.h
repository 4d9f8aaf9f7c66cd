// SPDX-License-Identifier: Apache-2.0
// A node on a UART. What arrives goes to link_receive() as it is.
#ifndef NET_UART_STREAM_H
#define NET_UART_STREAM_H

#include "core/node.h"

extern const struct transport uart_stream_transport;

#endif
