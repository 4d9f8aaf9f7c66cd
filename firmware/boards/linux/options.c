// SPDX-License-Identifier: Apache-2.0
// The command line.
#include "boards/linux/linux.h"

#include <ctype.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { USAGE = 2 };

static const char usage[] =
    "usage: %s (--can SOCKET | --socketcan INTERFACE | --uart LINK) [--uuid HEX12] [--rate-ppm X]\n"
    "       [--start-clock N] [--jitter-us J] [--seed S] [--slice-us N] [--edge-log FILE]\n"
    "       [--legacy 0|1] [--plant FILE] [--plant-log 0|1]\n"
    "A virtual node: canductor firmware as a process on a virtual CAN bus, SocketCAN or a pseudo-terminal.\n";

static int complain(const char *program, const char *option, const char *value, const char *wanted) {
    fprintf(stderr, "%s: %s %s: expected %s\n", program, option, value, wanted);
    return USAGE;
}

static int parse_uuid(const char *text, uint8_t uuid[NODE_UUID_SIZE]) {
    if (strlen(text) != 2UL * NODE_UUID_SIZE ||
        strspn(text, "0123456789abcdefABCDEF") != 2UL * NODE_UUID_SIZE)
        return -1;
    for (size_t i = 0; i < NODE_UUID_SIZE; i++) {
        char digits[3] = {text[2 * i], text[2 * i + 1], 0};
        uuid[i] = (uint8_t)strtoul(digits, NULL, 16);
    }
    return 0;
}

static int parse_count(const char *text, uint64_t limit, uint64_t *out) {
    char *end;
    errno = 0;
    *out = strtoull(text, &end, 10);
    return errno || *end || !isdigit((unsigned char)*text) || *out > limit ? -1 : 0;
}

static int parse_ppm(const char *text, double *out) {
    char *end;
    *out = strtod(text, &end);
    return *end || end == text || !(*out > -100000.0 && *out < 100000.0) ? -1 : 0;
}

// Takes one option with its value; returns what was wrong with the value, "" for an unknown option, or null.
static const char *take(struct options *options, const char *name, const char *value) {
    static const struct {
        const char *name;
        enum link_kind kind;
    } links[] = {{"--can", LINK_VIRTUAL_CAN}, {"--socketcan", LINK_SOCKETCAN}, {"--uart", LINK_UART}};
    for (size_t i = 0; i < sizeof(links) / sizeof(*links); i++)
        if (strcmp(name, links[i].name) == 0) {
            if (options->link)
                return "only one of --can, --socketcan, --uart";
            options->link = links[i].kind;
            options->target = value;
            return NULL;
        }
    if (strcmp(name, "--edge-log") == 0) {
        options->edge_log = value;
        return NULL;
    }
    if (strcmp(name, "--plant") == 0) {
        options->plant = value;
        return NULL;
    }
    if (strcmp(name, "--uuid") == 0)
        return parse_uuid(value, options->uuid) ? "12 hex digits" : NULL;
    if (strcmp(name, "--rate-ppm") == 0)
        return parse_ppm(value, &options->rate_ppm) ? "parts per million, at most 100000 either way" : NULL;
    if (strcmp(name, "--start-clock") == 0)
        return parse_count(value, (1ull << 47) - 1, &options->start_clock) ? "ticks below 2^47" : NULL;
    if (strcmp(name, "--jitter-us") == 0)
        return parse_count(value, 10000000, &options->jitter_us) ? "0 to 10000000 microseconds" : NULL;
    if (strcmp(name, "--slice-us") == 0)
        return parse_count(value, 1000000, &options->slice_us) ? "0 to 1000000 microseconds" : NULL;
    if (strcmp(name, "--legacy") == 0)
        return parse_count(value, 1, &options->legacy) ? "1 for firmware without CAN extensions, or 0" : NULL;
    if (strcmp(name, "--plant-log") == 0)
        return parse_count(value, 1, &options->plant_log) ? "1 for a log of the plant, or 0" : NULL;
    if (strcmp(name, "--seed") == 0)
        return parse_count(value, UINT64_MAX, &options->seed) ? "a number" : NULL;
    return "";
}

int options_parse(struct options *options, int argc, char **argv) {
    *options = (struct options){.slice_us = 500, .plant_log = 1};
    for (int i = 1; i < argc; i += 2) {
        if (strcmp(argv[i], "--help") == 0) {
            printf(usage, argv[0]);
            exit(0);
        }
        if (i + 1 == argc) {
            fprintf(stderr, "%s: %s needs a value, or is no option (--help lists them)\n", argv[0], argv[i]);
            return USAGE;
        }
        const char *wanted = take(options, argv[i], argv[i + 1]);
        if (wanted && !*wanted) {
            fprintf(stderr, "%s: there is no option %s (--help lists them)\n", argv[0], argv[i]);
            return USAGE;
        }
        if (wanted)
            return complain(argv[0], argv[i], argv[i + 1], wanted);
    }
    if (!options->link) {
        fprintf(stderr, "%s: one of --can SOCKET, --socketcan INTERFACE or --uart LINK is needed\n", argv[0]);
        return USAGE;
    }
    return 0;
}
