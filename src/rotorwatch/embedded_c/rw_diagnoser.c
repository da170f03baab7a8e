#include "rw_diagnoser.h"

#include <math.h>
#include <string.h>

static const rw_time SETTLE_S = 1.0; /* of motion/ticks.py: the first second of a flight gives the hover command */
static const rw_time SETTLED_S = 60.0; /* what ended so long ago is not taken back any more */
static const rw_time LYING_S = 0.5, BLOW_S = 3.0; /* of motion/airborne.py: by how much an end may lie before what showed it */

void rw_diagnoser_init(rw_diagnoser *d, const rw_vehicle *v, const rw_plan *p)
{
    memset(d, 0, sizeof *d);
    d->vehicle = v;
    d->plan = p;
    rw_airborne_init(&d->air);
    rw_mixer_init(&d->mixer);
    rw_departures_init(&d->departures);
    rw_sense_init(&d->sense);
    rw_ticks_init(&d->ticks);
    rw_events_init(&d->events);
    rw_report_init(&d->report);
    rw_changes_init(&d->changes);
    rw_estimator_init(&d->estimator, &d->work);
    d->start = d->before_start = d->compared = d->logged = RW_LASTS;
    d->before_end = d->newest = -RW_LASTS;
    d->battery = 1;
}

/* The earliest moment at which the flight that goes on may still turn out to have ended; RW_LASTS: none, it flies. */
static rw_time doubt(const rw_diagnoser *d, rw_time now)
{
    const rw_airborne *a = &d->air;
    rw_time from = RW_LASTS, end = now;
    if (a->start >= RW_LASTS) return RW_LASTS;
    if (a->low_since < RW_LASTS) from = a->low_since;
    if (a->lying_since < RW_LASTS && a->lying_since - LYING_S < from) from = a->lying_since - LYING_S;
    if (from < end) end = from;
    if (end - a->last_blow <= BLOW_S && a->first_blow < from) from = a->first_blow; /* an end soon after a blow is put where that was */
    return from;
}

/* Start of the flight in which a tick lies, RW_LASTS on the ground. */
static rw_time flight_of(const rw_diagnoser *d, const rw_sensed *row)
{
    if (d->start < RW_LASTS && row->time >= d->start + SETTLE_S) return d->start;
    if (d->before_start < RW_LASTS && row->time >= d->before_start + SETTLE_S && row->when <= d->before_end) return d->before_start;
    return RW_LASTS;
}

static void judge(rw_diagnoser *d, const rw_sensed *row)
{
    rw_made made;
    rw_found found;
    const rw_estimator_out *out = &d->out;
    rw_ticks_make(&d->ticks, d->vehicle, d->plan, row, flight_of(d, row), &made);
    rw_estimator_step(&d->estimator, made.u, made.y, made.valid, &d->out, &d->work);
    found.theta = out->theta;
    found.theta_sd = out->theta_sd;
    found.active = out->active;
    found.share = out->share;
    found.probability = out->probability;
    found.log_odds = out->log_odds;
    found.onsets = out->onsets;
    found.since = out->since;
    found.opposite_onset = out->opposite_onset;
    found.opposite_loss[0] = out->opposite_loss[0];
    found.opposite_loss[1] = out->opposite_loss[1];
    found.opposite = out->opposite;
    found.announced = out->announced;
    rw_events_tick(&d->events, d->vehicle, &made.tick, &found);
    rw_report_tick(&d->report, &made.tick);
    if (made.touch.news) rw_report_contact(&d->report, made.touch.time, made.touch.push, made.touch.size);
    d->judged = d->judged || made.tick.mode == RW_JUDGE;
}

/* The tick that has waited longest. */
static void next(rw_diagnoser *d)
{
    judge(d, &d->queue[d->first]);
    d->first = (int16_t)((d->first + 1) % RW_QUEUE);
    d->count--;
}

/* Ticks of which it is known whether they lie in the air. sure: of all of them it is; else at most RW_BURST, so that no call in flight keeps
   the processor for all the ticks that have waited. One that is left for the next call is judged the same there. */
