// SPDX-License-Identifier: Apache-2.0
// Vectors for the loops over steps: one register each with AVX2, more with the baseline of x86-64 and
// AArch64. The same arithmetic either way, so every machine makes the same segments.
#ifndef MOTION_STEP_LANES_H
#define MOTION_STEP_LANES_H

#include <stdbool.h>
#include <stdint.h>
#include <string.h>

// What is compiled once more for another processor has another name there.
#ifndef VARIANT
#define VARIANT(name) name
#endif

typedef float vector __attribute__((vector_size(32)));
typedef int32_t selection __attribute__((vector_size(32)));
typedef double quad __attribute__((vector_size(32)));
typedef int64_t quad_selection __attribute__((vector_size(32)));
typedef float half_vector __attribute__((vector_size(16)));
enum { WIDE = 8, QUAD = 4 };

static inline vector load(const float *at) {
    vector v;
    memcpy(&v, at, sizeof(v));
    return v;
}

static inline void store(float *at, const vector *v) {
    memcpy(at, v, sizeof(*v));
}

static inline quad load_quad(const double *at) {
    quad v;
    memcpy(&v, at, sizeof(v));
    return v;
}

static inline bool any(quad_selection v) {
#ifdef __AVX2__
    return __builtin_ia32_movmskpd256((quad)v) != 0;
#else
    return (v[0] | v[1] | v[2] | v[3]) != 0;
#endif
}

static inline vector all(float x) {
    return x - (vector){0};
}

// Compilers make one instruction of the scalar form only.
static inline vector larger(vector a, vector b) {
#ifdef __AVX2__
    return __builtin_ia32_maxps256(a, b);
#else
    const selection keep = a > b;
    return (vector)(((selection)a & keep) | ((selection)b & ~keep));
#endif
}

static inline vector smaller(vector a, vector b) {
#ifdef __AVX2__
    return __builtin_ia32_minps256(a, b);
#else
    const selection keep = a < b;
    return (vector)(((selection)a & keep) | ((selection)b & ~keep));
#endif
}

static inline quad smaller_quad(quad a, quad b) {
#ifdef __AVX2__
    return __builtin_ia32_minpd256(a, b);
#else
    const quad_selection keep = a < b;
    return (quad)(((quad_selection)a & keep) | ((quad_selection)b & ~keep));
#endif
}

struct range {
    float least, most;
};

// The largest of LEAST and the smallest of MOST.
static inline struct range narrowest(vector least, vector most) {
    most = -most;
    // Four lanes of each side by side, so that both are searched at once.
    vector a = larger(__builtin_shufflevector(least, most, 0, 1, 2, 3, 8, 9, 10, 11),
                      __builtin_shufflevector(least, most, 4, 5, 6, 7, 12, 13, 14, 15));
    a = larger(a, __builtin_shufflevector(a, a, 2, 3, 0, 1, 6, 7, 4, 5));
    a = larger(a, __builtin_shufflevector(a, a, 1, 0, 3, 2, 5, 4, 7, 6));
    return (struct range){a[0], -a[4]};
}

#endif
