// SPDX-License-Identifier: Apache-2.0
// See hub.h.
#include "nodes/virtual/hub.h"
#include "nodes/support/can_bits.h"
#include "nodes/virtual/hub_queue.h"

#include <string.h>

// After ATTEMPTS consecutive failures the error counter of a controller (8 each) is 256: bus-off. It recovers
// when it has seen the bus free for 128 times 11 bits. An error frame has a flag of 6 to 12 bits (here 12:
// others add their own to the first), a delimiter of 8, and 3 of interframe space.
enum { ATTEMPTS = 256 / 8, RECOVERY_BITS = 128 * 11, ERROR_BITS = 12 + 8 + 3, UNPROTECTED_BITS = 7 + 3 };

static const uint64_t NS_PER_S = 1000000000;

// ------------------------------------------------------------------------------------------------- clients

void hub_init(struct hub *hub, const struct hub_config *config) {
    memset(hub, 0, sizeof(*hub));
    hub->config = *config;
    hub->random = config->seed;
    hub->loss_threshold = (uint64_t)(config->loss * 4294967296.0);
    hub->on_wire = -1;
    hub_set_rules(hub, NULL, 0, 0);
}

void hub_set_rules(struct hub *hub, const struct hub_rule *rules, size_t count, uint64_t now_ns) {
    hub_faults_init(&hub->faults, rules, count, hub->config.seed, now_ns);
}

int hub_connect(struct hub *hub) {
    for (int i = 0; i < HUB_CLIENTS; i++) {
        struct hub_client *client = &hub->clients[i];
        if (client->state == HUB_FREE) {
            hub->places = i < hub->places ? hub->places : i + 1;
            memset(client, 0, sizeof(*client));
            client->state = HUB_PRESENT;
            return i;
        }
    }
    hub->counters.refused++;
    return -1;
}

// CLIENT no longer stops the bus; the time for which the bus stood still is not made up for.
static void unstick(struct hub *hub, struct hub_client *client, uint64_t now_ns) {
    if (client->stuck_ns == 0)
        return;
    client->stuck_ns = 0;
    hub->free_ns = hub->free_ns > now_ns ? hub->free_ns : now_ns;
}

void hub_leave(struct hub *hub, int client, uint64_t now_ns) {
    if (hub->clients[client].state != HUB_PRESENT)
        return;
    hub->clients[client].state = HUB_LEAVING;
    unstick(hub, &hub->clients[client], now_ns);
}

bool hub_finished(const struct hub *hub, int client) {
    const struct hub_client *gone = &hub->clients[client];
    return gone->state == HUB_EXPELLED || (gone->state == HUB_LEAVING && input_count(gone) == 0);
}

void hub_release(struct hub *hub, int client) {
    hub->clients[client].state = HUB_FREE;
}

// ------------------------------------------------------------------------------------------------- faults

static bool is_connected(const struct hub_client *client) {
    return client->state == HUB_PRESENT || client->state == HUB_LEAVING;
}

// Drops what the client has waiting and aborts what it has on the wire.
static void go_off(struct hub *hub, int i, uint64_t now_ns, uint64_t duration_ns) {
    struct hub_client *client = &hub->clients[i];
    uint32_t kept = hub->on_wire == i;
    hub->aborted = hub->aborted || kept;
    uint32_t dropped = input_count(client) - kept;
    client->input_tail = client->input_head + kept;
    client->attempts = 0;
    client->repeating = false;
    hub->counters.unsent += dropped;
    hub->counters.bus_offs++;
    if (now_ns + duration_ns > client->off_ns)
        client->off_ns = now_ns + duration_ns;
}