static void work_off(rw_diagnoser *d, rw_time now, bool sure)
{
    const rw_time from = doubt(d, now);
    for (int done = 0; d->count && (sure || done < RW_BURST); done++) {
        const rw_sensed *row = &d->queue[d->first];
        if (!sure && d->start < RW_LASTS) {
            if (row->when > d->start && (row->when > from || row->when > d->air.last)) return;
            /* What carries the vehicle is learned from all ticks of the first second. */
            if (row->time >= d->start && d->newest < d->start + SETTLE_S) return;
        }
        next(d);
    }
}

/* The flight that went on has ended at `end` s: the ticks that wait are certain now. */
static void landed(rw_diagnoser *d, rw_time end)
{
    d->before_start = d->start;
    d->before_end = end;
    d->start = RW_LASTS;
    work_off(d, end, true);
    rw_report_landed(&d->report, end);
    if (d->doubting) {
        d->departures = d->sure;
        rw_departures_landed(&d->departures, d->compared, d->logged);
    }
    d->doubting = false;
}

static void landed_or_lifted(rw_diagnoser *d)
{
    const rw_airborne *a = &d->air;
    if (a->start == d->start) return;
    if (d->start < RW_LASTS) {
        const bool kept = a->flight_count && a->flights[a->flight_count - 1].start <= d->start;
        landed(d, kept ? rw_airborne_end(a, a->flight_count - 1) : d->start);
    }
    d->start = a->start;
}

/* Ticks that have become known, into the queue. */
static void take(rw_diagnoser *d, rw_time now)
{
    rw_sensed row;
    while (rw_sense_next(&d->sense, d->plan, now, &row)) {
        if (d->count == RW_QUEUE) next(d); /* no doubt lasts that long; never lose a tick for it */
        if (d->start < RW_LASTS && row.when >= d->start && row.when < d->start + SETTLE_S) rw_ticks_settle(&d->ticks, &row, d->start);
        d->newest = row.when;
        d->queue[(d->first + d->count) % RW_QUEUE] = row;
        d->count++;
    }
}

/* After a sample of time `now` has been told to the gate. */
static void go_on(rw_diagnoser *d, rw_time now)
{
    landed_or_lifted(d);
    if (doubt(d, now) < RW_LASTS) {
        if (!d->doubting) {
            d->sure = d->departures;
            d->compared = d->logged = RW_LASTS;
        }
        d->doubting = true;
    } else d->doubting = false;
    take(d, now);
    work_off(d, now, false);
}

/* One number that is none would stay in the estimates for ever: such a sample counts as not valid. */
static bool numbers(const rw_real *x, int count)
{
    for (int k = 0; k < count; k++)
        if (!isfinite(x[k])) return false;
    return true;
}

void rw_diagnoser_gyro(rw_diagnoser *d, rw_time time, const rw_real *rate, bool valid)
{
    valid = valid && numbers(rate, 3);
    rw_airborne_gyro(&d->air, time, rate, valid);
    go_on(d, time);
    if (valid) rw_sense_gyro(&d->sense, time, rate);
}

void rw_diagnoser_accel(rw_diagnoser *d, rw_time time, const rw_real *force, bool valid)
{
    valid = valid && numbers(force, 3);
    rw_airborne_accel(&d->air, time, force, valid);
    go_on(d, time);
    if (valid) rw_sense_accel(&d->sense, time, force);
}

void rw_diagnoser_velocity(rw_diagnoser *d, rw_time time, rw_real climb, rw_real speed)
{
    rw_airborne_velocity(&d->air, time, climb, speed);
    go_on(d, time);
}

void rw_diagnoser_state(rw_diagnoser *d, rw_time time, int landed, int armed)
{
    rw_airborne_state(&d->air, time, landed, armed);
    go_on(d, time);
}

void rw_diagnoser_attitude(rw_diagnoser *d, rw_time time, const rw_real *q)
{
    go_on(d, time);
    if (numbers(q, 4)) rw_sense_level(&d->sense, time, 1 - 2 * (q[1] * q[1] + q[2] * q[2]));
}

