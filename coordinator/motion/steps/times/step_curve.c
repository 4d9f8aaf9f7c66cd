// SPDX-License-Identifier: Apache-2.0
// Steps of shaped, smoothed and non-linear steppers. Between the borders of all phases that a stepper sees,
// its axes are polynomials of time, made afresh from the moves at each piece's begin, so that no error adds
// up. A piece is cut into spans in which the stepper does not turn. Shaped linear steppers have constant
// acceleration there: the closed form of step_times.c. The others are solved by safeguarded Newton.
#include "coordinator/motion/steps/step_internal.h"

#include <string.h>

static const double FURTHEST_STEPS = 1e12;
static const double JUMP_STEPS = 0.51;
static const double SPAN_S = 0.002;  // in which a non-linear stepper turns at most once
static const double EXACT_S = 1e-10; // of a solution
static const int ITERATIONS = 80;
static const double CLOSE_S = 1e-8; // a change by Newton after which the next would be far below EXACT_S
enum { NEWTONS = 4, SOLVED = 256 };
static const double LEVEL_MM = 1e-9;             // less is rounding of a Z that stays
static const double ROOM = 0.5 - 2.0 / STEP_TIE; // steps that a stepper may be off before one may be decided
static const double SURE = 0.9; // of the time to a step: the rest is for the bends of the bed

struct piece {
    double begin, seconds;
    double axis[AXES][3]; // mm; powers of the time since BEGIN
    double poly[5];       // steps, of a linear stepper
    bool linear, smooth, still;
};

// Where a stepper is at a time of a piece.
struct moment {
    double t;         // s since the piece's begin
    double at, speed; // steps since init, steps/s
    double slope[2];  // of the bed along X and Y, where it is followed
};

// The position since init at TIME after the piece's begin, in steps, and its speed; SLOPE: of the bed, or
// NULL.
static double evaluate_over(const struct step_gen *gen, const struct stepper *s, const struct piece *p,
                            double t, double *speed, double slope[2]) {
    const double *c = p->poly;
    if (p->linear) {
        *speed = c[1] + t * (2 * c[2] + t * (3 * c[3] + t * 4 * c[4]));
        return c[0] + t * (c[1] + t * (c[2] + t * (c[3] + t * c[4])));
    }
    double at[AXES], v[AXES];
    for (int i = 0; i < AXES; i++) {
        at[i] = p->axis[i][0] + t * (p->axis[i][1] + t * p->axis[i][2]);
        v[i] = p->axis[i][1] + 2 * t * p->axis[i][2];
    }
    if (s->follows_bed)
        step_surface_add(&gen->surface, at, v, slope);
    double u = 0;
    *speed = 0;
    if (s->config.formula)
        u = s->config.formula->position(s->config.params, s->angle, at, v, speed);
    else
        for (int i = 0; i < AXES; i++)
            u += s->config.weights[i] * at[i], *speed += s->config.weights[i] * v[i];
    *speed /= s->config.step_distance;
    return u / s->config.step_distance - s->origin;
}

static double evaluate(const struct step_gen *gen, const struct stepper *s, const struct piece *p, double t,
                       double *speed) {
    return evaluate_over(gen, s, p, t, speed, NULL);
}

static struct moment moment_at(const struct step_gen *gen, const struct stepper *s, const struct piece *p,
                               double t) {
    struct moment m = {.t = t};
    m.at = evaluate_over(gen, s, p, t, &m.speed, m.slope);
    return m;
}

// Looks through a tap again: the weighted sum of the axes that it shows, in steps.
static void look(const struct step_gen *gen, struct stepper *s, int index, unsigned axes) {
    const struct tap *tap = &gen->taps[index];
    struct seen *seen = &s->seen[index];
    struct motion m;
    step_locate(gen, &s->cursor[index], s->time - tap->time, &m);
    *seen = (struct seen){.time = s->time, .border = m.border + tap->time, .still = true};
    for (int j = 0; j < AXES; j++) {
        if (!(tap->axes & axes & 1u << j))
            continue;
        const double weight = s->config.weights[j] * tap->amplitude[j] / s->config.step_distance;
        const double v = speed_of(&m, j), a = accel_of(&m, j);
        seen->poly[0] += weight * place_of(&m, j);
        seen->poly[1] += weight * v;
        seen->poly[2] += weight * (a / 2);
        seen->still &= v == 0 && a == 0;
    }
}

