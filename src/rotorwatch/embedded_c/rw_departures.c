#include "rw_departures.h"

#include <math.h>
#include <string.h>

#define N RW_ROTORS

static const rw_real FLYING = (rw_real)0.05;     /* share of full thrust above which a rotor does enough for a comparison */
static const rw_real PART = (rw_real)0.05;       /* share by which an output may differ from what the mixer asks */
static const rw_real PART_STILL = (rw_real)0.015; /* the same of an output that does not move at all */
static const double NOISE_SD = 0.004;            /* share; rounding of outputs, and the controller between two samples */
static const uint32_t PROVEN = 20u;              /* comparisons that a mixer must have passed before it can accuse */
static const double UNEXPLAINED = 0.25;          /* share of what outputs part by that a mixer may leave unexplained */
static const rw_real AGREEING = (rw_real)0.7;    /* share of the others that must agree before one is accused */
static const rw_time STUCK_S = 1.0, SILENT_S = 0.5, BACK_S = 0.5;
static const rw_time CONFIRM_S = 0.25;
enum { CONFIRM_SAMPLES = 3, SHARES_OF_YAW = 11 };

static rw_real magnitude(rw_real x) { return x < 0 ? -x : x; }

static rw_real clipped(rw_real x, rw_real top) { return x < 0 ? 0 : x > top ? top : x; }

/* Median of count > 0 values, which it sorts. */
static rw_real median(rw_real *x, int count)
{
    for (int i = 1; i < count; i++) {
        const rw_real value = x[i];
        int j = i;
        for (; j > 0 && x[j - 1] > value; j--) x[j] = x[j - 1];
        x[j] = value;
    }
    return count % 2 ? x[count / 2] : (rw_real)0.5 * (x[count / 2 - 1] + x[count / 2]);
}

void rw_departures_init(rw_departures *s)
{
    memset(s, 0, sizeof *s);
    for (int way = 0; way < RW_WAYS; way++) {
        for (int k = 0; k < N; k++) {
            s->runs[way][k].onset = s->runs[way][k].well = RW_LASTS;
            s->runs[way][k].open = -1;
        }
    }
    s->last = -RW_LASTS;
}

/* Time since which a value has stayed within `tolerance` of where it settled. */
static rw_time rests(rw_rest *r, rw_time time, rw_real value, rw_real tolerance)
{
    if (!r->set || magnitude(value - r->anchor) > tolerance) {
        r->anchor = value;
        r->since = time;
        r->set = true;
    }
    return r->since;
}

/* Room for a spell: the first free place, or that of the spell that ended first; -1 where all last. */
static int8_t room(rw_departures *s)
{
    if (s->spell_count < RW_OVERRIDES) return (int8_t)s->spell_count++;
    int oldest = -1;
    for (int i = 0; i < RW_OVERRIDES; i++) {
        if (s->spells[i].end < RW_LASTS && (oldest < 0 || s->spells[i].end < s->spells[oldest].end)) oldest = i;
    }
    s->forgotten++;
    return (int8_t)oldest;
}

/* One sample of one way to find a spell: is it wrong, is it well, the output. A spell is confirmed after hold_s and `samples` in a row, and
   over when all has been well for BACK_S. Returns its place when it is confirmed at this sample, else -1. */
static int follow(rw_departures *s, int way, int k, rw_time time, bool wrong, bool back, rw_real output, rw_time hold_s,
                  int samples)
{
    rw_run *run = &s->runs[way][k];
    int confirmed = -1;
    for (int turn = 0; turn < 2; turn++) {
        if (run->open < 0) {
            if (!wrong) {
                run->onset = RW_LASTS;
                break;
            }
            if (run->onset >= RW_LASTS) {
                run->onset = time;
                run->count = 0;
                run->low = run->high = output;
            }
            if (run->count < samples) run->count++;
            if (output < run->low) run->low = output;
            if (output > run->high) run->high = output;
            if (time - run->onset < hold_s || run->count < samples) break;
            run->open = room(s);
            if (run->open < 0) { /* every place lasts: try again at the next sample */
                break;
            }
            confirmed = run->open;
            s->spells[confirmed].end = RW_LASTS;
            run->well = RW_LASTS;
        }
        if (!back) run->well = RW_LASTS;
        else if (run->well >= RW_LASTS) run->well = time;
        if (run->well >= RW_LASTS || time - run->well < BACK_S) break;
        s->spells[run->open].end = run->well; /* over; this sample may begin another */
        run->open = -1;
        run->onset = RW_LASTS;
    }
    return confirmed;
}