void rw_diagnoser_battery(rw_diagnoser *d, rw_time time, rw_real ratio)
{
    go_on(d, time);
    if (numbers(&ratio, 1)) d->battery = ratio;
}

static bool aloft(const rw_diagnoser *d, rw_time time)
{
    return (d->start < RW_LASTS && time >= d->start) ||
           (d->before_start < RW_LASTS && time >= d->before_start && time < d->before_end);
}

static void compare(rw_diagnoser *d, const rw_comparison *c)
{
    rw_departures_compared(&d->departures, d->vehicle, c, aloft(d, c->time));
    if (c->time < d->compared) d->compared = c->time;
}

void rw_diagnoser_outputs(rw_diagnoser *d, rw_time time, const rw_real *output, rw_rotors known)
{
    const rw_vehicle *v = d->vehicle;
    for (int k = 0; k < RW_ROTORS; k++)
        if (!isfinite(output[k])) known = (rw_rotors)(known & ~(1u << k));
    const bool all = known == (rw_rotors)((1u << RW_ROTORS) - 1u);
    rw_comparison c;
    rw_airborne_outputs(&d->air, v, time, output, known);
    go_on(d, time);
    for (int k = 0; k < RW_ROTORS; k++) d->thrust[k] = rw_mixer_curve(v, output[k], d->battery);
    d->known = known;
    if (rw_mixer_outputs(&d->mixer, v, time, output, all, d->battery, &c)) compare(d, &c);
    rw_departures_logged(&d->departures, v, time, output, d->thrust, all, aloft(d, time));
    if (time < d->logged) d->logged = time;
    if (!d->plan->rebuilt) rw_sense_thrust(&d->sense, d->plan, time, d->thrust, all);
}

void rw_diagnoser_control(rw_diagnoser *d, rw_time time, const rw_real *control, bool valid)
{
    const rw_vehicle *v = d->vehicle;
    rw_comparison made[RW_PENDING];
    rw_real thrust[RW_ROTORS];
    bool ok[RW_ROTORS], all = true;
    valid = valid && numbers(control, 4);
    go_on(d, time);
    const int count = rw_mixer_control(&d->mixer, v, time, control, valid, made);
    for (int i = 0; i < count; i++) compare(d, &made[i]);
    if (!d->plan->rebuilt) return;
    rw_mixer_thrust(&d->mixer, v, time, control, valid, d->battery, thrust, ok);
    for (int k = 0; k < RW_ROTORS; k++) {
        if (!ok[k]) thrust[k] = d->thrust[k];
        all = all && (ok[k] || ((d->known >> k) & 1));
    }
    rw_sense_thrust(&d->sense, d->plan, time, thrust, all);
}

void rw_diagnoser_finish(rw_diagnoser *d, rw_time time)
{
    rw_airborne_until(&d->air, time);
    landed_or_lifted(d);
    d->doubting = false;
    take(d, RW_LASTS);
    if (d->start < RW_LASTS) { /* it flies as long as there are outputs */
        d->air.start = RW_LASTS;
        landed(d, d->air.last);
    }
    work_off(d, time, true);
}

int rw_diagnoser_poll(rw_diagnoser *d, rw_news *news)
{
    rw_event losses[RW_RECORDS];
    rw_override overrides[RW_OVERRIDES];
    const int lost = rw_events_losses(&d->events, d->vehicle, losses);
    const int departed = rw_departures_found(&d->departures, d->vehicle, overrides);
    d->event_count = (uint8_t)rw_report_events(&d->report, losses, lost, overrides, departed, d->listed);
    return rw_changes_of(&d->changes, d->listed, d->event_count, d->newest - SETTLED_S, d->gone, news);
}

int rw_diagnoser_events(const rw_diagnoser *d, const rw_event **events)
{
    *events = d->listed;
    return d->event_count;
}

enum rw_verdict rw_diagnoser_verdict(const rw_diagnoser *d) { return rw_report_verdict(d->listed, d->event_count, d->judged); }