// The place of a linear stepper: taps are looked through again only where their phase is over.
static double add_taps(const struct step_gen *gen, struct stepper *s, unsigned axes, struct piece *p) {
    double end = HUGE_VAL;
    for (int i = 0; i < gen->tap_count; i++) {
        struct seen *seen = &s->seen[i];
        if (!(gen->taps[i].axes & axes))
            continue;
        if (is_over(seen->border, s->time))
            look(gen, s, i, axes);
        const double t = s->time - seen->time, a = seen->poly[2];
        p->poly[0] += seen->poly[0] + t * (seen->poly[1] + t * a);
        p->poly[1] += seen->poly[1] + 2 * t * a;
        p->poly[2] += a;
        p->still &= seen->still;
        end = seen->border < end ? seen->border : end;
        if (seen->border == HUGE_VAL)
            seen->border = -HUGE_VAL; // a move may be appended at any time
    }
    return end;
}

static void look_at_axes(const struct step_gen *gen, struct stepper *s, int index) {
    const struct tap *tap = &gen->taps[index];
    struct seen *seen = &s->seen[index];
    struct motion m;
    step_locate(gen, &s->cursor[index], s->time - tap->time, &m);
    *seen = (struct seen){.time = s->time, .border = m.border + tap->time, .still = true};
    for (int j = AXIS_X; j <= AXIS_Z; j++) {
        if (!(tap->axes & 1u << j))
            continue;
        const double v = speed_of(&m, j), a = accel_of(&m, j), share = tap->amplitude[j];
        seen->axis[j][0] = share * place_of(&m, j);
        seen->axis[j][1] = share * v;
        seen->axis[j][2] = share * a / 2;
        seen->still &= share == 0 || (v == 0 && a == 0);
    }
}

// The axes of a stepper over a bed, as ``add_taps`` does.
static double add_seen_axes(const struct step_gen *gen, struct stepper *s, struct piece *p) {
    double end = HUGE_VAL;
    for (int i = 0; i < gen->tap_count; i++) {
        struct seen *seen = &s->seen[i];
        if (!(gen->taps[i].axes & s->uses))
            continue;
        if (is_over(seen->border, s->time))
            look_at_axes(gen, s, i);
        const double t = s->time - seen->time;
        for (int j = AXIS_X; j <= AXIS_Z; j++) {
            if (!(gen->taps[i].axes & 1u << j))
                continue;
            const double a = seen->axis[j][2];
            p->axis[j][0] += seen->axis[j][0] + t * (seen->axis[j][1] + t * a);
            p->axis[j][1] += seen->axis[j][1] + 2 * t * a;
            p->axis[j][2] += a;
        }
        p->still &= seen->still;
        end = seen->border < end ? seen->border : end;
        if (seen->border == HUGE_VAL)
            seen->border = -HUGE_VAL; // a move may be appended at any time
    }
    return end;
}

static double add_axes(const struct step_gen *gen, struct stepper *s, struct piece *p) {
    double end = HUGE_VAL;
    for (int i = 0; i < gen->tap_count; i++) {
        const struct tap *tap = &gen->taps[i];
        if (!(tap->axes & s->uses))
            continue;
        struct motion m;
        step_locate(gen, &s->cursor[i], s->time - tap->time, &m);
        end = fmin(end, m.border + tap->time);
        for (int j = 0; j < AXES; j++) {
            if (!(s->uses >> j & 1))
                continue;
            const double v = speed_of(&m, j), a = accel_of(&m, j);
            p->axis[j][0] += tap->amplitude[j] * place_of(&m, j);
            p->axis[j][1] += tap->amplitude[j] * v;
            p->axis[j][2] += tap->amplitude[j] * a / 2;
            p->still &= v == 0 && a == 0;
        }
    }
    return end;
}

struct range {
    double low, high;
};

static double lower(double a, double b) {
    return a < b ? a : b;
}

static double higher(double a, double b) {
    return a > b ? a : b;
}

// Of an axis between two times; it turns once at most.
static struct range range_of(const double c[3], double from, double to) {
    const double first = c[0] + from * (c[1] + from * c[2]), last = c[0] + to * (c[1] + to * c[2]);
    struct range r = {lower(first, last), higher(first, last)};
    const double turn = -c[1] / (2 * c[2]); // not finite in a cruise
    if (turn > from && turn < to) {
        const double at = c[0] + turn * (c[1] + turn * c[2]);
        r = (struct range){lower(r.low, at), higher(r.high, at)};
    }
    return r;
}

