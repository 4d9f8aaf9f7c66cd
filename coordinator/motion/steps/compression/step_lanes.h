// SPDX-License-Identifier: Apache-2.0
// Vectors for the loops over steps, of single precision as wide as a register. The same arithmetic lane by
// lane on every processor, so every machine makes the same segments.
#ifndef MOTION_STEP_LANES_H
#define MOTION_STEP_LANES_H

#include <stdbool.h>
#include <stdint.h>
#include <string.h>

// What is compiled once more for another processor has another name there.
#ifndef VARIANT
#define VARIANT(name) name
#endif

#ifdef __AVX2__
enum { WIDE = 8 };
#else // x86-64, AArch64
enum { WIDE = 4 };
#endif
enum { QUAD = 4 };
typedef float vector __attribute__((vector_size(WIDE * sizeof(float))));
typedef float four __attribute__((vector_size(QUAD * sizeof(float))));
typedef double quad __attribute__((vector_size(QUAD * sizeof(double))));

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

static inline vector all(float x) {
    return x - (vector){0};
}

// The greatest whole numbers that are not above V, for magnitudes below 2^22.
static inline vector floors(vector v) {
    const float whole = 0x1.8p23F; // so large that nothing behind the point is left
    const vector near = v + whole - whole;
    return near + __builtin_convertvector(near > v, vector);
}

struct range {
    float least, most;
};

// The larger and the smaller of two, lane by lane. Compilers make one instruction of the scalar form only,
// and look at lane after lane when they compare vectors wider than a register.
#ifdef __AVX2__
static const vector COUNTING = {1, 2, 3, 4, 5, 6, 7, 8};

static inline vector larger(vector a, vector b) {
    return __builtin_ia32_maxps256(a, b);
}

static inline vector smaller(vector a, vector b) {
    return __builtin_ia32_minps256(a, b);
}

static inline quad larger_quad(quad a, quad b) {
    return __builtin_ia32_maxpd256(a, b);
}

static inline quad smaller_quad(quad a, quad b) {
    return __builtin_ia32_minpd256(a, b);
}

static inline bool any_above_0(quad v) {
    return __builtin_ia32_movmskpd256((quad)(v > 0)) != 0;
}

static inline int not_above(vector a, vector b) {
    return __builtin_ia32_movmskps256((vector)(a <= b));
}

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

// In each lane the largest of it and those before.
static inline vector largest_so_far(vector v) {
    v = larger(v, __builtin_shufflevector(v, v, 0, 0, 1, 2, 3, 4, 5, 6));
    v = larger(v, __builtin_shufflevector(v, v, 0, 1, 0, 1, 2, 3, 4, 5));
    return larger(v, __builtin_shufflevector(v, v, 0, 1, 2, 3, 0, 1, 2, 3));
}

#else

static const vector COUNTING = {1, 2, 3, 4};

typedef double pair __attribute__((vector_size(16)));

#ifdef __SSE2__
static inline vector larger(vector a, vector b) {
    return __builtin_ia32_maxps(a, b);
}

static inline vector smaller(vector a, vector b) {
    return __builtin_ia32_minps(a, b);
}

static inline pair larger_pair(pair a, pair b) {
    return __builtin_ia32_maxpd(a, b);
}
#else
typedef int32_t selection __attribute__((vector_size(16)));
typedef int64_t pair_selection __attribute__((vector_size(16)));

static inline vector larger(vector a, vector b) {
    const selection keep = a > b;
    return (vector)(((selection)a & keep) | ((selection)b & ~keep));
}

static inline vector smaller(vector a, vector b) {
    const selection keep = a < b;
    return (vector)(((selection)a & keep) | ((selection)b & ~keep));
}

static inline pair larger_pair(pair a, pair b) {
    const pair_selection keep = a > b;
    return (pair)(((pair_selection)a & keep) | ((pair_selection)b & ~keep));
}
#endif

static inline int not_above(vector a, vector b) {
    int which = 0;
    for (int lane = 0; lane < WIDE; lane++)
        which |= (a[lane] <= b[lane]) << lane;
    return which;
}

static inline quad larger_quad(quad a, quad b) {
    const pair low = larger_pair(__builtin_shufflevector(a, a, 0, 1), __builtin_shufflevector(b, b, 0, 1)),
               high = larger_pair(__builtin_shufflevector(a, a, 2, 3), __builtin_shufflevector(b, b, 2, 3));
    return __builtin_shufflevector(low, high, 0, 1, 2, 3);
}

static inline quad smaller_quad(quad a, quad b) {
    return -larger_quad(-a, -b);
}

static inline bool any_above_0(quad v) {
    const pair most = larger_pair(__builtin_shufflevector(v, v, 0, 1), __builtin_shufflevector(v, v, 2, 3));
    return (most[0] > 0) | (most[1] > 0);
}

// The largest of LEAST and the smallest of MOST.
static inline struct range narrowest(vector least, vector most) {
    most = -most;
    // Two lanes of each side by side, so that both are searched at once.
    vector a = larger(__builtin_shufflevector(least, most, 0, 1, 4, 5),
                      __builtin_shufflevector(least, most, 2, 3, 6, 7));
    a = larger(a, __builtin_shufflevector(a, a, 1, 0, 3, 2));
    return (struct range){a[0], -a[2]};
}

// In each lane the largest of it and those before.
static inline vector largest_so_far(vector v) {
    v = larger(v, __builtin_shufflevector(v, v, 0, 0, 1, 2));
    return larger(v, __builtin_shufflevector(v, v, 0, 1, 0, 1));
}
#endif

#endif
