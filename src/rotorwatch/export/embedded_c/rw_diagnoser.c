#include "rw_diagnoser.h"
#include "rw_names.h"

#include <math.h>
#include <string.h>

void rw_diagnoser_init(rw_diagnoser *d, const rw_vehicle *v, const rw_plan *p)
{
    d->vehicle = v;
    d->plan = p;
    d->deferred = false;
    d->first = d->next = 0;
    d->lost = 0;
    rw_engine_init(&d->engine);
    rw_engine_begin(&d->engine, &rw_plant_default);
}

size_t rw_diagnoser_size(void) { return sizeof(rw_diagnoser); }

void rw_diagnoser_defer(rw_diagnoser *d) { d->deferred = true; }

/* One writer moves `next`, one reader `first`; a place is written before it is the reader's, and read before it is the writer's. */
static uint16_t after(uint16_t place) { return place == RW_SAMPLES ? 0 : (uint16_t)(place + 1); }

static void feed(rw_diagnoser *d, rw_time time, int32_t kind, const rw_real *x, int count)
{
    const uint16_t place = d->next;
    volatile rw_sample *const at = &d->line[place];
    if (!d->deferred) {
        rw_engine_sample(&d->engine, d->vehicle, d->plan, &rw_plant_default, kind, time, x);
        return;
    }
    if (after(place) == d->first) {
        d->lost = d->lost + 1;
        return;
    }
    at->time = time;
    at->kind = kind;
    for (int k = 0; k < count; k++) at->x[k] = x[k];
    d->next = after(place);
}

bool rw_diagnoser_work(rw_diagnoser *d)
{
    const uint16_t place = d->first;
    const volatile rw_sample *const at = &d->line[place];
    rw_real x[RW_NUMBERS];
    if (rw_engine_work(&d->engine, d->vehicle, d->plan, &rw_plant_default)) return true;
    if (place == d->next) return false;
    for (int k = 0; k < RW_NUMBERS; k++) x[k] = at->x[k];
    rw_engine_push(&d->engine, d->vehicle, d->plan, at->kind, at->time, x);
    d->first = after(place);
    return true;
}

uint32_t rw_diagnoser_lost(const rw_diagnoser *d) { return d->lost; }

static rw_real known(rw_real x, bool valid) { return valid && isfinite(x) ? x : (rw_real)NAN; }

void rw_diagnoser_gyro(rw_diagnoser *d, rw_time time, const rw_real *rate, bool valid)
{
    const rw_real x[] = {known(rate[0], valid), rate[1], rate[2]};
    feed(d, time, RW_GYRO, x, 3);
}

void rw_diagnoser_accel(rw_diagnoser *d, rw_time time, const rw_real *force, bool valid)
{
    const rw_real x[] = {known(force[0], valid), force[1], force[2]};
    feed(d, time, RW_ACCEL, x, 3);
}

void rw_diagnoser_velocity(rw_diagnoser *d, rw_time time, rw_real climb, rw_real speed)
{
    const rw_real x[] = {climb, speed};
    feed(d, time, RW_SPEED, x, 2);
}

void rw_diagnoser_velocity_ned(rw_diagnoser *d, rw_time time, const rw_real *velocity) { feed(d, time, RW_VELOCITY, velocity, 3); }

void rw_diagnoser_state(rw_diagnoser *d, rw_time time, int landed, int armed)
{
    const rw_real x[] = {(rw_real)landed, (rw_real)armed};
    feed(d, time, RW_STATE, x, 2);
}

void rw_diagnoser_attitude(rw_diagnoser *d, rw_time time, const rw_real *q) { feed(d, time, RW_ATTITUDE, q, 4); }

void rw_diagnoser_battery(rw_diagnoser *d, rw_time time, rw_real ratio) { feed(d, time, RW_VOLTAGE, &ratio, 1); }

void rw_diagnoser_outputs(rw_diagnoser *d, rw_time time, const rw_real *output, rw_rotors valid)
{
    rw_real x[RW_ROTORS];
    for (int k = 0; k < RW_ROTORS; k++) x[k] = known(output[k], (valid >> k) & 1);
    feed(d, time, RW_OUTPUTS, x, RW_ROTORS);
}

void rw_diagnoser_control(rw_diagnoser *d, rw_time time, const rw_real *control, bool valid)
{
    rw_real x[4];
    for (int k = 0; k < 4; k++) x[k] = known(control[k], valid);
    feed(d, time, RW_CONTROL, x, 4);
}

void rw_diagnoser_finish(rw_diagnoser *d, rw_time time)
{
    while (rw_diagnoser_work(d)) {
    }
    rw_engine_finish(&d->engine, d->vehicle, d->plan, &rw_plant_default, time);
}

int rw_diagnoser_poll(rw_diagnoser *d, rw_notification *notifications)
{
    const rw_engine *e = &d->engine;
    const int count = (int)rw_engine_poll(&d->engine, d->vehicle);
    for (int k = 0; k < count; k++) {
        const rw_change *one = &e->fresh[k];
        notifications[k].event = one->what == RW_WITHDRAWN ? &e->room.losses[one->place] : &e->events[one->place];
        notifications[k].number = (uint16_t)one->number;
        notifications[k].kind = (uint8_t)one->what;
    }
    return count;
}

int rw_diagnoser_events(const rw_diagnoser *d, const rw_event **events)
{
    *events = d->engine.events;
    return d->engine.count;
}

int rw_diagnoser_main(const rw_diagnoser *d) { return (int)rw_engine_main(&d->engine); }

int rw_diagnoser_verdict(const rw_diagnoser *d) { return (int)rw_engine_verdict(&d->engine); }

rw_real rw_diagnoser_loss(const rw_diagnoser *d, int rotor) { return d->engine.out.theta[rotor]; }

const rw_reliance *rw_diagnoser_reliance(const rw_diagnoser *d) { return &d->engine.reliance; }

int rw_diagnoser_factors(const rw_diagnoser *d, rw_real *factors)
{
    return (int)rw_reliance_factors(&d->engine.reliance, d->vehicle, factors);
}

const char *rw_diagnoser_verdict_text(const rw_diagnoser *d)
{
    static const char *const words[] = {"not assessed", "healthy so far", "fault found", "ambiguous"};
    return words[rw_diagnoser_verdict(d)];
}

int rw_diagnoser_words(const rw_notification *notification, char *text)
{
    static const char *const names[] = RW_NAMES;
    const bool withdrawn = notification->kind == RW_WITHDRAWN;
    rw_words words;
    rw_words_init(&words);
    rw_words_event(&words, notification->event, withdrawn, names[notification->event->kind]);
    memcpy(text, words.at, RW_TEXT);
    return (int)rw_words_severity(notification->event, withdrawn);
}
