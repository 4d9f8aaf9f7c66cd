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
static const double LEVEL_MM = 1e-9; // less is rounding of a Z that stays

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
        const double v = speed_of(&m, j), a = accel_of(&m, j), share = tap->amplitude[j];
        seen->axis[j][0] = share * place_of(&m, j);
        seen->axis[j][1] = share * v;
        seen->axis[j][2] = share * a / 2;
        seen->still &= share == 0 || (v == 0 && a == 0);
    }
}

// The axes of a stepper over a bed, as ``add_taps`` does: there may be many pieces between two of its steps.
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
}

struct range {
    double low, high;
};

// Of an axis between two times; it turns once at most.
static struct range range_of(const double c[3], double from, double to) {
    const double first = c[0] + from * (c[1] + from * c[2]), last = c[0] + to * (c[1] + to * c[2]);
    struct range r = {fmin(first, last), fmax(first, last)};
    const double turn = -c[1] / (2 * c[2]); // not finite in a cruise
    if (turn > from && turn < to) {
        const double at = c[0] + turn * (c[1] + turn * c[2]);
        r = (struct range){fmin(r.low, at), fmax(r.high, at)};
    }
    return r;
}

static double fastest(const double c[3], double from, double to) {
    return fmax(fabs(c[1] + 2 * c[2] * from), fabs(c[1] + 2 * c[2] * to));
}

// Where a linear stepper over a bed turns at most once behind FROM: it cannot turn at all before its speed is
// used up by the most that the bed's bends and its axes can change it.
static double bed_cut(const struct step_gen *gen, const struct stepper *s, const struct piece *p,
                      const struct moment *begin) {
    const double from = begin->t, to = p->seconds, *weights = s->config.weights;
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
    return from + fmax(SPAN_S, fabs(begin->speed) * s->config.step_distance / change);
}

// Whether a linear stepper over a bed reaches no step while its axes are no further than LOW to HIGH (mm)
// from where it was last evaluated, and |slope there · way| is at most ALONG. Where the bed is smooth, that
// slope says more than the steepest one.
static bool stays_near(const struct step_gen *gen, const struct stepper *s, const double low[3],
                       const double high[3], double along) {
    const double *weights = s->config.weights, *known = s->known_at;
    const double room = (0.5 - 2.0 / STEP_TIE - fabs(s->known_off)) * s->config.step_distance;
    double far[3], straight = 0; // by the weights alone
    for (int i = 0; i < 3; i++) {
        far[i] = fmax(fabs(low[i]), fabs(high[i]));
        straight += fabs(weights[i]) * far[i];
    }
    const double z = fabs(weights[AXIS_Z]);
    if (straight + z * step_surface_change(&gen->surface, far) < room)
        return true;
    return far[AXIS_Z] < LEVEL_MM && straight + z * (along + step_surface_curl(&gen->surface, far)) < room &&
           step_surface_is_smooth(&gen->surface, known[0] + low[0], known[0] + high[0], known[1] + low[1],
                                  known[1] + high[1], known[2], known[2]);
}

// Whether it can reach no step in the piece: mostly.
static bool reaches_nothing(const struct step_gen *gen, const struct stepper *s, const struct piece *p) {
    if (s->config.formula || p->still || s->known_off == HUGE_VAL)
        return false;
    double low[3], high[3], along = 0, turned = 0;
    for (int i = 0; i < 3; i++) {
        const double gone = p->axis[i][0] - s->known_at[i];
        const double way = fastest(p->axis[i], 0, p->seconds) * p->seconds;
        low[i] = gone - way, high[i] = gone + way;
        if (i < 2)
            along += s->known_slope[i] * gone, turned += fabs(s->known_slope[i]) * way;
    }
    return stays_near(gen, s, low, high, fabs(along) + turned);
}

// Where the axes get from where a stepper was last evaluated, mm.
struct box {
    double low[3], high[3];
};

