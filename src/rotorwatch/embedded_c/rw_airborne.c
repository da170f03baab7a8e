#include "rw_airborne.h"

#include <math.h>
#include <string.h>

static const rw_time TICK_S = 0.05, GAP_S = 4.0, MOST_GAP_S = 60.0, WINDOW_S = 0.5, FRESH_S = 1.0;
static const rw_real G0 = (rw_real)9.80665;
static const rw_real IDLE_S = 2, HOVER_S = 5;                    /* time constants of the idle command, and of that in the air */
static const rw_real RISE = (rw_real)0.08;                       /* command above idle below which nothing flies */
static const rw_real HIGH = (rw_real)0.25, HIGH_RISE = (rw_real)0.1; /* command, and its rise, that mean flight once they last */
static const rw_time HIGH_S = 5.0, HIGH_BLIND_S = 1.0;           /* ... so long, with and without a velocity that could tell */
static const rw_real CLIMB = (rw_real)0.25, SPEED = 1;           /* m/s */
static const rw_real SINKING = 1;                                /* m/s down: the ground is not there yet */
static const rw_real HEIGHT = (rw_real)0.2;                      /* m gained since the command became high */
static const rw_real LOW = (rw_real)0.65;                        /* part of the way from idle to hover that does not carry the vehicle */
static const rw_time LOW_S = 1.5, LYING_S = 1.0, BLOW_S = 3.0;
static const rw_real FALLING = (rw_real)(0.75 * 9.80665);        /* below that a vehicle with idle motors falls */
static const rw_real BLOW = (rw_real)(1.2 * 9.80665);            /* lateral, or half of it down: the ground's */

static void begin(rw_airborne *a)
{
    a->since = a->first_blow = a->last_blow = -RW_LASTS;
    a->high_since = a->low_since = a->lying_since = RW_LASTS;
    a->idle = a->floor = a->hover = a->drift = a->height = 0;
    a->idle_known = a->flying = a->walking = false;
    a->start = RW_LASTS;
}

void rw_airborne_init(rw_airborne *a)
{
    memset(a, 0, sizeof *a);
    begin(a);
    a->velocity_time = a->blow = a->last = -RW_LASTS;
    a->landed = a->armed = -1;
}

/* When a condition that is now `true` became so; RW_LASTS when it is not. */
static rw_time lasting(rw_time before, bool now, rw_time time) { return !now ? RW_LASTS : before < RW_LASTS ? before : time; }

static rw_real blend(rw_real old, rw_real new_one, rw_real constant) { return old + (rw_real)0.05 / constant * (new_one - old); }

static bool lifted(const rw_airborne *a, rw_time time, const rw_senses *now, rw_real climb)
{
    const rw_time high_for = a->high_since < RW_LASTS ? time - a->high_since : 0.0;
    if (a->lying_since < RW_LASTS) return false;
    if (!a->idle_known) return high_for >= TICK_S; /* it begins with running motors: in the middle of a flight */
    if (now->landed == 1 || now->armed == 0) return a->height > 5 * HEIGHT; /* a stale word is overruled only by a plain climb */
    if (now->command < a->idle + RISE) return false;
    if (climb > CLIMB || a->height > HEIGHT || now->speed > SPEED + 2 * (a->drift < 0 ? -a->drift : a->drift)) return true;
    return high_for >= (isnan(now->climb) ? HIGH_BLIND_S : HIGH_S);
}

static void on_the_ground(rw_airborne *a, rw_time time, const rw_senses *now)
{
    const rw_real floor = a->idle_known ? a->idle : 0;
    const bool high = now->command > (floor + HIGH_RISE > HIGH ? floor + HIGH_RISE : HIGH);
    const rw_real climb = isnan(now->climb) ? 0 : now->climb - a->drift;
    a->high_since = lasting(a->high_since, high, time);
    a->height = high ? a->height + (rw_real)0.05 * climb : 0;
    if (lifted(a, time, now, climb)) {
        a->flying = true;
        a->since = time;
        a->floor = floor;
        a->hover = now->command > floor + HIGH_RISE ? now->command : floor + HIGH_RISE;
        a->idle = floor;
        a->idle_known = true;
        a->low_since = RW_LASTS;
        a->first_blow = a->last_blow = -RW_LASTS;
        return;
    }
    if (high) return;
    a->idle = a->idle_known ? blend(a->idle, now->command, IDLE_S) : now->command;
    a->idle_known = true;
    if (now->command < a->idle + RISE && !isnan(now->climb)) a->drift = blend(a->drift, now->climb, IDLE_S);
}