// Over one place of the bed a stepper's way is as straight as Z's own.
static void straighten(const struct step_gen *gen, const struct stepper *s, struct piece *p) {
    const double *x = p->axis[AXIS_X], *y = p->axis[AXIS_Y];
    if (p->still || x[1] != 0 || x[2] != 0 || y[1] != 0 || y[2] != 0)
        return;
    const struct range z = range_of(p->axis[AXIS_Z], 0, p->seconds);
    if (!step_surface_is_smooth(&gen->surface, x[0], x[0], y[0], y[0], z.low, z.high))
        return;
    double speed;
    p->poly[0] = evaluate(gen, s, p, 0, &speed);
    for (int k = 1; k < 3; k++)
        for (int i = 0; i < AXES; i++)
            p->poly[k] += s->config.weights[i] * p->axis[i][k] / s->config.step_distance;
    p->linear = true;
}

static void make_piece(const struct step_gen *gen, struct stepper *s, double until, struct piece *p) {
    *p = (struct piece){.begin = s->time, .linear = !s->config.formula && !s->follows_bed, .still = true};
    p->smooth = p->linear && s->smooth_s > 0 && s->uses & USES_E;
    const unsigned axes = p->smooth ? s->uses & ~(unsigned)USES_E : s->uses;
    const double border = p->linear        ? add_taps(gen, s, axes, p)
                          : s->follows_bed ? add_seen_axes(gen, s, p)
                                           : add_axes(gen, s, p);
    double end = fmin(until, border);
    if (p->smooth) {
        double smooth[5];
        const double scale = s->config.weights[AXIS_E] / s->config.step_distance;
        end = fmin(end, step_smooth(gen, s, s->time, smooth));
        for (int k = 0; k < 5; k++)
            p->poly[k] += scale * smooth[k];
        for (int k = 1; k < 5; k++)
            p->still &= smooth[k] == 0;
        p->smooth = smooth[3] != 0 || smooth[4] != 0; // else of constant acceleration
    }
    if (p->linear)
        p->poly[0] -= s->origin;
    p->seconds = fmax(end - s->time, ROUNDING_S / 2);
    if (s->follows_bed && !s->config.formula)
        straighten(gen, s, p);
}

static double fastest(const double c[3], double from, double to) {
    return higher(fabs(c[1] + 2 * c[2] * from), fabs(c[1] + 2 * c[2] * to));
}

// How long a way of STEPS takes, at first at SPEED: not finite where it gets nowhere.
static double time_of(double steps, double speed, double accel) {
    return 2 * steps / (speed + sqrt(speed * speed + 2 * accel * steps));
}

// Where a linear stepper over a bed turns at most once behind BEGIN, or reaches no step (QUIET): it cannot
// turn before its speed is used up by the most that the bed's bends and its axes can change it.
static double bed_cut(const struct step_gen *gen, const struct stepper *s, const struct piece *p,
                      const struct moment *begin, bool *quiet) {
    const double from = begin->t, to = p->seconds, *weights = s->config.weights;
    if (to <= from + SPAN_S)
        return to;
    const struct range x = range_of(p->axis[AXIS_X], from, to), y = range_of(p->axis[AXIS_Y], from, to),
                       z = range_of(p->axis[AXIS_Z], from, to);
    if (!step_surface_is_smooth(&gen->surface, x.low, x.high, y.low, y.high, z.low, z.high))
        return from + SPAN_S;
    double change =
        fabs(weights[AXIS_Z]) * step_surface_bend(&gen->surface, fastest(p->axis[AXIS_X], from, to),
                                                  fastest(p->axis[AXIS_Y], from, to),
                                                  2 * fabs(p->axis[AXIS_X][2]), 2 * fabs(p->axis[AXIS_Y][2]));
    for (int i = 0; i < AXES; i++)
        change += 2 * fabs(weights[i] * p->axis[i][2]);
    change /= s->config.step_distance;
    const double speed = fabs(begin->speed), room = ROOM - fabs(begin->at - (double)s->position);
    const double straight = fmax(SPAN_S, speed / change);
    const double still = room > 0 ? time_of(room, speed, change) : 0;
    *quiet = still > straight;
    return from + fmax(straight, still);
}

// A linear stepper over a bed at a time.
struct stand {
    double at[3];    // X Y Z, mm
    double slope[3]; // steps per mm of X, Y and Z
    double off;      // steps from where its steps have it
};

