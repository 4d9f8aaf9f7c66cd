// SPDX-License-Identifier: Apache-2.0
// Budget and order of a bus. The reason for each constant is stated with it.
#include "nodes/link/core/schedule.h"

#include <string.h>

#define NS_PER_S 1000000000ULL
#define NS_PER_MS 1000000LL
#define PPM 1000000

enum {
    FULL_FRAME_BITS = 120,     // 8 data bytes and the stuff bits of ordinary data: 111..135
    FULL_BLOCK_BITS = 9 * 135, // 64 bytes that begin within a frame, at worst
    BYTE_BITS = 10,            // on a serial line
    CEILING_PPM = 900000,      // above, arbitration alone makes a frame wait for many others
    CONTROL_SHARE_PPM = 50000, // at 500 kbit/s: 25 kbit/s, some 80 queries with their answers a second
    BULK_SHARE_PPM = 20000,    // at 500 kbit/s: a full block each 0.12 s; both fit above the ceiling
    QUEUE_NS = 1500000,        // what waits in the kernel cannot be overtaken: short compared with leads
    QUEUE_FRAMES_MIN = 3,      // one on the wire, one behind it, one while the thread wakes up
};

#define OVERDRAFT_NS (20 * NS_PER_MS) // of control and motion sent ahead: a dozen full blocks at 500 kbit/s
#define DEBT_MAX_NS (50 * NS_PER_MS)  // older debt is forgiven: the bus was busy then, it is not now
#define CREDIT_MIN_NS (2 * NS_PER_MS) // a thread that slept for this time loses no credit
#define SLOT_NS (100 * NS_PER_MS)
// An acknowledgement outstanding for this time may be waiting for the line; a third of the shortest timeout.
// These pauses of one frame cost 4 % of a line that is never idle at 500 kbit/s.
#define PAUSE_INTERVAL_NS (7 * NS_PER_MS)

static int64_t line_ns(const struct schedule *schedule, uint64_t bits) {
    return schedule->bitrate ? (int64_t)(bits * NS_PER_S / schedule->bitrate) : 0;
}

void schedule_init(struct schedule *schedule, uint32_t bitrate, double ceiling, uint32_t queue_frames,
                   int serial, uint64_t now) {
    memset(schedule, 0, sizeof *schedule);
    schedule->bitrate = bitrate;
    schedule->ceiling_ppm = ceiling > 0 && ceiling <= 1 ? (uint64_t)(ceiling * PPM) : CEILING_PPM;
    schedule->block_ns = line_ns(schedule, FULL_BLOCK_BITS);
    schedule->queue_frames = queue_frames;
    schedule->unit_bits = serial ? BYTE_BITS : FULL_FRAME_BITS;
    if (!queue_frames && bitrate && !serial) {
        uint64_t frames = (uint64_t)QUEUE_NS * bitrate / NS_PER_S / FULL_FRAME_BITS;
        schedule->queue_frames = frames > QUEUE_FRAMES_MIN ? (uint32_t)frames : QUEUE_FRAMES_MIN;
    }
    schedule->now_ns = schedule->begun_ns = schedule->line_free_ns = now;
    schedule->serial = serial != 0;
    schedule->slot = now / SLOT_NS;
}

// -------------------------------------------------------------------------------------------------- budget

static int64_t least(int64_t a, int64_t b) {
    return a < b ? a : b;
}

static int64_t credit_max(const struct schedule *schedule) {
    return schedule->block_ns > CREDIT_MIN_NS ? schedule->block_ns : CREDIT_MIN_NS;
}

static void turn_slots(struct schedule *schedule) {
    uint64_t slot = schedule->now_ns / SLOT_NS;
    if (slot - schedule->slot >= SCHEDULE_SLOTS)
        memset(schedule->slots, 0, sizeof schedule->slots);
    else
        for (uint64_t at = schedule->slot + 1; at <= slot; at++)
            memset(schedule->slots[at % SCHEDULE_SLOTS], 0, sizeof schedule->slots[0]);
    schedule->slot = slot;
}

