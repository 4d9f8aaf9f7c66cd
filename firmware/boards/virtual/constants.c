// SPDX-License-Identifier: Apache-2.0
// The constants in which variants of a virtual board differ; a build sets them with -D. The defaults are
// those of the mainboard.
#include "boards/virtual/virtual.h"

#ifndef VARIANT_CLOCK_FREQ
#define VARIANT_CLOCK_FREQ 168000000
#endif
#ifndef VARIANT_MCU
#define VARIANT_MCU "virtual-mainboard"
#endif
#ifndef VARIANT_MOVE_COUNT
#define VARIANT_MOVE_COUNT 1024
#endif

DECL_CONSTANT("CLOCK_FREQ", VARIANT_CLOCK_FREQ);
DECL_CONSTANT("MCU", VARIANT_MCU);
DECL_CONSTANT("CANBUS_FREQUENCY", 1000000);
DECL_CONSTANT("SERIAL_BAUD", 250000);

const struct virtual_variant virtual_variant = {
    .clock_freq = VARIANT_CLOCK_FREQ,
    .move_count = VARIANT_MOVE_COUNT,
};
