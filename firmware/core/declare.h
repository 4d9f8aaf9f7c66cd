// SPDX-License-Identifier: Apache-2.0
// Declarations: what a module offers is declared beside its implementation and collected at build time.
//
// For the compiler each macro is an ordinary declaration (so a wrong signature is a compile error). Under
// -DCANDUCTOR_COLLECT it becomes a marker that tools/gen_dictionary.py reads from the preprocessor's output;
// from all markers it makes the one C file with the tables of core/tables.h. Use them at file scope of a .c
// file and end them with a semicolon.
#ifndef CORE_DECLARE_H
#define CORE_DECLARE_H

// Command flags.
#define COMMAND_IN_SHUTDOWN 1 // is obeyed while the node is shut down
#define COMMAND_FREQUENT 2    // gets one of the one-byte ids

#ifdef CANDUCTOR_COLLECT
// clang-format off: it would take the markers apart
#define DECL_COMMAND_FLAGS(function, flags, format) @@command(function, flags, format)@@
#define DECL_RESPONSE(name, format) @@response(name, format)@@
#define DECL_CONSTANT(name, value) @@constant(name, value)@@
#define DECL_CONSTANT_STR(name, text) @@constant_str(name, text)@@
#define DECL_ENUMERATION_RANGE(of, name, value, count) @@enumeration(of, name, value, count)@@
#define DECL_STATIC_STRING(name, text) @@string(name, text)@@
#define DECL_TASK(function) @@task(function)@@
#define DECL_INIT(function) @@init(function)@@
#define DECL_SHUTDOWN_HOOK(function) @@shutdown(function)@@
// clang-format on
#else
// void FUNCTION(struct node *, const struct wire_arg *) obeys the command FORMAT; one argument per parameter.
#define DECL_COMMAND_FLAGS(function, flags, format)                                                          \
    void function(struct node *node, const struct wire_arg *args)
// A response NAME, sent by RESPOND(node, NAME, ...). FORMAT begins with NAME.
#define DECL_RESPONSE(name, format) extern const struct response response_##name
// A named number or text of the dictionary. VALUE is an integer constant the preprocessor can resolve.
#define DECL_CONSTANT(name, value) struct node
#define DECL_CONSTANT_STR(name, text) struct node
// COUNT names beginning with NAME ("PA0", "PA1", ...) stand for VALUE and the numbers after it.
#define DECL_ENUMERATION_RANGE(of, name, value, count) struct node
// A text that travels as a number; string_NAME is the number. The same pair may be declared in several files.
#define DECL_STATIC_STRING(name, text) extern const uint16_t string_##name
// void FUNCTION(struct node *) runs, with interrupts on, some time after WAKE(node, FUNCTION).
#define DECL_TASK(function)                                                                                  \
    void function(struct node *node);                                                                        \
    extern const uint8_t function##_index
// void FUNCTION(struct node *) runs once at start (after the core is up) ...
#define DECL_INIT(function) void function(struct node *node)
// ... or whenever the node shuts down, with all timers already stopped: outputs go to their defaults.
#define DECL_SHUTDOWN_HOOK(function) void function(struct node *node)
#endif

#define DECL_COMMAND(function, format) DECL_COMMAND_FLAGS(function, 0, format)
#define DECL_ENUMERATION(of, name, value) DECL_ENUMERATION_RANGE(of, name, value, 1)

#endif
