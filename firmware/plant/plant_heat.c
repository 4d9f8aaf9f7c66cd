// SPDX-License-Identifier: Apache-2.0
// Heat. Bodies with a capacity lose heat to the surroundings and to each other, sensors follow their body
// with a lag: a linear system x' = m·x, solved exactly by x(t + dt) = exp(m·dt)·x while powers stay as they
// are. What is connected is one zone; each has its own, small matrix.
#include "plant/plant.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

enum { WIDTH = PLANT_ZONE_STATES + 1, TAYLOR_ORDER = 14 };

static const double S_PER_NS = 1e-9;

// ------------------------------------------------------------------------------------------ exp of a matrix

struct square {
    double at[WIDTH][WIDTH];
};

static void multiply(int n, const struct square *a, const struct square *b, struct square *out) {
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            double sum = 0;
            for (int k = 0; k < n; k++)
                sum += a->at[i][k] * b->at[k][j];
            out->at[i][j] = sum;
        }
}

static double largest_row_sum(int n, const struct square *a) {
    double largest = 0;
    for (int i = 0; i < n; i++) {
        double sum = 0;
        for (int j = 0; j < n; j++)
            sum += fabs(a->at[i][j]);
        largest = fmax(largest, sum);
    }
    return largest;
}

// exp(a) of n rows: halved until its norm is below 1/2, where the series of order 14 is exact to 1e-16 or
// so, then squared as often.
static void exponential(int n, struct square *a, struct square *out) {
    int halvings = 0;
    frexp(largest_row_sum(n, a), &halvings); // norm < 2^halvings
    halvings = halvings + 1 > 0 ? halvings + 1 : 0;
    double scale = ldexp(1.0, -halvings);
    struct square sum = {0}, other;
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < n; j++)
            a->at[i][j] *= scale;
        sum.at[i][i] = 1;
    }
    for (int k = TAYLOR_ORDER; k > 0; k--) { // Horner: 1 + a/1·(1 + a/2·(1 + …))
        multiply(n, a, &sum, &other);
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++)
                sum.at[i][j] = other.at[i][j] / k + (i == j);
    }
    for (; halvings > 0; halvings--) {
        multiply(n, &sum, &sum, &other);
        sum = other;
    }
    *out = sum;
}

// ------------------------------------------------------------------------------------------ the equations

static double heat_into(const struct plant *plant, int body) {
    double power = 0;
    for (int i = 0; i < plant->heater_count; i++)
        if (plant->heaters[i].body == body)
            power += plant->heaters[i].power * plant->heaters[i].duty;
    return power;
}

static double loss_of(const struct plant *plant, int body) {
    double loss = plant->bodies[body].loss;
    for (int i = 0; i < plant->cooling_count; i++)
        if (plant->coolings[i].body == body)
            loss += plant->coolings[i].conductance * plant->coolings[i].duty;
    return loss;
}

static void make_body(const struct plant *plant, struct plant_zone *zone, int number) {
    const struct plant_body *body = &plant->bodies[number];
    double *row = zone->m[body->state], loss = loss_of(plant, number);
    row[body->state] -= loss / body->capacity;
    row[zone->count] += (heat_into(plant, number) + loss * plant->ambient) / body->capacity;
    for (int i = 0; i < plant->couple_count; i++) {
        const struct plant_couple *couple = &plant->couples[i];
        if (couple->a != number && couple->b != number)
            continue;
        int other = couple->a == number ? couple->b : couple->a;
        row[plant->bodies[other].state] += couple->conductance / body->capacity;
        row[body->state] -= couple->conductance / body->capacity;
    }
}

static void make_sensor(const struct plant *plant, struct plant_zone *zone,
                        const struct plant_sensor *sensor) {
    double *row = zone->m[sensor->state];
    row[sensor->state] -= 1 / sensor->lag;
    if (sensor->fault == PLANT_FALLEN)
        row[zone->count] += plant->ambient / sensor->lag;
    else if (sensor->body.peer >= 0)
        row[zone->count] += sensor->remote / sensor->lag;
    else
        row[plant->bodies[sensor->body.found].state] += 1 / sensor->lag;
}

static void make_zone(const struct plant *plant, struct plant_zone *zone) {
    memset(zone->m, 0, sizeof(zone->m));
    for (int i = 0; i < plant->body_count; i++)
        if (&plant->zones[plant->bodies[i].zone] == zone)
            make_body(plant, zone, i);
    for (int i = 0; i < plant->sensor_count; i++)
        if (plant->sensors[i].lag > 0 && &plant->zones[plant->sensors[i].zone] == zone)
            make_sensor(plant, zone, &plant->sensors[i]);
    zone->stale = 0;
    zone->step_ns = 0;
}