// Applies the timed rules that are due up to NOW_NS; returns whether there was one.
static bool apply_timed_rules(struct hub *hub, uint64_t now_ns) {
    bool acted = false;
    for (int i; (i = hub_faults_due(&hub->faults, now_ns)) >= 0; acted = true) {
        const struct hub_rule *rule = &hub->faults.rules[i];
        for (int k = 0; k < hub->places; k++)
            if (is_connected(&hub->clients[k]) && (rule->sender < 0 || rule->sender == k))
                go_off(hub, k, hub->faults.start_ns + rule->from_ns, rule->time_ns);
    }
    return acted;
}

// The verdict on a frame of CLIENT by rules of these kinds; usually there are none.
static struct hub_verdict judge(struct hub *hub, uint32_t kinds, int client, const uint8_t *record,
                                uint64_t now_ns) {
    if (!(hub->faults.kinds & kinds))
        return (struct hub_verdict){0};
    return hub_faults_judge(&hub->faults, kinds, client, record_id(record), record[LENGTH_AT], now_ns);
}

// ------------------------------------------------------------------------------------------------- input

size_t hub_room(const struct hub *hub, int client) {
    const struct hub_client *from = &hub->clients[client];
    return (HUB_INPUT - input_count(from)) * HUB_RECORD - from->partial_size;
}

static void take_record(struct hub *hub, int client, uint64_t ready_ns) {
    struct hub_client *from = &hub->clients[client];
    if (!is_frame(from->partial)) {
        from->counters.rejected++;
        hub->counters.rejected++;
        return;
    }
    if (ready_ns < from->off_ns) {
        hub->counters.unsent++;
        return;
    }
    uint64_t delay_ns = judge(hub, 1u << HUB_DELAY, client, from->partial, ready_ns).delay_ns;
    hub->counters.delayed += delay_ns > 0;
    struct hub_frame *frame = &from->input[from->input_tail++ % HUB_INPUT];
    frame->ready_ns = ready_ns + delay_ns;
    copy_frame(frame->record, from->partial);
}

void hub_receive(struct hub *hub, int client, const uint8_t *data, size_t size, uint64_t now_ns) {
    struct hub_client *from = &hub->clients[client];
    if (!is_connected(from))
        return;
    if (hub->faults.next_off_ns <= now_ns) // frames from before it leaves or rejoins are judged first
        hub_run(hub, now_ns);
    // What had no room last time was ready then: a late reader must not cost it its place.
    uint64_t ready_ns = from->backlog_ns ? from->backlog_ns : now_ns;
    bool fills = size == hub_room(hub, client);
    while (size > 0) {
        size_t part = HUB_RECORD - from->partial_size;
        part = part < size ? part : size;
        memcpy(from->partial + from->partial_size, data, part);
        from->partial_size += (uint32_t)part;
        data += part;
        size -= part;
        if (from->partial_size == HUB_RECORD) {
            from->partial_size = 0;
            take_record(hub, client, ready_ns);
        }
    }
    from->backlog_ns = fills ? now_ns : 0;
}

// ------------------------------------------------------------------------------------------------- the bus

// splitmix64: any seed is suitable.
static uint32_t next_random(struct hub *hub) {
    uint64_t z = hub->random += 0x9E3779B97F4A7C15;
    z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9;
    z = (z ^ z >> 27) * 0x94D049BB133111EB;
    return (uint32_t)((z ^ z >> 31) >> 32);
}

static bool takes_part(const struct hub_client *client) {
    return is_connected(client) && input_count(client) > 0;
}

// When the next frame can start, or HUB_NEVER.
static uint64_t next_start(const struct hub *hub) {
    uint64_t ready_ns = HUB_NEVER;
    for (int i = 0; i < hub->places; i++) {
        const struct hub_client *client = &hub->clients[i];
        if (takes_part(client) && input_head(client)->ready_ns < ready_ns)
            ready_ns = input_head(client)->ready_ns;
    }
    return ready_ns > hub->free_ns ? ready_ns : hub->free_ns;
}

