// SPDX-License-Identifier: Apache-2.0
// Declarations: a command, response, constant, task or hook is declared where it is implemented.
//
// In an ordinary compilation the macros give prototypes. Under -DCANDUCTOR_COLLECT, `gcc -E` turns them into
// marked lines which tools/gen_dictionary.py gathers from all sources of a build; it writes one C file with
// the tables of struct node_tables and the compressed dictionary. There is no central table to edit.
//
//   DECL_COMMAND(handler, "name p=%c", flags)   void handler(struct node *node, const struct wire_arg *args)
//   DECL_RESPONSE(symbol, "name p=%c")          sent with RESPOND(node, symbol, INT(p))
//   DECL_CONSTANT("NAME", value)                an integer or a string for the host
//   DECL_ENUMERATION("enum", "NAME", value)     a name for a value
//   DECL_ENUMERATION_RANGE("enum", "PA0", first, count)   PA0, PA1, … for first, first + 1, …
//   DECL_TASK(function)                         void function(struct node *node), round robin
//   DECL_INIT(function)                         likewise, once when the node starts
//   DECL_SHUTDOWN_HOOK(function)                likewise, in interrupt context when the node shuts down
//   DECL_STATIC_STRING(symbol, "Text")          a text reported by its number; used as STRING(symbol)
#ifndef CORE_DECLARE_H
#define CORE_DECLARE_H

enum {
    ALLOWED_IN_SHUTDOWN = 1, // runs although the node is shut down
    FREQUENT = 2,            // gets one of the ids that take one byte on the wire
};

#ifdef CANDUCTOR_COLLECT
#define DECLARE_(...) CANDUCTOR_DECLARE_BEGIN __VA_ARGS__ CANDUCTOR_DECLARE_END
#define DECL_COMMAND(handler, format, flags) DECLARE_("command", handler, format, flags)
#define DECL_RESPONSE(symbol, format) DECLARE_("response", symbol, format)
#define DECL_CONSTANT(name, value) DECLARE_("constant", name, value)
#define DECL_ENUMERATION(enumeration, name, value) DECLARE_("enumeration", enumeration, name, value)
#define DECL_ENUMERATION_RANGE(enumeration, name, first, count)                                              \
    DECLARE_("range", enumeration, name, first, count)
#define DECL_TASK(function) DECLARE_("task", function)
#define DECL_INIT(function) DECLARE_("init", function)
#define DECL_SHUTDOWN_HOOK(function) DECLARE_("hook", function)
#define DECL_STATIC_STRING(symbol, text) DECLARE_("string", symbol, text)
#else
#define DECL_COMMAND(handler, format, flags)                                                                 \
    void handler(struct node *node, const struct wire_arg *args);                                            \
    _Static_assert((flags) >= 0, format)
#define DECL_RESPONSE(symbol, format) extern const struct node_response response_##symbol
#define DECL_CONSTANT(name, value) _Static_assert(1, name)
#define DECL_ENUMERATION(enumeration, name, value) _Static_assert((value) >= 0, name)
#define DECL_ENUMERATION_RANGE(enumeration, name, first, count) _Static_assert((count) > 0, name)
#define DECL_TASK(function) void function(struct node *node)
#define DECL_INIT(function) void function(struct node *node)
#define DECL_SHUTDOWN_HOOK(function) void function(struct node *node)
#define DECL_STATIC_STRING(symbol, text) extern const uint16_t string_##symbol
#endif

#define STRING(symbol) string_##symbol

#endif