/* Departure of each output from what is asked and what the others have in common, within the limits; and whether these agree. `share` of
   the yaw is given up. */
static void against_others(const rw_comparison *c, rw_real share, const bool *interior, rw_real *alone, bool *agreed)
{
    rw_real asked[N], apart[N];
    for (int k = 0; k < N; k++) {
        asked[k] = c->asked[k] - share * c->yaw[k];
        apart[k] = c->demand[k] - asked[k];
    }
    for (int k = 0; k < N; k++) {
        rw_real rest[N];
        int count = 0, agree = 0;
        for (int j = 0; j < N; j++) {
            if (j != k && interior[j]) rest[count++] = apart[j];
        }
        agreed[k] = false;
        if (count < 2) continue;
        const rw_real common = median(rest, count);
        for (int j = 0; j < N; j++) {
            const rw_real off = c->demand[j] - clipped(asked[j] + common, c->top);
            if (j == k) alone[k] = off;
            else if (magnitude(off) < PART) agree++;
        }
        agreed[k] = (rw_real)agree > AGREEING * (rw_real)(N - 1);
    }
}

/* By how much each output parts from the mixer by itself, and whether anything can be said of it. Where not all that is asked can be had,
   a mixer gives up throttle, for all outputs alike, and yaw, a share of it: an output is accused with what is left of its departure under
   the share of yaw that suits it best. */
static void by_itself(const rw_comparison *c, const bool *interior, rw_real *alone, bool *known)
{
    bool odd = false;
    rw_real least = c->asked[0], most = c->asked[0];
    against_others(c, 0, interior, alone, known);
    for (int k = 0; k < N; k++) {
        odd = odd || !known[k] || !(magnitude(alone[k]) < PART);
        if (c->asked[k] < least) least = c->asked[k];
        if (c->asked[k] > most) most = c->asked[k];
    }
    if (!(most - least < (rw_real)0.97 * c->top)) {
        for (int k = 0; k < N; k++) known[k] = false;
        return;
    }
    if (!odd || c->yaw_granted) return;
    for (int i = 0; i < SHARES_OF_YAW; i++) {
        rw_real off[N];
        bool agree[N];
        against_others(c, i == SHARES_OF_YAW - 1 ? (rw_real)1 : (rw_real)i * (rw_real)0.1, interior, off, agree);
        for (int k = 0; k < N; k++) {
            if (agree[k] && !(known[k] && magnitude(off[k]) > magnitude(alone[k]))) {
                alone[k] = off[k];
                known[k] = true;
            }
        }
    }
}