// The client whose head wins among those ready at START_NS; there is at least one.
static int arbitrate(const struct hub *hub, uint64_t start_ns) {
    int winner = -1;
    uint32_t winner_id = UINT32_MAX;
    for (int k = 1; k <= hub->places; k++) {
        int i = (hub->last_winner + k) % hub->places; // the last winner comes last among equals
        const struct hub_client *client = &hub->clients[i];
        if (!takes_part(client))
            continue;
        const struct hub_frame *head = input_head(client);
        if (head->ready_ns <= start_ns && record_id(head->record) < winner_id) {
            winner = i;
            winner_id = record_id(head->record);
        }
    }
    return winner;
}

// Returns whether every receiver has room; those without are recorded as stopping the bus.
static bool all_have_room(struct hub *hub, int sender, uint64_t now_ns) {
    bool room = true;
    for (int i = 0; i < hub->places; i++) {
        struct hub_client *client = &hub->clients[i];
        if (i == sender || !output_full(client))
            continue;
        if (client->stuck_ns == 0)
            client->stuck_ns = now_ns;
        if (now_ns - client->stuck_ns >= hub->config.stuck_limit_ns) {
            client->state = HUB_EXPELLED;
            hub->counters.expelled++;
            unstick(hub, client, now_ns);
            continue;
        }
        room = false;
    }
    return room;
}

static void start_frame(struct hub *hub, int client, uint64_t start_ns) {
    const uint8_t *record = input_head(&hub->clients[client])->record;
    uint32_t bits = can_frame_bits(record_id(record), record[LENGTH_AT], record + DATA_AT);
    struct hub_verdict verdict = judge(hub, 1u << HUB_ERROR, client, record, start_ns);
    hub->fails = verdict.error;
    hub->aborted = false;
    if (hub->fails)
        bits = 1 + (uint32_t)((uint64_t)verdict.error_at * (bits - UNPROTECTED_BITS) >> 32) + ERROR_BITS;
    uint64_t duration_ns = 0;
    if (hub->config.bitrate) {
        // The remainder of the division is carried over, so that rounding causes no drift of the rate.
        uint64_t carry = start_ns == hub->free_ns ? hub->bit_carry : 0;
        uint64_t scaled = bits * NS_PER_S + carry;
        duration_ns = scaled / hub->config.bitrate;
        hub->bit_carry = scaled % hub->config.bitrate;
    }
    hub->on_wire = hub->last_winner = client;
    hub->free_ns = start_ns + duration_ns;
    hub->counters.frames += !hub->fails;
    hub->counters.bits += bits;
    hub->counters.busy_ns += duration_ns;
}

// Delivers the frame to all other clients, except where the verdict or bus-off prevents it.
static void deliver(struct hub *hub, const uint8_t *record, const struct hub_verdict *verdict) {
    uint8_t corrupted[HUB_RECORD];
    memcpy(corrupted, record, HUB_RECORD);
    corrupted[DATA_AT + verdict->corrupt_bit / 8] ^= (uint8_t)(0x80 >> verdict->corrupt_bit % 8);
    bool changed = false;
    for (int i = 0; i < hub->places; i++) {
        struct hub_client *client = &hub->clients[i];
        if (i == hub->on_wire || client->state != HUB_PRESENT)
            continue;
        bool corrupt = verdict->corrupt_to >> i & 1;
        if (client->off_ns > hub->free_ns)
            hub->counters.unheard++;
        else if (verdict->lost_to >> i & 1)
            hub->counters.lost_copies++;
        else
            output_push(client, corrupt ? corrupted : record);
        changed = changed || corrupt;
    }
    hub->counters.corrupted += changed;
}

