// SPDX-License-Identifier: Apache-2.0
// The receiving half of a link: blocks from bytes, acknowledgements, naks, round trips, first contact.
#include <string.h>

#include "nodes/link/core/link_core.h"

// A block without new bytes for this time is incomplete or has a damaged length byte. It is given up so that
// valid blocks in its bytes, often the expected acknowledgement, do not wait for its end. Not sooner, though:
// a bus without room (other nodes' frames first, ENOBUFS at the sender) holds the rest of a sound block back
// for tens of milliseconds, and a response given up is never sent again.
#define GAP_NS (100 * NS_PER_MS)
// A check that is so late means that this computer stood still, as the sender may have: wait once more.
#define LATE_NS (10 * NS_PER_MS)
#define OUTLIER_NS (10 * NS_PER_MS)

// ----------------------------------------------------------------------------------------- acknowledgement

static void note_lead(struct link *link, uint64_t req_clock, uint64_t now) {
    int64_t lead_ns = (int64_t)(link_clock_to_ns(link, req_clock) - now);
    struct link_stats *stats = &link->stats;
    if (!stats->lead_count++ || lead_ns < stats->lead_min_ns)
        stats->lead_min_ns = lead_ns;
    size_t bucket = 0;
    if (lead_ns >= 0)
        for (bucket = 1; bucket < LINK_LEAD_BUCKETS - 1; bucket++)
            if ((uint64_t)lead_ns < NS_PER_MS << (bucket - 1))
                break;
    stats->lead_histogram[bucket]++;
}

// Returns the greatest difference from the mean that one sample counts with. An acknowledgement that got lost
// is replaced by the node's next answer, perhaps much later, and the time of that is no round trip.
static uint64_t most_above(const struct link_stats *stats) {
    return stats->srtt_ns > OUTLIER_NS ? stats->srtt_ns : OUTLIER_NS;
}

static void measure_round_trip(struct link *link, const struct link_block *block, uint64_t now) {
    struct link_stats *stats = &link->stats;
    uint64_t sample_ns = now > block->sent_ns ? now - block->sent_ns : 1;
    if (block->repeats) {
        // Of either transmission: the time since the last one is not longer than a round trip. If it is too
        // short to be one, an earlier one was answered, late, and the timeout is too short: its doublings
        // stay.
        if (2 * sample_ns < stats->srtt_ns)
            return;
        link->backoff = 0;
        if (sample_ns <= stats->srtt_ns)
            return;
    }
    if (stats->srtt_ns) {
        if (sample_ns > stats->srtt_ns + most_above(stats))
            sample_ns = stats->srtt_ns + most_above(stats);
        uint64_t error_ns =
            sample_ns > stats->srtt_ns ? sample_ns - stats->srtt_ns : stats->srtt_ns - sample_ns;
        stats->rttvar_ns = (3 * stats->rttvar_ns + error_ns) / 4;
        stats->srtt_ns = (7 * stats->srtt_ns + sample_ns) / 8;
    } else {
        stats->srtt_ns = sample_ns;
        stats->rttvar_ns = sample_ns / 2;
    }
    // Only now: if any progress reset the doublings, every block would be repeated once the round trip
    // exceeds the timeout, and it would never be measured.
    link->backoff = 0;
}

// The node has answered all repeats: no further naks are theirs, and it has read them.
static void repeats_are_answered(struct link *link) {
    link->naks_outstanding = link->late_bytes = 0;
}

// Everything before SEQUENCE has arrived.
static void acknowledge(struct link *link, uint64_t sequence, uint64_t now) {
    measure_round_trip(link, block_of(link, sequence - 1), now);
    for (; link->first < sequence; link->first++) {
        const struct link_block *block = block_of(link, link->first);
        if (link->first < link->cursor) {
            link->in_flight_bytes -= block->wire_length;
            // The answer may be one to an earlier transmission: the node may not have read this one yet.
            if (block->repeats && link->naks_outstanding)
                link->late_bytes += block->wire_length;
        }
        link->in_flight_commands -= block->commands;
        if (link->clock_hz > 0)
            for (size_t i = 0; i < block->leads; i++)
                note_lead(link, block->req_clock[i], now);
    }
    if (link->cursor < sequence)
        link->cursor = sequence;
    link->progress_ns = now;
    link->ignored_nak_ns = 0;
    if (sequence > link->outstanding_until_seq) // a block after the repeats was answered, and so were they
        repeats_are_answered(link);
}

static void handle_nak(struct link *link, uint64_t now) {
    link->stats.naks++;
    if (link->cursor == link->first)
        return; // the repeat is on its way already
    if (link->naks_outstanding && now < link->outstanding_until_ns) {
        if (--link->naks_outstanding == 0)
            repeats_are_answered(link);
        link->ignored_nak_ns = now;
        return;
    }
    link_rewind(link, now, LEAD_SYNC);
}

// ------------------------------------------------------------------------------------------- first contact

static void adopt(struct link *link, uint64_t sequence) {
    link->first = link->cursor = link->next = sequence;
    link->in_flight_bytes = 0;
    repeats_are_answered(link);
}