static void extend(struct box *box, const double known[3], const double at[AXES]) {
    for (int i = 0; i < 3; i++) {
        box->low[i] = fmin(box->low[i], at[i] - known[i]);
        box->high[i] = fmax(box->high[i], at[i] - known[i]);
    }
}

static bool stays_in_box(const struct step_gen *gen, const struct stepper *s, const struct box *b) {
    double least = 0, most = 0;
    for (int i = 0; i < 2; i++) {
        const double one = s->known_slope[i] * b->low[i], other = s->known_slope[i] * b->high[i];
        least += fmin(one, other), most += fmax(one, other);
    }
    return stays_near(gen, s, b->low, b->high, fmax(fabs(least), fabs(most)));
}

// Passes whole moves on which a linear stepper over a bed reaches no step: what it sees of them through
// shapers lies between places of the axes. Where that gets it no further, not before the move is over.
static void pass_moves(const struct step_gen *gen, struct stepper *s, double until) {
    if (!s->between || s->known_off == HUGE_VAL || s->time < s->stay)
        return;
    uint64_t n = s->passed < gen->kept_from ? gen->kept_from : s->passed;
    while (n < gen->moves_to && is_over(move_end(step_move(gen, n)), s->time - s->lag))
        n++;
    s->passed = n;
    if (n == gen->moves_to)
        return;
    struct box box = {.low = {HUGE_VAL, HUGE_VAL, HUGE_VAL}, .high = {-HUGE_VAL, -HUGE_VAL, -HUGE_VAL}};
    double at[AXES], end = s->time;
    if (n > gen->kept_from)
        step_move_end_position(step_move(gen, n - 1), at);
    extend(&box, s->known_at, n > gen->kept_from ? at : gen->rest);
    for (; n < gen->moves_to && end < until; n++) {
        const struct trapezoid *m = step_move(gen, n);
        step_move_end_position(m, at);
        extend(&box, s->known_at, m->start);
        extend(&box, s->known_at, at);
        if (!stays_in_box(gen, s, &box))
            break;
        end = (n + 1 < gen->moves_to ? step_move(gen, n + 1)->print_time : move_end(m)) - s->reach;
    }
    if (end > s->time)
        s->time = fmin(end, until), s->checked = -1;
    else
        s->stay = move_end(step_move(gen, s->passed)) + s->lag;
}