// How far axes get from there, mm; or how fast they get, mm/s.
struct box {
    double low[3], high[3];
};

static void extend(struct box *box, int axis, double to) {
    box->low[axis] = lower(box->low[axis], to);
    box->high[axis] = higher(box->high[axis], to);
}

// What that changes by the slope alone, in steps (per s).
static struct range sloped(const struct stand *stand, const struct box *box) {
    struct range sum = {0, 0};
    for (int i = 0; i < 3; i++) {
        const double one = stand->slope[i] * box->low[i], other = stand->slope[i] * box->high[i];
        sum.low += lower(one, other), sum.high += higher(one, other);
    }
    return sum;
}

// Whether the bed is smooth wherever the axes may be in a box.
static bool is_smooth(const struct step_gen *gen, const double at[3], const struct box *box) {
    const bool level = higher(fabs(box->low[2]), fabs(box->high[2])) < LEVEL_MM;
    return step_surface_is_smooth(&gen->surface, at[0] + box->low[0], at[0] + box->high[0],
                                  at[1] + box->low[1], at[1] + box->high[1],
                                  at[2] + (level ? 0 : box->low[2]), at[2] + (level ? 0 : box->high[2]));
}

// Whether the stepper reaches no step while its axes stay in a box. Where the bed is smooth, its slope there
// says more than the steepest one.
static bool stays_in(const struct step_gen *gen, const struct stepper *s, const struct stand *stand,
                     const struct box *box) {
    const double *weights = s->config.weights, off = stand->off;
    const double mm = s->config.step_distance, z = fabs(weights[AXIS_Z]) / mm;
    const struct range slope = sloped(stand, box);
    double far[3], straight = 0; // by the weights alone
    for (int i = 0; i < 3; i++) {
        far[i] = higher(fabs(box->low[i]), fabs(box->high[i]));
        straight += fabs(weights[i]) * far[i] / mm;
    }
    const double curl = z * step_surface_curl(&gen->surface, far);
    if (off + slope.high + curl < ROOM && off + slope.low - curl > -ROOM && is_smooth(gen, stand->at, box))
        return true;
    return straight + z * step_surface_change(&gen->surface, far) < ROOM - fabs(off);
}

// The time before it reaches a step over a smooth bed at any of SPEEDS.
static double time_left(const struct step_gen *gen, const struct stepper *s, const struct stand *stand,
                        const struct box *speeds) {
    const double z = fabs(s->config.weights[AXIS_Z]) / s->config.step_distance;
    const struct range rate = sloped(stand, speeds);
    double fast[3];
    for (int i = 0; i < 3; i++)
        fast[i] = higher(fabs(speeds->low[i]), fabs(speeds->high[i]));
    const double accel = 2 * z * step_surface_curl(&gen->surface, fast); // curl is of ½·t²
    return lower(time_of(ROOM - stand->off, rate.high, accel), time_of(ROOM + stand->off, -rate.low, accel));
}

static struct box in_time(const struct box *places, const struct box *speeds, double seconds) {
    struct box box;
    for (int i = 0; i < 3; i++) {
        box.low[i] = higher(places->low[i], seconds * speeds->low[i]);
        box.high[i] = lower(places->high[i], seconds * speeds->high[i]);
    }
    return box;
}

// Up to when it reaches no step, at least: there may be many pieces between two of its steps. Through shapers
// it sees each axis between its places in the moves around that time, and at a speed between theirs.
static double rests_until(const struct step_gen *gen, struct stepper *s, const struct stand *stand,
                          double until) {
    const double now = s->time;
    uint64_t n = s->passed < gen->kept_from ? gen->kept_from : s->passed;
    while (n < gen->moves_to && is_over(move_end(step_move(gen, n)), now - s->lag))
        n++;
    s->passed = n;
    if (n == gen->moves_to)
        return now;
    double end = now;
    struct box places = {{0, 0, 0}, {0, 0, 0}}, speeds = {{0, 0, 0}, {0, 0, 0}}; // it may rest between moves
    for (int i = 0; i < 3; i++)
        extend(&places, i, step_move(gen, n)->start[i] - stand->at[i]);
    for (; n < gen->moves_to && end < until; n++) {
        const struct trapezoid *m = step_move(gen, n);
        double at[AXES];
        step_move_end_position(m, at);
        for (int i = 0; i < 3; i++) {
            extend(&places, i, at[i] - stand->at[i]);
            extend(&speeds, i, m->ratio[i] * m->cruise_v);
        }
        const double over =
            (n + 1 < gen->moves_to ? step_move(gen, n + 1)->print_time : move_end(m)) - s->reach;
        if (over <= now)
            continue;
        struct box box = in_time(&places, &speeds, over - now);
        if (!stays_in(gen, s, stand, &box)) {
            const double seconds = lower(over - now, SURE * time_left(gen, s, stand, &speeds));
            box = in_time(&places, &speeds, seconds);
            if (is_smooth(gen, stand->at, &box))
                end = higher(end, now + seconds);
            break;
        }
        end = over;
    }
    return lower(end, until);
}

