// SPDX-License-Identifier: Apache-2.0
// Devices on the board's I2C buses: see i2c.h.
#include "objects/i2c.h"

#include "boards/board.h"

DECL_STATIC_STRING(i2c_no_bus, "Unsupported i2c bus");
DECL_STATIC_STRING(i2c_large, "i2c transfer too large");

DECL_ENUMERATION("i2c_bus_status", "SUCCESS", 0);
DECL_ENUMERATION("i2c_bus_status", "NACK", 1);
DECL_ENUMERATION("i2c_bus_status", "BUS_TIMEOUT", 2);
DECL_ENUMERATION("i2c_bus_status", "START_NACK", 3);
DECL_ENUMERATION("i2c_bus_status", "START_READ_NACK", 4);
_Static_assert(BOARD_I2C_SUCCESS == 0 && BOARD_I2C_START_READ_NACK == 4, "as the host knows them");

DECL_RESPONSE(i2c_response, "i2c_response oid=%c i2c_bus_status=%c response=%*s");

enum { READ_MAX = 48 }; // what an answer has room for

struct i2c {
    uint32_t bus, rate;
    uint8_t address, ready;
};

static const struct oid_type i2c_type = {"i2c"};

struct i2c *i2c_find(struct node *node, uint32_t oid) {
    return oid_find(node, oid, &i2c_type);
}

int i2c_transfer(struct node *node, const struct i2c *i2c, const uint8_t *write, size_t write_size,
                 uint8_t *read, size_t read_size) {
    if (!i2c->ready) {
        node_shutdown(node, STRING(i2c_no_bus));
        return BOARD_I2C_START_NACK;
    }
    return board_i2c_transfer(node, i2c->bus, i2c->address, write, write_size, read, read_size);
}

void command_config_i2c(struct node *node, const struct wire_arg *args) {
    oid_create(node, args[0].value, &i2c_type, sizeof(struct i2c));
}
DECL_COMMAND(command_config_i2c, "config_i2c oid=%c", 0);

void command_i2c_set_bus(struct node *node, const struct wire_arg *args) {
    struct i2c *i2c = i2c_find(node, args[0].value);
    if (!i2c)
        return;
    i2c->bus = args[1].value;
    i2c->rate = args[2].value;
    i2c->address = args[3].value & 0x7F;
    if (board_i2c_setup(node, i2c->bus, i2c->rate))
        node_shutdown(node, STRING(i2c_no_bus));
    else
        i2c->ready = 1;
}
DECL_COMMAND(command_i2c_set_bus, "i2c_set_bus oid=%c i2c_bus=%u rate=%u address=%u", 0);

void command_i2c_transfer(struct node *node, const struct wire_arg *args) {
    const struct i2c *i2c = i2c_find(node, args[0].value);
    if (!i2c)
        return;
    uint8_t read[READ_MAX];
    uint32_t size = args[2].value;
    if (size > READ_MAX) {
        node_shutdown(node, STRING(i2c_large));
        return;
    }
    int status = i2c_transfer(node, i2c, args[1].data, args[1].value, read, size);
    RESPOND(node, i2c_response, INT(args[0].value), INT(status), BYTES(read, status ? 0 : size));
}
DECL_COMMAND(command_i2c_transfer, "i2c_transfer oid=%c write=%*s read_len=%u", 0);
