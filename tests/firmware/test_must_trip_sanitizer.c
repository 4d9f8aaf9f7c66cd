// SPDX-License-Identifier: Apache-2.0
// Must end with a sanitizer's report: shows that the C tests run under working sanitizers.
#include <limits.h>

int main(int argc, char **argv) {
    (void)argv;
    int value = INT_MAX;
    value += argc; // signed overflow
    return value == 0;
}
