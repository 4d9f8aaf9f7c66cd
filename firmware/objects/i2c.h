// SPDX-License-Identifier: Apache-2.0
// Devices on an I2C bus. Transfers take their time and are for tasks and commands only.
#ifndef OBJECTS_I2C_H
#define OBJECTS_I2C_H

#include "core/node.h"

struct i2c;

// The i2c OID, or null after a shutdown.
struct i2c *i2c_find(struct node *node, uint32_t oid);
// Writes WRITE_SIZE bytes, then reads READ_SIZE bytes; returns BOARD_I2C_SUCCESS or what went wrong.
int i2c_transfer(struct node *node, const struct i2c *i2c, const uint8_t *write, size_t write_size,
                 uint8_t *read, size_t read_size);

#endif
