// SPDX-License-Identifier: Apache-2.0
// See hub_faults.h.
#include "nodes/virtual/hub_faults.h"

#include <string.h>

static bool is_timed(const struct hub_rule *rule) {
    return rule->kind == HUB_BUS_OFF && rule->timed;
}

static uint64_t off_time(const struct hub_faults *faults, uint32_t i) {
    bool waits = is_timed(&faults->rules[i]) && faults->counters[i].hits == 0;
    return waits ? faults->start_ns + faults->rules[i].from_ns : UINT64_MAX;
}

static void find_next_off(struct hub_faults *faults) {
    faults->next_off_ns = UINT64_MAX;
    for (uint32_t i = 0; i < faults->count; i++)
        if (off_time(faults, i) < faults->next_off_ns)
            faults->next_off_ns = off_time(faults, i);
}

void hub_faults_init(struct hub_faults *faults, const struct hub_rule *rules, size_t count, uint64_t seed,
                     uint64_t now_ns) {
    memset(faults, 0, sizeof(*faults));
    faults->count = (uint32_t)(count < HUB_RULES ? count : HUB_RULES);
    faults->seed = seed;
    faults->start_ns = now_ns;
    for (uint32_t i = 0; i < faults->count; i++) {
        faults->rules[i] = rules[i];
        faults->thresholds[i] = (uint64_t)(rules[i].share * 4294967296.0);
        if (!is_timed(&rules[i]))
            faults->kinds |= 1u << rules[i].kind;
    }
    find_next_off(faults);
}

// splitmix64's finalizer: neighbouring inputs give unrelated outputs.
static uint64_t mix(uint64_t z) {
    z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9;
    z = (z ^ z >> 27) * 0x94D049BB133111EB;
    return z ^ z >> 31;
}

// Returns two independent words for the n-th frame of a sender that a rule selected.
static uint64_t draw(const struct hub_faults *faults, uint32_t rule, int sender, uint64_t nth) {
    static const uint64_t STEP = 0x9E3779B97F4A7C15;
    uint64_t stream = mix(faults->seed + STEP * (rule * (uint64_t)HUB_CLIENTS + (uint64_t)sender + 1));
    return mix(stream + STEP * nth);
}

static uint64_t set_of(int32_t receiver) {
    return receiver < 0 ? HUB_EVERYONE : (uint64_t)1 << receiver;
}

static void apply(const struct hub_rule *rule, struct hub_verdict *verdict, uint32_t random,
                  uint32_t length) {
    switch ((enum hub_fault_kind)rule->kind) {
    case HUB_LOSE:
        verdict->lost_to |= set_of(rule->receiver);
        break;
    case HUB_CORRUPT:
        verdict->corrupt_to |= set_of(rule->receiver);
        verdict->corrupt_bit = (uint32_t)((uint64_t)random * length * 8 >> 32);
        break;
    case HUB_DUPLICATE:
        verdict->duplicate = true;
        break;
    case HUB_ERROR:
        verdict->error = true;
        verdict->error_at = random;
        break;
    case HUB_DELAY:
        verdict->delay_ns += rule->time_ns + (uint64_t)((double)rule->jitter_ns * random / 4294967296.0);
        break;
    case HUB_BUS_OFF:
        verdict->off_ns = verdict->off_ns > rule->time_ns ? verdict->off_ns : rule->time_ns;
        break;
    case HUB_KINDS:
        break;
    }
}

static bool selects(const struct hub_rule *rule, int sender, uint32_t id, uint32_t length,
                    uint64_t elapsed_ns) {
    return ((id ^ rule->id) & rule->mask) == 0 && (rule->sender < 0 || rule->sender == sender) &&
           elapsed_ns >= rule->from_ns && elapsed_ns < rule->until_ns && !is_timed(rule) &&
           (rule->kind != HUB_CORRUPT || length > 0); // a frame without data cannot be corrupted
}

struct hub_verdict hub_faults_judge(struct hub_faults *faults, uint32_t kinds, int sender, uint32_t id,
                                    uint32_t length, uint64_t now_ns) {
    struct hub_verdict verdict = {0};
    uint64_t elapsed_ns = now_ns > faults->start_ns ? now_ns - faults->start_ns : 0;
    for (uint32_t i = 0; i < faults->count; i++) {
        const struct hub_rule *rule = &faults->rules[i];
        if (!(kinds >> rule->kind & 1) || !selects(rule, sender, id, length, elapsed_ns))
            continue;
        uint64_t nth = ++faults->picked[i][sender], random = draw(faults, i, sender, nth);
        faults->counters[i].picked++;
        if (rule->nth ? nth != rule->nth : (uint32_t)random >= faults->thresholds[i])
            continue;
        faults->counters[i].hits++;
        apply(rule, &verdict, (uint32_t)(random >> 32), length);
    }
    return verdict;
}

int hub_faults_due(struct hub_faults *faults, uint64_t now_ns) {
    if (faults->next_off_ns > now_ns)
        return -1;
    for (uint32_t i = 0; i < faults->count; i++)
        if (off_time(faults, i) == faults->next_off_ns) {
            faults->counters[i].hits++;
            find_next_off(faults);
            return (int)i;
        }
    return -1;
}
