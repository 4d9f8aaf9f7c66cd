// SPDX-License-Identifier: Apache-2.0
// Commands in, responses out: between the content of blocks and typed arguments.
#include <string.h>

#include "core/link.h"
#include "core/tables.h"

DECL_STATIC_STRING(invalid_command, "Invalid command");
DECL_STATIC_STRING(parser_error, "Command parser error");
DECL_STATIC_STRING(encode_error, "Message encode error");
DECL_RESPONSE(is_shutdown, "is_shutdown static_string_id=%hu");

static const struct command *find(uint32_t id) {
    int64_t index = (int64_t)(int32_t)id - node_tables.first_id;
    if (index < 0 || index >= node_tables.command_count || !node_tables.commands[index].run)
        return NULL;
    return &node_tables.commands[index];
}

void command_dispatch(struct node *node, const uint8_t *content, size_t length) {
    const uint8_t *at = content, *end = content + length;
    struct wire_arg args[MESSAGE_ARGS_MAX];
    while (at < end) {
        uint32_t id;
        const struct command *command = wire_vlq_decode(&at, end, &id) ? NULL : find(id);
        if (!command) {
            // Where the next command begins is unknown now, so the rest of the block is lost too.
            node_shutdown(node, string_invalid_command);
            return;
        }
        if (wire_unpack(command->types, command->count, &at, end, args)) {
            node_shutdown(node, string_parser_error);
            return;
        }
        if (node->is_shutdown && !(command->flags & COMMAND_IN_SHUTDOWN))
            RESPOND(node, is_shutdown, ARG(node->shutdown_reason));
        else
            command->run(node, args);
    }
}

void node_respond(struct node *node, const struct response *response, const struct wire_arg *args,
                  size_t count) {
    uint8_t block[WIRE_BLOCK_MAX];
    size_t used = wire_vlq_encode(block + WIRE_HEADER, response->id);
    size_t packed = 0;
    if (count == response->count && count)
        packed = wire_pack(response->types, count, args, block + WIRE_HEADER + used, WIRE_CONTENT_MAX - used);
    if (count != response->count || (count && !packed)) {
        node_shutdown(node, string_encode_error);
        return;
    }
    link_send(node, block, used + packed);
}
