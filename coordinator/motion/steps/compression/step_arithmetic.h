// SPDX-License-Identifier: Apache-2.0
// The loops over steps in the form that suits this machine's processor.
#ifndef MOTION_STEP_ARITHMETIC_H
#define MOTION_STEP_ARITHMETIC_H

#include "coordinator/motion/steps/compression/step_bands.h"
#include "coordinator/motion/steps/compression/step_fit.h"

struct step_arithmetic {
    void (*fit_find)(const struct fit_problem *p, struct fit *f);
    bool (*fit_make)(const struct fit_problem *p, struct fit *f, int end, struct fit_segment *s);
    double (*bands)(const struct step_bands *b);
    bool (*replay)(const struct replay *r, double *worst);
};

const struct step_arithmetic *step_arithmetic(void);

#endif