// The first time after BEGIN behind which the stepper's speed may behave otherwise; QUIET: no step comes
// before.
static double next_cut(const struct step_gen *gen, const struct stepper *s, const struct piece *p,
                       const struct moment *begin, bool *quiet) {
    const double *c = p->poly, from = begin->t;
    double cut = p->seconds;
    if (p->still)
        return cut;
    if (!p->linear)
        return fmin(cut, s->config.formula ? from + SPAN_S : bed_cut(gen, s, p, begin, quiet));
    if (!p->smooth) {
        const double turn = -c[1] / (2 * c[2]); // not finite in a cruise
        return turn > from + EXACT_S && turn < cut ? turn : cut;
    }
    // The roots of u'' = 2·c2 + 6·c3·t + 12·c4·t²: between them u' is monotone.
    const double root = sqrt(9 * c[3] * c[3] - 24 * c[2] * c[4]);
    const double q = -(3 * c[3] + copysign(root, c[3]));
    const double roots[2] = {q / (12 * c[4]), 2 * c[2] / q};
    for (int i = 0; i < 2; i++)
        if (roots[i] > from + EXACT_S && roots[i] < cut)
            cut = roots[i];
    return cut;
}

// Where the speed changes its sign behind FROM and before END, or END.
static struct moment find_turn(const struct step_gen *gen, const struct stepper *s, const struct piece *p,
                               const struct moment *from, double end) {
    const struct moment last = moment_at(gen, s, p, end);
    const double first = from->speed;
    double speed, low = from->t, high = end;
    if (!(first * last.speed < 0))
        return last;
    while (high - low > EXACT_S) {
        const double middle = 0.5 * (low + high);
        if (middle <= low || middle >= high)
            break;
        evaluate(gen, s, p, middle, &speed);
        if (speed * first > 0)
            low = middle;
        else
            high = middle;
    }
    const bool inside = high - from->t > 2 * EXACT_S && end - high > 2 * EXACT_S;
    return inside ? moment_at(gen, s, p, high) : last;
}

// The time in FROM..TO at which the stepper, moving in DIRECTION, is at BOUNDARY. GUESS: any time; SPEED:
// then that in DIRECTION.
static double solve(const struct step_gen *gen, const struct stepper *s, const struct piece *p, double from,
                    double to, double guess, int direction, double boundary, double *speed) {
    double low = from, high = to, t = guess > low && guess < high ? guess : low;
    *speed = 0;
    for (int i = 0; i < ITERATIONS && high - low > EXACT_S; i++) {
        const double off = (evaluate(gen, s, p, t, speed) - boundary) * direction;
        *speed *= direction;
        if (off > 0)
            high = t;
        else
            low = t;
        const double next = t - off / *speed;
        if (!(next >= low && next <= high)) {
            t = 0.5 * (low + high);
            continue;
        }
        const double change = fabs(next - t);
        t = next;
        if (change < CLOSE_S)
            break;
    }
    return t;
}