// Completes the head of the sender's queue, at its last bit; returns whether it was sent.
static bool complete_frame(struct hub *hub, struct hub_client *sender) {
    const uint8_t *record = input_head(sender)->record;
    uint32_t kinds = 1u << HUB_LOSE | 1u << HUB_CORRUPT | 1u << HUB_BUS_OFF;
    if (!sender->repeating)
        kinds |= 1u << HUB_DUPLICATE;
    struct hub_verdict verdict = judge(hub, kinds, hub->on_wire, record, hub->free_ns);
    if (verdict.off_ns > 0) {
        go_off(hub, hub->on_wire, hub->free_ns, verdict.off_ns);
        return false;
    }
    sender->attempts = 0;
    sender->counters.sent++;
    if (next_random(hub) < hub->loss_threshold || verdict.lost_to == HUB_EVERYONE) {
        hub->counters.lost++;
        return true;
    }
    deliver(hub, record, &verdict);
    sender->repeating = verdict.duplicate;
    hub->counters.duplicated += sender->repeating;
    return !sender->repeating;
}

static uint64_t recovery_ns(const struct hub *hub) {
    return hub->config.bitrate ? RECOVERY_BITS * NS_PER_S / hub->config.bitrate : 0;
}

static void end_frame(struct hub *hub) {
    struct hub_client *sender = &hub->clients[hub->on_wire];
    bool sent = false;
    if (hub->fails && !hub->aborted) {
        hub->counters.errors++;
        if (++sender->attempts == ATTEMPTS)
            go_off(hub, hub->on_wire, hub->free_ns, recovery_ns(hub));
    } else if (!hub->aborted) {
        sent = complete_frame(hub, sender);
    }
    if (hub->aborted) {
        hub->counters.unsent++;
        hub->counters.frames -= !hub->fails;
    }
    sender->input_head += sent || hub->aborted;
    hub->on_wire = -1;
}

static uint64_t earlier(uint64_t a_ns, uint64_t b_ns) {
    return a_ns < b_ns ? a_ns : b_ns;
}

void hub_run(struct hub *hub, uint64_t now_ns) {
    for (;;) {
        if (hub->on_wire >= 0) {
            apply_timed_rules(hub, earlier(hub->free_ns, now_ns));
            if (hub->free_ns > now_ns)
                return;
            end_frame(hub);
        }
        uint64_t start_ns = next_start(hub);
        if (apply_timed_rules(hub, earlier(start_ns, now_ns)))
            continue; // the frame that was to start may be dropped
        if (start_ns > now_ns)
            return;
        int winner = arbitrate(hub, start_ns);
        if (!all_have_room(hub, winner, now_ns)) {
            if (apply_timed_rules(hub, now_ns)) // timed rules apply although the bus stands still
                continue;
            return;
        }
        // Expelling someone may have moved the time at which the bus was free.
        start_frame(hub, winner, start_ns > hub->free_ns ? start_ns : hub->free_ns);
    }
}

uint64_t hub_deadline(const struct hub *hub) {
    uint64_t off_ns = hub->faults.next_off_ns;
    if (hub->on_wire >= 0)
        return earlier(hub->free_ns, off_ns);
    uint64_t start_ns = next_start(hub);
    if (start_ns == HUB_NEVER)
        return off_ns;
    uint64_t expel_ns = HUB_NEVER;
    for (int i = 0; i < hub->places; i++) {
        const struct hub_client *client = &hub->clients[i];
        if (client->state == HUB_PRESENT && client->stuck_ns)
            expel_ns = earlier(expel_ns, client->stuck_ns + hub->config.stuck_limit_ns);
    }
    return earlier(expel_ns == HUB_NEVER ? start_ns : expel_ns, off_ns);
}

// ------------------------------------------------------------------------------------------------- output

size_t hub_output(const struct hub *hub, int client, const uint8_t **data) {
    const struct hub_client *to = &hub->clients[client];
    uint32_t at = to->output_head % OUTPUT_BYTES, size = to->output_tail - to->output_head;
    *data = to->output + at;
    return size < OUTPUT_BYTES - at ? size : OUTPUT_BYTES - at;
}

void hub_taken(struct hub *hub, int client, size_t size, uint64_t now_ns) {
    struct hub_client *to = &hub->clients[client];
    to->output_head += (uint32_t)size;
    if (size > 0)
        unstick(hub, to, now_ns);
}