void rw_departures_compared(rw_departures *s, const rw_vehicle *v, const rw_comparison *c, bool aloft)
{
    const rw_real low = v->u_min, span = v->u_max - v->u_min;
    rw_real alone[N], sorted[N], own[N], mean_asked = 0, mean_demand = 0;
    bool interior[N], known[N], fits = aloft, whole = true;
    for (int k = 0; k < N; k++) {
        interior[k] = c->output[k] > low + (rw_real)0.01 * span && c->output[k] < low + (rw_real)0.99 * span;
        sorted[k] = c->demand[k];
        mean_asked += c->asked[k];
        mean_demand += c->demand[k];
    }
    mean_asked /= (rw_real)N;
    mean_demand /= (rw_real)N;
    const bool flying = aloft && median(sorted, N) > FLYING;
    by_itself(c, interior, alone, known);
    double largest = 0, left = 0, parted = 0;
    for (int k = 0; k < N; k++) {
        if (c->output[k] >= low + (rw_real)0.99 * span) { /* full thrust is what a mixer at its limits asks for */
            alone[k] = 0;
            known[k] = true;
        }
        whole = whole && known[k];
        fits = fits && known[k] && magnitude(alone[k]) < PART;
        own[k] = c->asked[k] - mean_asked;
        const double got = (double)(c->demand[k] - mean_demand), less = got - (double)own[k];
        left += less * less;
        parted += got * got + NOISE_SD * NOISE_SD;
        if (known[k] && (double)alone[k] * (double)alone[k] > largest) largest = (double)alone[k] * (double)alone[k];
    }
    fits = fits && flying;
    /* How well the mixer has explained the outputs before this sample; one that never did says nothing about single outputs. */
    const bool proven = s->fitted >= PROVEN && (double)s->fitted > 0.7 * (double)s->compared && s->unexplained < UNEXPLAINED * s->all;
    const rw_real usual = (rw_real)(6.0 * sqrt(s->power / (double)(s->fitted ? s->fitted : 1u)));
    const rw_real limit = usual > PART ? usual : PART, still_limit = usual > PART_STILL ? usual : PART_STILL;
    if (flying && whole) s->compared++;
    if (fits) {
        s->fitted++;
        s->power += largest;
        s->unexplained += left;
        s->all += parted;
    }
    if (c->time > s->last) {
        s->last = c->time;
        memcpy(s->own, own, sizeof own);
    }
    for (int k = 0; k < N; k++) {
        const rw_real u = c->output[k];
        const rw_time still = rests(&s->still[k], c->time, u, span / (rw_real)400);
        const bool off = u < low - (rw_real)0.01 * span && c->asked[k] > 2 * FLYING;
        const bool frozen = c->time - still > 0.5 && interior[k];
        /* At a limit the mixer takes from all others what it has too much, and in calm air they may rest: stuck is what does not stir at
           all while it should have moved against them. */
        const rw_time rest = rests(&s->rest[k], c->time, u, (rw_real)1e-9);
        if (rest >= c->time) s->own_at_rest[k] = s->own[k];
        const bool moved = magnitude(own[k] - s->own_at_rest[k]) > PART;
        const bool dead = c->time - rest > STUCK_S && interior[k] && moved && magnitude(c->deviation[k]) > limit;
        const bool apart = known[k] && magnitude(alone[k]) > limit, slightly = known[k] && magnitude(alone[k]) > still_limit;
        const bool wrong = proven && flying && (apart || off || dead || (frozen && slightly));
        const bool back = (magnitude(c->deviation[k]) < PART && !frozen) || !flying;
        const int place = follow(s, RW_WAY_MIXER, k, c->time, wrong, back, u, CONFIRM_S, CONFIRM_SAMPLES);
        if (place < 0) continue;
        rw_override *o = &s->spells[place];
        const rw_run *run = &s->runs[RW_WAY_MIXER][k];
        o->kind = RW_OVERRIDDEN;
        if (run->high <= low + span / (rw_real)400) o->kind = RW_OFF;
        else if (run->high - run->low <= span / (rw_real)400 && interior[k]) o->kind = RW_STUCK;
        o->onset = o->kind == RW_STUCK && still < run->onset ? still : run->onset;
        o->detected = c->known;
        o->output = u;
        o->asked = clipped(c->asked[k], c->top);
        o->rotor = (uint8_t)k;
        o->way = RW_WAY_MIXER;
    }
}

/* Keep thrusts of the last SILENT_S. */
static void remember(rw_departures *s, rw_time time, const rw_real *thrust, bool valid)
{
    while (s->recent_count > 0 && (s->recent_time[s->recent_first] < time - SILENT_S || s->recent_count == RW_RECENT)) {
        s->recent_first = (int16_t)((s->recent_first + 1) % RW_RECENT);
        s->recent_count--;
    }
    const int at = (s->recent_first + s->recent_count) % RW_RECENT;
    s->recent_time[at] = time;
    for (int k = 0; k < N; k++) s->recent[at][k] = valid ? thrust[k] : (rw_real)NAN;
    s->recent_count++;
}

/* The range of the thrust of rotor k over what is kept, without the sample furthest off: what moves is off in more than one. */
static rw_real moved_by(const rw_departures *s, int k)
{
    rw_real least[2] = {(rw_real)INFINITY, (rw_real)INFINITY}, most[2] = {(rw_real)-INFINITY, (rw_real)-INFINITY};
    int known = 0;
    for (int i = 0; i < s->recent_count; i++) {
        const rw_real then = s->recent[(s->recent_first + i) % RW_RECENT][k];
        if (isnan(then)) continue;
        known++;
        if (then < least[0]) { least[1] = least[0]; least[0] = then; }
        else if (then < least[1]) least[1] = then;
        if (then > most[0]) { most[1] = most[0]; most[0] = then; }
        else if (then > most[1]) most[1] = then;
    }
    if (known < 3) return 0;
    return most[0] - least[1] < most[1] - least[0] ? most[0] - least[1] : most[1] - least[0];
}