void schedule_advance(struct schedule *schedule, uint64_t now) {
    if (now <= schedule->now_ns)
        return;
    uint64_t passed_ns = now - schedule->now_ns < NS_PER_S ? now - schedule->now_ns : NS_PER_S;
    schedule->now_ns = now;
    if (!schedule->bitrate)
        return;
    turn_slots(schedule);
    if (schedule->held_since_ns) {
        schedule->held_ns += now - schedule->held_since_ns;
        schedule->held_since_ns = now;
    }
    static const uint64_t share_ppm[LINK_CLASSES] = {[LINK_CONTROL] = CONTROL_SHARE_PPM,
                                                     [LINK_BULK] = BULK_SHARE_PPM};
    int64_t refill_ns = (int64_t)(passed_ns * schedule->ceiling_ppm / PPM);
    schedule->credit_ns = least(schedule->credit_ns + refill_ns, credit_max(schedule));
    for (int kind = LINK_CONTROL; kind < LINK_CLASSES; kind++) {
        int64_t share_ns = schedule->share_ns[kind] + (int64_t)(passed_ns * share_ppm[kind] / PPM);
        schedule->share_ns[kind] = least(share_ns, schedule->block_ns);
    }
}

static int64_t limit_of(enum link_class kind) {
    return kind == LINK_BULK ? 0 : -OVERDRAFT_NS;
}

unsigned schedule_allowed(const struct schedule *schedule) {
    if (!schedule->bitrate)
        return LINK_ALL;
    unsigned allowed = 0;
    for (int kind = LINK_MOTION; kind < LINK_CLASSES; kind++)
        if (schedule->credit_ns >= limit_of((enum link_class)kind) ||
            (kind != LINK_MOTION && schedule->share_ns[kind] >= schedule->block_ns))
            allowed |= 1u << kind;
    return allowed;
}

uint64_t schedule_opens_at(const struct schedule *schedule, enum link_class kind) {
    if (schedule_allowed(schedule) & 1u << kind)
        return schedule->now_ns;
    uint64_t credit_ns = (uint64_t)(limit_of(kind) - schedule->credit_ns);
    uint64_t by_credit_ns = credit_ns * PPM / schedule->ceiling_ppm + 1;
    if (kind == LINK_MOTION)
        return schedule->now_ns + by_credit_ns;
    uint64_t share_ppm = kind == LINK_CONTROL ? CONTROL_SHARE_PPM : BULK_SHARE_PPM;
    uint64_t share_ns = (uint64_t)(schedule->block_ns - schedule->share_ns[kind]);
    uint64_t by_share_ns = share_ns * PPM / share_ppm + 1;
    return schedule->now_ns + (by_credit_ns < by_share_ns ? by_credit_ns : by_share_ns);
}

static void pay(struct schedule *schedule, int64_t cost_ns) {
    schedule->credit_ns -= cost_ns;
    if (schedule->credit_ns < -DEBT_MAX_NS)
        schedule->credit_ns = -DEBT_MAX_NS;
}

void schedule_sent(struct schedule *schedule, enum link_class kind, uint32_t bits) {
    if (!schedule->bitrate)
        return;
    int64_t cost_ns = line_ns(schedule, bits);
    schedule->sent_bits[kind] += bits;
    schedule->slots[schedule->slot % SCHEDULE_SLOTS][kind] += bits;
    pay(schedule, cost_ns);
    schedule->share_ns[kind] -= cost_ns;
    if (schedule->share_ns[kind] < 0)
        schedule->share_ns[kind] = 0;
    uint64_t start_ns = schedule->line_free_ns > schedule->now_ns ? schedule->line_free_ns : schedule->now_ns;
    schedule->line_free_ns = start_ns + (uint64_t)cost_ns;
}

void schedule_received(struct schedule *schedule, unsigned flow, uint32_t bits) {
    if (!schedule->bitrate)
        return;
    schedule->received_bits += bits;
    schedule->slots[schedule->slot % SCHEDULE_SLOTS][flow] += bits;
    if (schedule->serial) // each direction has its own line
        return;
    pay(schedule, line_ns(schedule, bits));
    if (schedule->line_free_ns > schedule->now_ns) // it was on the line while our frames waited
        schedule->line_free_ns += (uint64_t)line_ns(schedule, bits);
}

void schedule_held(struct schedule *schedule, int held) {
    schedule->held_since_ns = held ? schedule->now_ns : 0;
}

// --------------------------------------------------------------------------------------------------- queue

