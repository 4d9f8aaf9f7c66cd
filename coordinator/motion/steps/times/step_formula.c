// SPDX-License-Identifier: Apache-2.0
// The table of formulas that coordinator/kinematics/*.c register.
#include "coordinator/motion/steps/times/step_formula.h"
#include "coordinator/motion/steps/steps.h"

#include <string.h>

// Where the linker puts the section's begin and end.
extern const struct step_formula *const table_begin[] __asm__("__start_step_formulas")
    __attribute__((visibility("hidden")));
extern const struct step_formula *const table_end[] __asm__("__stop_step_formulas")
    __attribute__((visibility("hidden")));

const struct step_formula *step_find_formula(const char *name) {
    // Both are names of the same section's ends.
    // cppcheck-suppress comparePointers
    for (const struct step_formula *const *entry = table_begin; entry < table_end; entry++)
        if (!strcmp((*entry)->name, name))
            return *entry;
    return NULL;
}
