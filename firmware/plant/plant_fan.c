// SPDX-License-Identifier: Apache-2.0
// A fan's speed follows its duty with a lag; the turns it makes are the exact integral of that.
#include "plant/plant.h"

#include <math.h>

static const double S_PER_NS = 1e-9, S_PER_MIN = 60;

void plant_fan_advance(struct plant_fan *fan, uint64_t ns) {
    if (ns <= fan->at_ns)
        return;
    double dt = (double)(ns - fan->at_ns) * S_PER_NS;
    double missing = fan->speed - fan->duty;
    double left = fan->lag > 0 ? exp(-dt / fan->lag) : 0;
    fan->turns += fan->rpm / S_PER_MIN * (fan->duty * dt + missing * fan->lag * (1 - left));
    fan->speed = fan->duty + missing * left;
    fan->at_ns = ns;
}

int plant_fan_tach(struct plant_fan *fan, uint64_t ns) {
    plant_fan_advance(fan, ns);
    double periods = fan->turns * fan->pulses;
    return periods - floor(periods) >= 0.5;
}