static void in_the_air(rw_airborne *a, rw_time time, const rw_senses *now)
{
    const bool low = now->command < a->floor + LOW * (a->hover - a->floor);
    rw_time end = RW_LASTS;
    a->low_since = lasting(a->low_since, low && !(now->climb < -SINKING), time);
    if (!low) a->hover = blend(a->hover, now->command, HOVER_S);
    if (now->struck) {
        if (time - a->last_blow > 1.0) a->first_blow = time;
        a->last_blow = time;
    }
    if (low && (now->landed == 1 || now->armed == 0)) end = a->low_since < RW_LASTS ? a->low_since : time;
    else if (a->low_since < RW_LASTS && !(now->force < FALLING) && time - a->low_since >= LOW_S) end = a->low_since;
    else if (a->lying_since < RW_LASTS && time - a->lying_since >= LYING_S) end = a->lying_since - WINDOW_S;
    if (end >= RW_LASTS) return;
    if (end - a->last_blow <= BLOW_S && a->first_blow < end) end = a->first_blow;
    a->flying = false;
    if (end > a->since) a->since = end;
    a->high_since = RW_LASTS;
    a->height = 0;
}

/* A flight is over. */
static void keep(rw_airborne *a, rw_time end)
{
    if ((end < a->last ? end : a->last) > a->start) {
        if (a->flight_count == RW_FLIGHTS) memmove(&a->flights[0], &a->flights[1], (RW_FLIGHTS - 1) * sizeof a->flights[0]);
        else a->flight_count++;
        a->flights[a->flight_count - 1].start = a->start;
        a->flights[a->flight_count - 1].end = end;
    }
    a->start = RW_LASTS;
}

static void step(rw_airborne *a, rw_time time, const rw_senses *now)
{
    const rw_real off = now->force - G0;
    /* In the air, specific force is what the rotors push: along -z. Lying still on anything but the feet, it is not. */
    const bool lying = off > -2 && off < 2 && now->upward < (rw_real)0.7 * now->force && now->turning < (rw_real)0.5;
    a->lying_since = lasting(a->lying_since, lying, time);
    if (a->flying) in_the_air(a, time, now);
    else on_the_ground(a, time, now);
    if (a->flying && a->start >= RW_LASTS) a->start = time;
    else if (!a->flying && a->start < RW_LASTS) keep(a, a->since);
}

static void add(rw_half_second *h, rw_time time, rw_real size, rw_real upward)
{
    while (h->count > 0 && (h->time[h->first] < time - WINDOW_S || h->count == RW_HALF_SECOND)) {
        h->first = (int16_t)((h->first + 1) % RW_HALF_SECOND);
        h->count--;
    }
    const int at = (h->first + h->count) % RW_HALF_SECOND;
    h->time[at] = time;
    h->size[at] = size;
    h->upward[at] = upward;
    h->count++;
}

/* Means over the last half second before the newest sample; NaN where that is older than a second. */
static void mean(const rw_half_second *h, rw_time time, rw_real *size, rw_real *upward)
{
    int known = 0;
    rw_real sum = 0, up = 0;
    *size = *upward = (rw_real)NAN;
    if (h->count == 0 || time - h->time[(h->first + h->count - 1) % RW_HALF_SECOND] > FRESH_S) return;
    for (int i = 0; i < h->count; i++) {
        const int at = (h->first + i) % RW_HALF_SECOND;
        if (isnan(h->size[at])) continue;
        sum += h->size[at];
        up += h->upward[at];
        known++;
    }
    if (known == 0) return;
    *size = sum / (rw_real)known;
    *upward = up / (rw_real)known;
}

/* The flight ended with the last output. */
static void end_flight(rw_airborne *a)
{
    if (a->start < RW_LASTS) keep(a, a->last);
    begin(a);
}

