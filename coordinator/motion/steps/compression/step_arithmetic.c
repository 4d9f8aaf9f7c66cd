// SPDX-License-Identifier: Apache-2.0
#include "coordinator/motion/steps/compression/step_arithmetic.h"

static const struct step_arithmetic BASELINE = {step_fit_find, step_fit_make, step_bands, step_replay};

#if defined(__x86_64__) && !defined(__clang__)

#pragma GCC target("avx2")
#define VARIANT(name) name##_avx2
#include "coordinator/motion/steps/compression/step_bands.c"
#include "coordinator/motion/steps/compression/step_fit.c"

static const struct step_arithmetic AVX2 = {step_fit_find_avx2, step_fit_make_avx2, step_bands_avx2,
                                            step_replay_avx2};

const struct step_arithmetic *step_arithmetic(void) {
    return __builtin_cpu_supports("avx2") ? &AVX2 : &BASELINE;
}

#else

const struct step_arithmetic *step_arithmetic(void) {
    return &BASELINE;
}

#endif