static uint64_t unit_ns(const struct schedule *schedule) {
    return (uint64_t)line_ns(schedule, schedule->unit_bits);
}

// The kernel does not report what waits in an adapter or in a virtual bus: the greater of report and estimate
// counts.
uint64_t schedule_queued(const struct schedule *schedule, uint64_t queued) {
    int busy = schedule->bitrate && schedule->line_free_ns > schedule->now_ns;
    uint64_t expected = 0;
    if (busy)
        expected = (schedule->line_free_ns - schedule->now_ns + unit_ns(schedule) - 1) / unit_ns(schedule);
    return queued == UINT64_MAX || queued < expected ? expected : queued;
}

uint64_t schedule_room(const struct schedule *schedule, uint64_t queued) {
    if (!schedule->queue_frames)
        return UINT64_MAX;
    uint64_t waiting = schedule_queued(schedule, queued);
    return waiting < schedule->queue_frames ? schedule->queue_frames - waiting : 0;
}

int schedule_pause(struct schedule *schedule, uint64_t since_ns) {
    uint64_t now = schedule->now_ns;
    if (!schedule->bitrate || schedule->serial)
        return 0;
    if (schedule->pause_ns) {
        if (now < schedule->pause_ns)
            return 1;
        schedule->pause_ns = 0;
        schedule->paused_ns = now;
    }
    uint64_t last_ns = since_ns > schedule->paused_ns ? since_ns : schedule->paused_ns;
    if (since_ns == UINT64_MAX || now < last_ns + PAUSE_INTERVAL_NS)
        return 0;
    uint64_t free_ns = schedule->line_free_ns > now ? schedule->line_free_ns : now;
    schedule->pause_ns = free_ns + unit_ns(schedule);
    return 1;
}

uint64_t schedule_room_at(const struct schedule *schedule) {
    if (schedule->pause_ns)
        return schedule->pause_ns;
    // Until half is left, or as little as keeps the bus busy meanwhile: each wait wakes the thread.
    uint64_t left = schedule->queue_frames / 2;
    if (!schedule->serial && left > QUEUE_FRAMES_MIN)
        left = QUEUE_FRAMES_MIN;
    uint64_t wait_ns = schedule->bitrate ? unit_ns(schedule) * (schedule->queue_frames - left) : NS_PER_MS;
    return schedule->now_ns + wait_ns;
}

// --------------------------------------------------------------------------------------------------- order

static uint64_t key_of(const struct link_offer *offer, uint64_t now) {
    int late_alike = !offer->urgent && offer->kind != LINK_MOTION && offer->due_ns < now;
    return late_alike ? now : offer->due_ns;
}

// Strictly by deadline, a link that queued a flood first would make the others wait for all of it. Motion has
// true deadlines; all other overdue offers are equal and take turns.
int schedule_before(const struct link_offer *a, const struct link_offer *b, uint64_t now) {
    if (a->urgent != b->urgent)
        return a->urgent;
    return key_of(a, now) < key_of(b, now);
}

// ------------------------------------------------------------------------------------------------- figures

uint64_t schedule_recent(const struct schedule *schedule, unsigned flow) {
    uint64_t bits = 0;
    for (size_t i = 0; i < SCHEDULE_SLOTS; i++)
        bits += schedule->slots[i][flow];
    uint64_t span_ns = (uint64_t)(SCHEDULE_SLOTS - 1) * SLOT_NS + schedule->now_ns % SLOT_NS;
    uint64_t alive_ns = schedule->now_ns - schedule->begun_ns;
    if (alive_ns < span_ns)
        span_ns = alive_ns > SLOT_NS ? alive_ns : SLOT_NS;
    return bits * (NS_PER_S / 1000) / (span_ns / 1000);
}

// Received data and control cannot be reduced; bulk and frames of higher ids give way. Acknowledgements are
// part of the cost of motion.
double schedule_left_for_motion(const struct schedule *schedule) {
    uint64_t others = schedule_recent(schedule, LINK_CONTROL);
    others += schedule->serial ? 0 : schedule_recent(schedule, SCHEDULE_DATA);
    double share = schedule->bitrate ? (double)others / schedule->bitrate : 0;
    double left = (double)schedule->ceiling_ppm / PPM - share;
    return left > 0.02 ? left : 0.02;
}