// A quartic that rises from LOW to HIGH: when it is FIRST, FIRST + 1 ..., from a parabola's guesses by
// Newton. False where that did not get all of the first COUNT right. Writes the whole block.
STEP_VECTOR
static bool solve_block(const double c[5], double low, double high, double first, int count,
                        double t[FILL_BLOCK]) {
    const double tiny = 1e-300;
    const double u = c[0] + low * (c[1] + low * (c[2] + low * (c[3] + low * c[4])));
    const double v = c[1] + low * (2 * c[2] + low * (3 * c[3] + low * 4 * c[4]));
    const double twice = 4 * c[2] + low * (12 * c[3] + low * 24 * c[4]);
    double change[FILL_BLOCK];
    for (int j = 0; j < FILL_BLOCK; j++) {
        double x = first + j - u, square = v * v + twice * (first + j - u);
        x = x > 0 ? x : 0;
        square = square > 0 ? square : 0;
        const double guess = low + 2 * x / (v + __builtin_sqrt(square) + tiny);
        t[j] = guess < high ? guess : high;
    }
    bool good = false;
    for (int i = 0; i < NEWTONS && !good; i++) {
        for (int j = 0; j < FILL_BLOCK; j++) {
            const double at = t[j];
            const double off = c[0] - (first + j) + at * (c[1] + at * (c[2] + at * (c[3] + at * c[4])));
            const double speed = c[1] + at * (2 * c[2] + at * (3 * c[3] + at * 4 * c[4]));
            double next = at - off / speed;
            next = next > low ? next : low; // also what is no number
            next = next < high ? next : high;
            change[j] = __builtin_fabs(next - at);
            t[j] = next;
        }
        good = true;
        for (int j = 0; j < count; j++)
            good &= change[j] < CLOSE_S;
    }
    return good;
}

// In which the stepper does not turn: times from the piece's begin, places in steps, speeds.
struct span {
    double from, to, begin, end, v0, v1;
    int direction;
    int64_t target;
};

// The times of COUNT steps of a span from the one over boundary FIRST on, which come behind FROM; GUESS: of
// the first, and then of the next.
static void solve_one_by_one(const struct step_gen *gen, const struct stepper *s, const struct piece *p,
                             const struct span *of, double from, double first, int count, double *guess,
                             double *t) {
    const double accel = (of->v1 - of->v0) / (of->to - of->from);
    double speed;
    for (int i = 0; i < count; i++) {
        t[i] = solve(gen, s, p, i ? t[i - 1] : from, of->to, *guess, of->direction,
                     first + (double)i * of->direction, &speed);
        *guess = t[i] + time_of(1, speed, accel);
    }
}

static int play_solved(struct step_gen *gen, struct stepper *s, const struct piece *p,
                       const struct span *of) {
    double t[SOLVED + FILL_BLOCK], c[5], from = of->from;
    const int direction = of->direction;
    const struct phase flow = {.time = p->begin, .seconds = p->seconds, .solved = t};
    double guess = from; // a parabola's
    guess += time_of(fabs((double)s->position + 0.5 * direction - of->begin), of->v0,
                     (of->v1 - of->v0) / (of->to - from));
    for (int k = 0; k < 5; k++)
        c[k] = p->poly[k] * direction;
    while (s->position != of->target) {
        const int64_t left = (of->target - s->position) * direction;
        const int count = left < SOLVED ? (int)left : SOLVED;
        memset(t + count, 0, FILL_BLOCK * sizeof(*t)); // is read, and does not matter
        for (int i = 0; i < count; i += FILL_BLOCK) {
            const int n = count - i < FILL_BLOCK ? count - i : FILL_BLOCK;
            const int64_t position = s->position + (int64_t)i * direction;
            const double first = (double)position + 0.5 * direction;
            if (!p->linear || !solve_block(c, from, of->to, first * direction, n, t + i))
                solve_one_by_one(gen, s, p, of, from, first, n, &guess, t + i);
            from = t[i + n - 1];
        }
        const int status = step_put(gen, s, &flow, direction, 0, 1, count);
        if (status)
            return status;
    }
    return STEP_OK;
}

static int put_span(struct step_gen *gen, struct stepper *s, const struct piece *p, const struct span *of) {
    if (!p->linear || p->smooth)
        return play_solved(gen, s, p, of);
    struct phase span = {.time = p->begin + of->from, .seconds = of->to - of->from};
    span.way = fabs(of->end - of->begin);
    span.backwards = of->v1 < of->v0;
    span.speed = fmin(of->v0, of->v1);
    span.accel = 2 * fabs(p->poly[2]);
    const double boundary = (double)s->position + 0.5 * of->direction;
    return step_put(gen, s, &span, of->direction, fmax((boundary - of->begin) * of->direction, 0), 1,
                    (of->target - s->position) * of->direction);
}

