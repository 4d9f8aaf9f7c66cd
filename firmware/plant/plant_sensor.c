// SPDX-License-Identifier: Apache-2.0
// From a sensor's temperature to what the converter gives.
#include "plant/plant.h"

#include <math.h>

enum { NEWTON_STEPS = 40, SENSOR_NOISE = 1000 };

static const double ZERO_C = 273.15, ABSOLUTE_MIN = 1.0;

// ln(R) with 1/T = c1 + c2·ln R + c3·ln³R. It rises with 1/T, so Newton's method finds the only solution.
static double steinhart_log(const struct plant_sensor *sensor, double kelvin) {
    double log_r = (1 / kelvin - sensor->c1) / sensor->c2;
    for (int i = 0; i < NEWTON_STEPS; i++) {
        double value = sensor->c1 + sensor->c2 * log_r + sensor->c3 * log_r * log_r * log_r - 1 / kelvin;
        double step = value / (sensor->c2 + 3 * sensor->c3 * log_r * log_r);
        log_r -= step;
        if (fabs(step) < 1e-13 * fabs(log_r))
            break;
    }
    return log_r;
}

static double resistance(const struct plant_sensor *sensor, double temperature) {
    double kelvin = fmax(temperature + ZERO_C, ABSOLUTE_MIN);
    if (sensor->curve == PLANT_STEINHART)
        return exp(steinhart_log(sensor, kelvin));
    if (sensor->curve == PLANT_RTD)
        return sensor->r0 * (1 + sensor->a * temperature + sensor->b * temperature * temperature);
    return sensor->r0 * exp(sensor->beta * (1 / kelvin - 1 / (sensor->t0 + ZERO_C)));
}

static double from_table(const struct plant_sensor *sensor, double temperature) {
    int at = 0;
    while (at < sensor->point_count && sensor->celsius[at] < temperature)
        at++;
    if (at == 0 || at == sensor->point_count)
        return sensor->point_count ? sensor->ratio[at ? at - 1 : 0] : 0;
    double width = sensor->celsius[at] - sensor->celsius[at - 1];
    double share = (temperature - sensor->celsius[at - 1]) / width;
    return sensor->ratio[at - 1] + share * (sensor->ratio[at] - sensor->ratio[at - 1]);
}

// The voltage as a share of the converter's reference.
double plant_sensor_ratio(const struct plant_sensor *sensor, double temperature) {
    if (sensor->fault == PLANT_OPEN)
        return 1;
    if (sensor->fault == PLANT_SHORTED)
        return 0;
    if (sensor->curve == PLANT_LINEAR)
        return sensor->zero + sensor->slope * temperature;
    if (sensor->curve == PLANT_TABLE)
        return from_table(sensor, temperature);
    double ohm = resistance(sensor, temperature);
    return isinf(ohm) ? 1 : ohm / (ohm + sensor->pullup);
}

uint16_t plant_sensor_sample(struct plant *plant, struct plant_sensor *sensor) {
    double levels = ldexp(1.0, sensor->bits) - 1;
    double ratio = plant_sensor_ratio(sensor, plant_sensor_temperature(plant, sensor));
    double noise =
        sensor->noise * plant_normal(plant, SENSOR_NOISE + (uint64_t)sensor->pin, sensor->samples++);
    double level = rint(ratio * levels + noise); // the nearest of the steps it has
    double value = fmin(fmax(level, 0), levels) / levels * plant->adc_max;
    return (uint16_t)lrint(value);
}

// ------------------------------------------------------------------------------------------------- chance

// splitmix64 of all that decides.
static uint64_t scramble(uint64_t z) {
    z += 0x9E3779B97F4A7C15u;
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
    return z ^ (z >> 31);
}

// 0 < result < 1
static double unit(const struct plant *plant, uint64_t who, uint64_t nth) {
    uint64_t bits = scramble(scramble(scramble((uint64_t)plant->seed) ^ who) ^ nth);
    return ((double)(bits >> 12) + 0.5) * 0x1p-52;
}

double plant_even(const struct plant *plant, uint64_t who, uint64_t nth) {
    return 2 * unit(plant, who, nth) - 1;
}

double plant_normal(const struct plant *plant, uint64_t who, uint64_t nth) {
    double radius = sqrt(-2 * log(unit(plant, who, 2 * nth)));
    return radius * cos(2 * 3.14159265358979323846 * unit(plant, who, 2 * nth + 1));
}