// The first time after BEGIN behind which the stepper's speed may behave otherwise.
static double next_cut(const struct step_gen *gen, const struct stepper *s, const struct piece *p,
                       const struct moment *begin) {
    const double *c = p->poly, from = begin->t;
    double cut = p->seconds;
    if (p->still)
        return cut;
    if (!p->linear)
        return fmin(cut, s->config.formula ? from + SPAN_S : bed_cut(gen, s, p, begin));
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

// The time in FROM..TO at which the stepper, moving in DIRECTION, is at BOUNDARY; GUESS is any time.
static double solve(const struct step_gen *gen, const struct stepper *s, const struct piece *p, double from,
                    double to, double guess, int direction, double boundary) {
    double low = from, high = to, t = guess > low && guess < high ? guess : low;
    for (int i = 0; i < ITERATIONS && high - low > EXACT_S; i++) {
        double speed;
        const double off = (evaluate(gen, s, p, t, &speed) - boundary) * direction;
        if (off > 0)
            high = t;
        else
            low = t;
        double next = t - off / (speed * direction);
        if (!(next >= low && next <= high))
            next = 0.5 * (low + high);
        const double change = fabs(next - t);
        t = next;
        if (change < EXACT_S)
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

static void solve_one_by_one(const struct step_gen *gen, const struct stepper *s, const struct piece *p,
                             double from, double to, int direction, int64_t position, int count, double *t) {
    double last = from, guess = from;
    for (int i = 0; i < count; i++) {
        const double boundary = (double)(position + (int64_t)i * direction) + 0.5 * direction;
        t[i] = solve(gen, s, p, last, to, guess, direction, boundary);
        guess = t[i] + (t[i] - last);
        last = t[i];
    }
}

static int play_solved(struct step_gen *gen, struct stepper *s, const struct piece *p, double from, double to,
                       int direction, int64_t target) {
    double t[SOLVED + FILL_BLOCK], c[5];
    const struct phase flow = {.time = p->begin, .seconds = p->seconds, .solved = t};
    for (int k = 0; k < 5; k++)
        c[k] = p->poly[k] * direction;
    while (s->position != target) {
        const int64_t left = (target - s->position) * direction;
        const int count = left < SOLVED ? (int)left : SOLVED;
        memset(t + count, 0, FILL_BLOCK * sizeof(*t)); // is read, and does not matter
        for (int i = 0; i < count; i += FILL_BLOCK) {
            const int n = count - i < FILL_BLOCK ? count - i : FILL_BLOCK;
            const int64_t position = s->position + (int64_t)i * direction;
            if (!p->linear || !solve_block(c, from, to, (double)(position * direction) + 0.5, n, t + i))
                solve_one_by_one(gen, s, p, from, to, direction, position, n, t + i);
            from = t[i + n - 1];
        }
        const int status = step_put(gen, s, &flow, direction, 0, 1, count);
        if (status)
            return status;
    }
    return STEP_OK;
}

// In which the stepper does not turn: times from the piece's begin, places in steps, speeds.
struct span {
    double from, to, begin, end, v0, v1;
    int direction;
    int64_t target;
};

static int put_span(struct step_gen *gen, struct stepper *s, const struct piece *p, const struct span *of) {
    if (!p->linear || p->smooth)
        return play_solved(gen, s, p, of->from, of->to, of->direction, of->target);
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
        s->crossed = p->begin + solve(gen, s, p, from, to, from, direction, boundary);
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

static int play_piece(struct step_gen *gen, struct stepper *s, const struct piece *p) {
    if (s->follows_bed && reaches_nothing(gen, s, p))
        return STEP_OK;
    struct moment from = moment_at(gen, s, p, 0);
    const double off = from.at - (double)s->position;
    if (s->time != s->checked && !(fabs(off) <= JUMP_STEPS))
        return step_fail(gen, STEP_JUMP, s, p->begin, off);
    s->checked = s->time;
    if (s->follows_bed) {
        for (int i = 0; i < 3; i++)
            s->known_at[i] = p->axis[i][0];
        s->known_slope[0] = from.slope[0], s->known_slope[1] = from.slope[1];
        s->known_off = off;
        if (reaches_nothing(gen, s, p))
            return STEP_OK;
        s->known_off = HUGE_VAL; // it steps on
    }
    while (from.t < p->seconds) {
        const double end = next_cut(gen, s, p, &from);
        const bool turns = !p->still && (!p->linear || p->smooth);
        const struct moment to = turns ? find_turn(gen, s, p, &from, end) : moment_at(gen, s, p, end);
        const int status = play_span(gen, s, p, &from, &to);
        if (status)
            return status;
        if (s->config.formula && s->config.formula->unwraps)
            s->angle = (to.at + s->origin) * s->config.step_distance;
        from = to;
        s->time = s->checked = p->begin + to.t; // steps up to here are done, whatever comes
    }
    return STEP_OK;
}

int step_curve_advance(struct step_gen *gen, struct stepper *s, double until) {
    s->crossed = fmax(s->crossed, s->time); // what is due before may be compressed
    while (s->time < until - ROUNDING_S) {
        if (s->follows_bed)
            pass_moves(gen, s, until);
        if (!(s->time < until - ROUNDING_S))
            break;
        struct piece piece;
        make_piece(gen, s, until, &piece);
        const int status = play_piece(gen, s, &piece);
        if (status)
            return status;
        s->time = piece.begin + piece.seconds;
        s->checked = -1;
    }
    return STEP_OK;
}
