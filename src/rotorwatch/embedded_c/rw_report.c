#include "rw_report.h"

#include <string.h>

static const rw_time TOUCH_DOWN_S = 1.0;           /* a contact so near the end of a flight is the landing, or the crash */
static const rw_time EXPLAINED_S = 1.0;            /* so near an override a loss is the override */
static const rw_time SAME_S = 1.0;                 /* two onsets so close are of one event */
static const rw_time TOGETHER_S = 1.0;             /* losses that begin so close began together */
static const rw_real LARGE = (rw_real)0.5;         /* share of the largest loss from which one is large */
static const rw_real LOSS_STEP = (rw_real)0.02;    /* by which a loss or a bound of it must move to be told again */

static rw_time apart(rw_time a, rw_time b) { return a < b ? b - a : a - b; }

void rw_report_init(rw_report *r)
{
    memset(r, 0, sizeof *r);
    r->air_start = r->fall_start = RW_LASTS;
    r->landed = r->now = -RW_LASTS;
}

void rw_report_tick(rw_report *r, const rw_tick *tick)
{
    r->now = tick->time;
    if (tick->air_start >= RW_LASTS) return;
    if (tick->air_start < r->air_start || tick->air_start > r->air_start) {
        r->air_start = tick->air_start;
        r->fall_start = RW_LASTS;
    }
    if (!tick->upset) r->fall_start = RW_LASTS;
    else if (r->fall_start >= RW_LASTS) r->fall_start = tick->time;
}

void rw_report_landed(rw_report *r, rw_time end)
{
    int kept = 0;
    if (r->fall_start < RW_LASTS) {
        if (r->fall_count == RW_FALLS) {
            memmove(&r->falls[0], &r->falls[1], (RW_FALLS - 1) * sizeof r->falls[0]);
            r->fall_count--;
        }
        r->falls[r->fall_count].start = r->fall_start;
        r->falls[r->fall_count].end = end;
        r->fall_count++;
    }
    for (int i = 0; i < r->knock_count; i++) {
        if (apart(r->knocks[i].time, end) >= TOUCH_DOWN_S) r->knocks[kept++] = r->knocks[i];
    }
    r->knock_count = (uint8_t)kept;
    r->air_start = r->fall_start = RW_LASTS;
    r->landed = end;
}

void rw_report_contact(rw_report *r, rw_time time, int push, rw_real size)
{
    int at = r->knock_count;
    if (apart(time, r->landed) < TOUCH_DOWN_S) return;
    if (at > 0 && !(r->knocks[at - 1].time < time)) at--;
    else if (at == RW_CONTACTS) {
        memmove(&r->knocks[0], &r->knocks[1], (RW_CONTACTS - 1) * sizeof r->knocks[0]);
        at--;
    }
    r->knocks[at].time = time;
    r->knocks[at].push = (uint8_t)push;
    r->knocks[at].size = size;
    r->knock_count = (uint8_t)(at + 1);
}

/* Does the override begin in a fall? */
static bool falls(const rw_report *r, rw_time onset)
{
    for (int i = 0; i < r->fall_count; i++) {
        if (r->falls[i].start < onset && onset <= r->falls[i].end) return true;
    }
    return r->fall_start < onset && onset <= r->now;
}

/* One event more, sorted by when it was detected; of too many the first goes. */
static int put(rw_event *out, int count, const rw_event *event)
{
    if (count == RW_EVENTS) {
        if (event->detected < out[0].detected) return count;
        memmove(&out[0], &out[1], (size_t)(--count) * sizeof out[0]);
    }
    int at = count;
    for (; at > 0 && out[at - 1].detected > event->detected; at--) out[at] = out[at - 1];
    out[at] = *event;
    return count + 1;
}

int rw_report_events(const rw_report *r, const rw_event *losses, int loss_count, const rw_override *overrides, int override_count,
                     rw_event *out)
{
    int count = 0;
    for (int i = 0; i < loss_count; i++) {
        bool explained = false;
        for (int j = 0; j < override_count; j++) {
            const rw_override *o = &overrides[j];
            explained = explained || (!falls(r, o->onset) && o->onset - EXPLAINED_S <= losses[i].onset
                                      && losses[i].onset <= o->end + EXPLAINED_S);
        }
        if (!explained) count = put(out, count, &losses[i]);
    }
    for (int j = 0; j < override_count; j++) {
        const rw_override *o = &overrides[j];
        rw_event event;
        if (falls(r, o->onset)) continue;
        memset(&event, 0, sizeof event);
        event.onset = o->onset;
        event.detected = o->detected;
        event.end = o->end;
        event.probability = 1;
        event.rotors = (rw_rotors)(1u << o->rotor);
        event.kind = RW_OUTPUT_OVERRIDE;
        event.detail = (uint8_t)o->kind;
        count = put(out, count, &event);
    }
    for (int i = 0; i < r->knock_count; i++) {
        rw_event event;
        if (r->air_start < RW_LASTS && apart(r->knocks[i].time, r->now) < TOUCH_DOWN_S) continue; /* it may be the landing */
        memset(&event, 0, sizeof event);
        event.onset = event.detected = event.end = r->knocks[i].time;
        event.probability = 1;
        event.size = r->knocks[i].size;
        event.kind = RW_CONTACT;
        event.detail = r->knocks[i].push;
        count = put(out, count, &event);
    }
    return count;
}

static bool matters(const rw_event *e) { return e->kind != RW_CONTACT; }