static void advance(const struct plant *plant, struct plant_zone *zone, uint64_t ns) {
    if (ns <= zone->at_ns || !zone->count)
        return;
    if (zone->stale)
        make_zone(plant, zone);
    uint64_t step_ns = ns - zone->at_ns;
    int n = zone->count + 1;
    if (step_ns != zone->step_ns) { // samples and pulses come at even distances: often it is known already
        struct square a = {0}, result;
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++)
                a.at[i][j] = zone->m[i][j] * ((double)step_ns * S_PER_NS);
        exponential(n, &a, &result);
        memcpy(zone->step, result.at, sizeof(zone->step));
        zone->step_ns = step_ns;
    }
    double x[WIDTH];
    for (int i = 0; i < n; i++) {
        x[i] = 0;
        for (int j = 0; j < n; j++)
            x[i] += zone->step[i][j] * zone->x[j];
    }
    memcpy(zone->x, x, (size_t)zone->count * sizeof(*x));
    zone->at_ns = ns;
}

static void add_energy(struct plant *plant, uint64_t ns) {
    for (int i = 0; i < plant->heater_count; i++) {
        struct plant_heater *heater = &plant->heaters[i];
        uint64_t at_ns = plant->zones[plant->bodies[heater->body].zone].at_ns;
        if (ns > at_ns)
            heater->energy += heater->power * heater->duty * (double)(ns - at_ns) * S_PER_NS;
    }
}

void plant_heat_advance(struct plant *plant, uint64_t ns) {
    add_energy(plant, ns);
    for (int i = 0; i < plant->zone_count; i++)
        advance(plant, &plant->zones[i], ns);
}

void plant_heat_changed(struct plant *plant, int body) {
    plant->zones[plant->bodies[body].zone].stale = 1;
}

double plant_body_temperature(const struct plant *plant, int body) {
    return plant->zones[plant->bodies[body].zone].x[plant->bodies[body].state];
}

double plant_sensor_temperature(const struct plant *plant, const struct plant_sensor *sensor) {
    if (sensor->lag > 0)
        return plant->zones[sensor->zone].x[sensor->state];
    if (sensor->fault == PLANT_FALLEN)
        return plant->ambient;
    if (sensor->body.peer >= 0)
        return sensor->remote;
    return plant_body_temperature(plant, sensor->body.found);
}

// ------------------------------------------------------------------------------------------ being made

static void join_zones(struct plant *plant, int to, int from) {
    for (int i = 0; i < plant->body_count; i++)
        if (plant->bodies[i].zone == from)
            plant->bodies[i].zone = to;
}

// Takes a place in the zone for a state that begins with VALUE; -1: it is full.
static int add_state(struct plant_zone *zone, double value) {
    if (zone->count == PLANT_ZONE_STATES)
        return -1;
    zone->x[zone->count] = value;
    return zone->count++;
}

static int add_states(struct plant *plant) {
    int full = 0;
    for (int i = 0; i < plant->body_count; i++) {
        struct plant_body *body = &plant->bodies[i];
        full |= (body->state = add_state(&plant->zones[body->zone], body->start)) < 0;
    }
    for (int i = 0; i < plant->sensor_count; i++) {
        struct plant_sensor *sensor = &plant->sensors[i];
        const struct plant_body *body = sensor->body.peer < 0 ? &plant->bodies[sensor->body.found] : NULL;
        sensor->zone = body ? body->zone : plant->body_count + i;
        sensor->remote = plant->ambient;
        double start = body ? body->start : plant->ambient;
        if (sensor->lag > 0)
            full |= (sensor->state = add_state(&plant->zones[sensor->zone], start)) < 0;
    }
    return full ? -1 : 0;
}

int plant_heat_make(struct plant *plant, char *error) {
    for (int i = 0; i < plant->body_count; i++)
        plant->bodies[i].zone = i;
    for (int i = 0; i < plant->couple_count; i++)
        join_zones(plant, plant->bodies[plant->couples[i].a].zone, plant->bodies[plant->couples[i].b].zone);
    plant->zone_count = plant->body_count + plant->sensor_count;
    if (add_states(plant)) {
        snprintf(error, PLANT_ERROR, "more than %d coupled bodies and their sensors; leave couples out",
                 PLANT_ZONE_STATES);
        return -1;
    }
    for (int i = 0; i < plant->zone_count; i++) {
        plant->zones[i].x[plant->zones[i].count] = 1;
        plant->zones[i].stale = 1;
    }
    return 0;
}