// The step over a boundary that the stepper passed before this span, by less than decides a tie.
static int put_undecided(struct step_gen *gen, struct stepper *s, const struct piece *p, double from,
                         double begin, int direction) {
    if ((begin - (double)s->position) * direction <= 0.5)
        return STEP_OK;
    const bool known = s->crossed_direction == direction;
    double t[FILL_BLOCK] = {known ? s->crossed - p->begin : from};
    const struct phase flow = {.time = p->begin, .seconds = p->seconds, .solved = t};
    return step_put(gen, s, &flow, direction, 0, 1, 1);
}

// Where the span ends a little beyond a boundary: the next decides whether that is a step, and it is due when
// the boundary was passed, or when the stepper goes on if it rests or turns there.
static void note_tie(const struct step_gen *gen, struct stepper *s, const struct piece *p, double from,
                     double to, double begin, double end) {
    const int direction = end > begin ? 1 : -1;
    const double boundary = (double)s->position + 0.5 * direction;
    const bool beyond = end != begin && (end - boundary) * direction > 0;
    if (beyond && (begin - boundary) * direction <= 0) {
        double speed;
        s->crossed = p->begin + solve(gen, s, p, from, to, from, direction, boundary, &speed);
        s->crossed_direction = direction;
    } else if (!beyond || s->crossed_direction != direction) {
        s->crossed_direction = 0;
    }
}

static int play_span(struct step_gen *gen, struct stepper *s, const struct piece *p,
                     const struct moment *first, const struct moment *last) {
    const double from = first->t, to = last->t, v0 = first->speed, v1 = last->speed;
    const double begin = first->at, end = last->at;
    if (!(fabs(begin) < FURTHEST_STEPS && fabs(end) < FURTHEST_STEPS))
        return step_fail(gen, STEP_BAD_MOVE, s, p->begin, end);
    const int64_t target = step_settle(end, s->position);
    int status = STEP_OK;
    if (target != s->position) {
        const int direction = target > s->position ? 1 : -1;
        status = put_undecided(gen, s, p, from, begin, direction);
        if (!status && target != s->position)
            status = put_span(gen, s, p,
                              &(struct span){from, to, begin, end, fabs(v0), fabs(v1), direction, target});
    }
    if (!status)
        note_tie(gen, s, p, from, to, begin, end);
    return status;
}

static struct stand stand_at(const struct stepper *s, const struct piece *p, const struct moment *begin) {
    struct stand stand = {.off = begin->at - (double)s->position};
    for (int i = 0; i < 3; i++) {
        const double by_bed = i < 2 ? s->config.weights[AXIS_Z] * begin->slope[i] : 0;
        stand.at[i] = p->axis[i][0];
        stand.slope[i] = (s->config.weights[i] + by_bed) / s->config.step_distance;
    }
    return stand;
}

// Steps up to TIME are done.
static int play_on(struct stepper *s, double time) {
    s->time = time;
    s->checked = -1;
    return STEP_OK;
}

static int play_piece(struct step_gen *gen, struct stepper *s, const struct piece *p, double until) {
    const double over = p->begin + p->seconds;
    struct moment from = moment_at(gen, s, p, 0);
    const double off = from.at - (double)s->position;
    if (s->time != s->checked && !(fabs(off) <= JUMP_STEPS))
        return step_fail(gen, STEP_JUMP, s, p->begin, off);
    s->checked = s->time;
    if (!p->linear && !s->config.formula) {
        const struct stand stand = stand_at(s, p, &from);
        const double end = s->between ? rests_until(gen, s, &stand, until) : s->time;
        if (end >= over)
            return play_on(s, end);
    }
    while (from.t < p->seconds) {
        bool quiet = p->still;
        const double end = next_cut(gen, s, p, &from, &quiet);
        const bool turns = !quiet && (!p->linear || p->smooth);
        const struct moment to = turns ? find_turn(gen, s, p, &from, end) : moment_at(gen, s, p, end);
        const int status = play_span(gen, s, p, &from, &to);
        if (status)
            return status;
        if (s->config.formula && s->config.formula->unwraps)
            s->angle = (to.at + s->origin) * s->config.step_distance;
        from = to;
        s->time = s->checked = p->begin + to.t; // steps up to here are done, whatever comes
    }
    return play_on(s, over);
}

int step_curve_advance(struct step_gen *gen, struct stepper *s, double until) {
    s->crossed = fmax(s->crossed, s->time); // what is due before may be compressed
    while (s->time < until - ROUNDING_S) {
        struct piece piece;
        make_piece(gen, s, until, &piece);
        const int status = play_piece(gen, s, &piece, until);
        if (status)
            return status;
    }
    return STEP_OK;
}