/* Does the vehicle still fly after a gap, by the first command after it? What lasted before the gap begins anew. */
static bool goes_on(rw_airborne *a, rw_time time, rw_real command)
{
    a->low_since = a->lying_since = RW_LASTS;
    if (time - a->last > MOST_GAP_S || a->down) return false;
    return a->flying && !(command < a->floor + LOW * (a->hover - a->floor));
}

/* The ticks before `time`, or up to it. */
static void walk(rw_airborne *a, rw_time time, bool inclusive)
{
    if (!a->walking && a->last > -RW_LASTS && time > a->last + MOST_GAP_S) end_flight(a);
    while (a->walking) {
        const rw_time now = a->tick * TICK_S;
        const bool over = now > a->last + GAP_S; /* the last output is held for so long */
        rw_senses senses;
        rw_real none;
        if (over && time > a->last + GAP_S) {
            if (a->flight_count && a->flights[a->flight_count - 1].end > a->last) a->flights[a->flight_count - 1].end = a->last;
            a->walking = false;
            if (time > a->last + MOST_GAP_S) end_flight(a);
            return;
        }
        if (over || now > time || (!inclusive && now >= time)) return;
        senses.command = a->command;
        const bool moving = now - a->velocity_time <= FRESH_S;
        senses.climb = moving ? a->climb : (rw_real)NAN;
        senses.speed = moving ? a->speed : (rw_real)NAN;
        mean(&a->force, now, &senses.force, &senses.upward);
        mean(&a->turning, now, &senses.turning, &none);
        senses.struck = a->blow > now - TICK_S && a->blow <= now;
        senses.landed = a->landed;
        senses.armed = a->armed;
        step(a, now, &senses);
        a->tick += 1.0;
    }
}

void rw_airborne_outputs(rw_airborne *a, const rw_vehicle *v, rw_time time, const rw_real *output, rw_rotors valid)
{
    rw_real sum = 0, known = 0;
    if (!valid) return;
    walk(a, time, false);
    for (int k = 0; k < RW_ROTORS; k++) {
        if (!((valid >> k) & 1)) continue;
        rw_real share = (output[k] - v->output_low) / (v->output_high - v->output_low);
        share = share < 0 ? 0 : share > 1 ? 1 : share;
        sum += share * share;
        known += 1;
    }
    a->command = (rw_real)sqrt((double)(sum / known));
    if (!a->walking) {
        if (a->last > -RW_LASTS && !goes_on(a, time, a->command)) end_flight(a);
        a->walking = true;
        a->tick = ceil(time / TICK_S);
    }
    a->last = time;
    a->down = false;
}

static rw_real size_of(const rw_real *x) { return (rw_real)sqrt((double)(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])); }

void rw_airborne_accel(rw_airborne *a, rw_time time, const rw_real *force, bool valid)
{
    walk(a, time, false);
    add(&a->force, time, valid ? size_of(force) : (rw_real)NAN, valid ? -force[2] : (rw_real)NAN);
    if (valid && (force[0] * force[0] + force[1] * force[1] > BLOW * BLOW || force[2] > BLOW / 2)) a->blow = time;
}

void rw_airborne_gyro(rw_airborne *a, rw_time time, const rw_real *rate, bool valid)
{
    walk(a, time, false);
    add(&a->turning, time, valid ? size_of(rate) : (rw_real)NAN, 0);
}

void rw_airborne_velocity(rw_airborne *a, rw_time time, rw_real climb, rw_real speed)
{
    walk(a, time, false);
    a->velocity_time = time;
    a->climb = climb;
    a->speed = speed;
}

void rw_airborne_state(rw_airborne *a, rw_time time, int landed, int armed)
{
    walk(a, time, false);
    a->down = a->down || landed == 1 || armed == 0;
    if (landed >= 0) a->landed = (int8_t)landed;
    if (armed >= 0) a->armed = (int8_t)armed;
}

void rw_airborne_until(rw_airborne *a, rw_time time) { walk(a, time, true); }

rw_time rw_airborne_end(const rw_airborne *a, int i) { return a->flights[i].end < a->last ? a->flights[i].end : a->last; }