void rw_departures_logged(rw_departures *s, const rw_vehicle *v, rw_time time, const rw_real *output, const rw_real *thrust, bool valid,
                          bool aloft)
{
    const rw_real low = v->u_min, span = v->u_max - v->u_min;
    const bool inside = aloft && valid;
    rw_time still[N];
    bool resting[N], any = false;
    rw_real range[N];
    remember(s, time, thrust, valid);
    for (int k = 0; k < N; k++) {
        still[k] = rests(&s->alone[k], time, output[k], (rw_real)1e-9);
        resting[k] = inside && time - still[k] > SILENT_S;
        any = any || resting[k];
    }
    for (int k = 0; k < N; k++) range[k] = any ? moved_by(s, k) : 0;
    for (int k = 0; k < N; k++) {
        const rw_real u = output[k];
        rw_real others[N];
        int count = 0;
        bool moving = any, between = true;
        for (int j = 0; j < N; j++) {
            if (j == k) continue;
            others[count++] = thrust[j];
            moving = moving && range[j] > (rw_real)0.03;
            between = between && thrust[j] > FLYING && thrust[j] < (rw_real)0.99;
        }
        const bool interior = u > low + (rw_real)0.02 * span && u < low + (rw_real)0.98 * span;
        /* Below the minimum: no mixer asks for that. At the minimum, where outputs have nothing below it: no quad flies on with a rotor at
           rest and the others off their limits (with more rotors, one opposite a dead one rests). */
        const bool flown = inside && median(others, count) > 2 * FLYING;
        const bool above = u > low + (rw_real)0.01 * span;
        const bool idle = N == 4 && v->rests_at_minimum && flown && between && u <= low + (rw_real)0.002 * span;
        const struct {
            bool wrong, back;
            rw_time hold_s;
            int samples;
            uint8_t kind;
        } ways[RW_WAYS] = {
            [RW_WAY_STILL] = {resting[k] && interior && moving, time - still[k] < 0.2, 0.0, 1, RW_STUCK},
            [RW_WAY_BELOW] = {flown && u < low - (rw_real)0.01 * span, above, 0.3, 3, RW_OFF},
            [RW_WAY_RESTS] = {idle && time - still[k] > 1.0, above, 0.0, 1, RW_OFF},
        };
        for (int way = RW_WAY_STILL; way < RW_WAYS; way++) {
            const int place = follow(s, way, k, time, ways[way].wrong, ways[way].back || !inside, u, ways[way].hold_s, ways[way].samples);
            if (place < 0) continue;
            rw_override *o = &s->spells[place];
            o->kind = ways[way].kind;
            o->onset = way == RW_WAY_BELOW ? s->runs[way][k].onset : still[k];
            o->detected = time;
            o->output = u;
            o->asked = -1;
            o->rotor = (uint8_t)k;
            o->way = (uint8_t)way;
        }
    }
}

void rw_departures_landed(rw_departures *s, rw_time compared, rw_time logged)
{
    for (int way = 0; way < RW_WAYS; way++) {
        const rw_time since = way == RW_WAY_MIXER ? compared : logged;
        for (int k = 0; k < N; k++) {
            rw_run *run = &s->runs[way][k];
            if (since >= RW_LASTS) continue;
            if (run->open < 0) run->onset = RW_LASTS;
            else if (since < run->well) run->well = since;
        }
    }
}

static bool before(const rw_override *a, const rw_override *b)
{
    if (a->detected < b->detected || b->detected < a->detected) return a->detected < b->detected;
    return a->rotor != b->rotor ? a->rotor < b->rotor : a->way < b->way;
}

/* Does an output rest only because the one opposite it has been lost? What flies on balances its torque that way. */
static bool balances(const rw_departures *s, const rw_vehicle *v, const rw_override *one)
{
    if (one->kind != RW_OFF || one->asked >= 0) return false;
    for (int i = 0; i < s->spell_count; i++) {
        const rw_override *o = &s->spells[i];
        const rw_real roll = v->effectiveness[RW_ROLL][o->rotor] + v->effectiveness[RW_ROLL][one->rotor];
        const rw_real pitch = v->effectiveness[RW_PITCH][o->rotor] + v->effectiveness[RW_PITCH][one->rotor];
        if (o->onset < one->onset && one->onset < o->end && magnitude(roll) < (rw_real)0.1 && magnitude(pitch) < (rw_real)0.1) return true;
    }
    return false;
}

int rw_departures_found(const rw_departures *s, const rw_vehicle *v, rw_override *out)
{
    int count = 0, kept = 0, told = 0;
    for (int i = 0; i < s->spell_count; i++) { /* in the order in which they were noticed */
        int j = count++;
        for (; j > 0 && before(&s->spells[i], &out[j - 1]); j--) out[j] = out[j - 1];
        out[j] = s->spells[i];
    }
    for (int i = 0; i < count; i++) { /* of those of one rotor that overlap in time, the first */
        bool hidden = false;
        for (int j = 0; j < kept; j++) hidden = hidden || (out[j].rotor == out[i].rotor && out[i].onset < out[j].end);
        if (!hidden) out[kept++] = out[i];
    }
    for (int i = 0; i < kept; i++) {
        if (!balances(s, v, &out[i])) out[told++] = out[i];
    }
    return told;
}