enum rw_verdict rw_report_verdict(const rw_event *events, int count, bool judged)
{
    bool unsure = false;
    for (int i = 0; i < count; i++) {
        if (matters(&events[i]) && events[i].alternative_count == 0) return RW_FAULT;
        unsure = unsure || matters(&events[i]);
    }
    return unsure ? RW_AMBIGUOUS : judged ? RW_HEALTHY : RW_NOT_JUDGED;
}

/* Number of rotors in a set, two at most: those that have a loss of their own. */
static int losses_of(const rw_event *e)
{
    int count = 0;
    for (int k = 0; k < RW_ROTORS && count < RW_TOGETHER; k++) count += (e->rotors >> k) & 1;
    return count;
}

/* Is it of this kind, and, where there are sure ones, sure? */
static bool counts(const rw_event *e, int kind, bool sure) { return e->kind == kind && !(sure && e->alternative_count); }

static rw_real largest(const rw_event *e)
{
    rw_real most = 0;
    for (int i = 0; i < losses_of(e); i++) most = e->loss[i] > most ? e->loss[i] : most;
    return most;
}

int rw_report_main(const rw_event *events, int count)
{
    bool sure = false;
    rw_real most = 0, size = -1;
    rw_time first = RW_LASTS;
    int loss = -1, override = -1;
    for (int i = 0; i < count; i++) sure = sure || (matters(&events[i]) && events[i].alternative_count == 0);
    for (int i = 0; i < count; i++) {
        if (counts(&events[i], RW_LOSS_OF_EFFECTIVENESS, sure) && largest(&events[i]) > most) most = largest(&events[i]);
    }
    for (int i = 0; i < count; i++) {
        const rw_event *e = &events[i];
        if (counts(e, RW_LOSS_OF_EFFECTIVENESS, sure) && largest(e) >= LARGE * most && e->onset < first) first = e->onset;
    }
    for (int i = 0; i < count; i++) {
        const rw_event *e = &events[i];
        if (counts(e, RW_OUTPUT_OVERRIDE, sure) && e->onset < first && (override < 0 || e->onset < events[override].onset)) override = i;
        const bool together = largest(e) >= LARGE * most && e->onset <= first + TOGETHER_S;
        if (counts(e, RW_LOSS_OF_EFFECTIVENESS, sure) && together && largest(e) > size) {
            loss = i;
            size = largest(e);
        }
    }
    return override >= 0 ? override : loss;
}

void rw_changes_init(rw_changes *c) { memset(c, 0, sizeof *c); }

static bool same_time(rw_time a, rw_time b) { return !(a < b) && !(b < a); }

static bool equal(const rw_event *old, const rw_event *now)
{
    return old->kind == now->kind && old->rotors == now->rotors && same_time(old->detected, now->detected);
}

/* One event of which more is known now: what began together, was announced together, or has the same rotors at the same time. */
static bool alike(const rw_event *old, const rw_event *now)
{
    if (old->kind != now->kind || (old->kind != RW_LOSS_OF_EFFECTIVENESS && old->rotors != now->rotors)) return false;
    return apart(old->onset, now->onset) < SAME_S || same_time(old->detected, now->detected);
}

static bool moved(rw_real old, rw_real now) { return old - now >= LOSS_STEP || now - old >= LOSS_STEP; }

static bool differs(const rw_event *old, const rw_event *now)
{
    if (old->rotors != now->rotors || old->alternative_count != now->alternative_count || old->detail != now->detail) return true;
    if ((old->end < RW_LASTS) != (now->end < RW_LASTS)) return true;
    for (int i = 0; i < now->alternative_count; i++) {
        if (old->alternatives[i] != now->alternatives[i]) return true;
    }
    for (int i = 0; now->kind == RW_LOSS_OF_EFFECTIVENESS && i < losses_of(now); i++) {
        if (moved(old->loss[i], now->loss[i]) || moved(old->lower[i], now->lower[i]) || moved(old->upper[i], now->upper[i])) return true;
    }
    return false;
}

int rw_changes_of(rw_changes *c, const rw_event *events, int count, rw_time settled, rw_event *gone, rw_news *news)
{
    int8_t of[RW_EVENTS], matched[RW_EVENTS];
    int told = 0, left = 0, withdrawn = 0;
    memset(of, -1, sizeof of);
    memset(matched, -1, sizeof matched);
    for (int way = 0; way < 2; way++) {
        for (int i = 0; i < count; i++) {
            for (int j = 0; of[i] < 0 && j < c->count; j++) {
                if (matched[j] >= 0 || !(way ? alike : equal)(&c->told[j].event, &events[i])) continue;
                of[i] = (int8_t)j;
                matched[j] = (int8_t)i;
            }
        }
    }
    for (int j = 0; j < c->count; j++) { /* what is not there any more */
        if (matched[j] >= 0) {
            of[matched[j]] = (int8_t)left;
            c->told[left++] = c->told[j];
        } else if (!(c->told[j].event.end < settled)) {
            gone[withdrawn] = c->told[j].event;
            news[told].event = &gone[withdrawn++];
            news[told].number = c->told[j].number;
            news[told++].kind = RW_WITHDRAWN;
        }
    }
    c->count = (uint8_t)left;
    for (int i = 0; i < count; i++) {
        const bool new_one = of[i] < 0;
        if (!new_one && !differs(&c->told[of[i]].event, &events[i])) continue;
        rw_told *place = &c->told[new_one ? c->count++ : of[i]];
        if (new_one) place->number = ++c->numbers;
        place->event = events[i];
        news[told].event = &events[i];
        news[told].number = place->number;
        news[told++].kind = new_one ? RW_ANNOUNCED : RW_CHANGED;
    }
    return told;
}