// The first answer to an empty block reports the node's expected sequence: the block was accepted, or refused
// with that answer. The node may still accept a late repeat of the first one, so a second empty block, with
// the reported sequence, confirms it before commands are sent.
static void handle_probe_answer(struct link *link, unsigned answer, uint64_t now) {
    if (link->cursor == link->first)
        return; // not an answer to this link: from before
    unsigned behind = (answer - (unsigned)link->first) & WIRE_SEQ_MASK;
    if (link->state == LINK_CONFIRMING && behind == 0)
        return; // a further answer to the first one
    link->state = link_following(link->state, behind == 1 ? LINK_EVENT_TAKEN : LINK_EVENT_REFUSED);
    if (link->state == LINK_RUNNING) {
        acknowledge(link, link->first + 1, now);
        repeats_are_answered(link);
        link->last_ack = link->first;
    } else {
        adopt(link, link->first + behind);
    }
}

// -------------------------------------------------------------------------------------------------- blocks

static void handle_sequence(struct link *link, unsigned answer, int empty, uint64_t now) {
    if (link->state == LINK_LOST)
        return;
    if (link->state != LINK_RUNNING) {
        handle_probe_answer(link, answer, now);
        return;
    }
    uint64_t sequence = link->first + ((answer - (unsigned)link->first) & WIRE_SEQ_MASK);
    if (sequence > link->next) {
        link->stats.acks_never_sent++;
        return;
    }
    if (sequence > link->first)
        acknowledge(link, sequence, now);
    else if (empty && link->last_ack == sequence && link->first < link->next)
        handle_nak(link, now);
    else if (empty && link->last_ack == sequence)
        link->stats.acks_duplicate++;
    // A response and the acknowledgement after it have the same sequence: only a second *empty* block is a
    // nak.
    if (empty)
        link->last_ack = sequence;
}

static void handle_block(struct link *link, const uint8_t *bytes, size_t length, uint64_t now,
                         struct link_response *response) {
    unsigned answer = bytes[1] & WIRE_SEQ_MASK;
    link->stats.blocks_received++;
    link->heard_ns = now;
    handle_sequence(link, answer, length == WIRE_BLOCK_MIN, now);
    response->size = (uint8_t)(length - WIRE_BLOCK_MIN);
    memcpy(response->content, bytes + WIRE_HEADER, response->size);
    const struct link_block *asked = const_block_of(link, link->first - 1);
    int known =
        link->state == LINK_RUNNING && ((link->first - answer) & WIRE_SEQ_MASK) == 0 && !asked->repeats;
    response->sent_ns = known ? asked->sent_ns : 0;
    response->received_ns = now;
}

// Drops the front of the buffer up to and including the next sync byte.
static void give_up_partial(struct link *link) {
    const uint8_t *sync = memchr(link->rx, WIRE_SYNC, link->rx_used);
    size_t drop = sync ? (size_t)(sync - link->rx) + 1 : link->rx_used;
    link->stats.bytes_invalid += drop;
    link->rx_used -= drop;
    memmove(link->rx, link->rx + drop, link->rx_used);
}

// Returns whether an empty block stands behind a sync byte in the incomplete one. Then the length of that one
// is wrong. Without this, the answers to repeats, which follow each other within GAP_NS, would be taken for a
// part of it.
static int holds_answer(const struct link *link) {
    for (size_t at = WIRE_HEADER; at + WIRE_BLOCK_MIN < link->rx_used; at++) {
        const uint8_t *bytes = link->rx + at + 1;
        uint8_t answer[WIRE_BLOCK_MIN];
        if (link->rx[at] != WIRE_SYNC || bytes[0] != WIRE_BLOCK_MIN || bytes[1] >> 4 != WIRE_SEQ_MARK >> 4)
            continue;
        wire_block_finish(answer, 0, bytes[1] & WIRE_SEQ_MASK);
        if (memcmp(bytes, answer, WIRE_BLOCK_MIN) == 0)
            return 1;
    }
    return 0;
}

// Takes one step through the receive buffer; returns 0 when it needs more bytes.
static int scan_once(struct link *link, uint64_t now, struct link_response *response) {
    size_t skip, length;
    int hunting = link->scanner.hunting;
    enum wire_scan found = wire_scan(&link->scanner, link->rx, link->rx_used, &skip, &length);
    if (found == WIRE_LOST || hunting)
        link->stats.bytes_invalid += skip;
    if (found == WIRE_BLOCK)
        handle_block(link, link->rx + skip, length, now, response);
    link->rx_used -= skip + length;
    memmove(link->rx, link->rx + skip + length, link->rx_used);
    if (found != WIRE_MORE || !holds_answer(link))
        return found != WIRE_MORE;
    give_up_partial(link);
    return 1;
}

uint64_t link_partial_deadline(const struct link *link) {
    return link->rx_used ? link->rx_ns + GAP_NS : LINK_NEVER;
}

static int is_given_up(struct link *link, uint64_t now) {
    uint64_t deadline_ns = link_partial_deadline(link);
    if (now < deadline_ns)
        return 0;
    if (link->rx_excused || now - deadline_ns <= LATE_NS)
        return 1;
    link->rx_excused = 1;
    link->rx_ns = now;
    return 0;
}

int link_receive(struct link *link, const uint8_t **data, size_t *size, uint64_t now,
                 struct link_response *response) {
    response->size = 0;
    int late = *size == 0 && is_given_up(link, now);
    for (;;) {
        size_t room = LINK_RX_MAX - link->rx_used, taken = *size < room ? *size : room;
        if (taken) {
            memcpy(link->rx + link->rx_used, *data, taken);
            link->rx_used += taken;
            link->rx_ns = now;
            link->rx_excused = 0;
            link->stats.bytes_received += taken;
            *data += taken;
            *size -= taken;
        }
        while (scan_once(link, now, response))
            if (response->size)
                return 1;
        if (*size == 0 && !(late && link->rx_used))
            return 0;
        if (late)
            give_up_partial(link);
    }
}
