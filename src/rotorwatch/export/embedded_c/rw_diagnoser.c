#include "rw_diagnoser.h"
#include "rw_names.h"

#include <math.h>
#include <string.h>

void rw_diagnoser_init(rw_diagnoser *d, const rw_vehicle *v, const rw_plan *p)
{
    d->vehicle = v;
    d->plan = p;
    rw_engine_init(&d->engine);
    rw_engine_begin(&d->engine, &rw_plant_default);
}

static void feed(rw_diagnoser *d, rw_time time, int32_t kind, const rw_real *x)
{
    rw_engine_sample(&d->engine, d->vehicle, d->plan, &rw_plant_default, kind, time, x);
}

static rw_real known(rw_real x, bool valid) { return valid && isfinite(x) ? x : (rw_real)NAN; }

void rw_diagnoser_gyro(rw_diagnoser *d, rw_time time, const rw_real *rate, bool valid)
{
    const rw_real x[] = {known(rate[0], valid), rate[1], rate[2]};
    feed(d, time, RW_GYRO, x);
}

void rw_diagnoser_accel(rw_diagnoser *d, rw_time time, const rw_real *force, bool valid)
{
    const rw_real x[] = {known(force[0], valid), force[1], force[2]};
    feed(d, time, RW_ACCEL, x);
}

void rw_diagnoser_velocity(rw_diagnoser *d, rw_time time, rw_real climb, rw_real speed)
{
    const rw_real x[] = {climb, speed};
    feed(d, time, RW_SPEED, x);
}

void rw_diagnoser_velocity_ned(rw_diagnoser *d, rw_time time, const rw_real *velocity) { feed(d, time, RW_VELOCITY, velocity); }

void rw_diagnoser_state(rw_diagnoser *d, rw_time time, int landed, int armed)
{
    const rw_real x[] = {(rw_real)landed, (rw_real)armed};
    feed(d, time, RW_STATE, x);
}

void rw_diagnoser_attitude(rw_diagnoser *d, rw_time time, const rw_real *q) { feed(d, time, RW_ATTITUDE, q); }

void rw_diagnoser_battery(rw_diagnoser *d, rw_time time, rw_real ratio) { feed(d, time, RW_VOLTAGE, &ratio); }

void rw_diagnoser_outputs(rw_diagnoser *d, rw_time time, const rw_real *output, rw_rotors valid)
{
    rw_real x[RW_ROTORS];
    for (int k = 0; k < RW_ROTORS; k++) x[k] = known(output[k], (valid >> k) & 1);
    feed(d, time, RW_OUTPUTS, x);
}

void rw_diagnoser_control(rw_diagnoser *d, rw_time time, const rw_real *control, bool valid)
{
    rw_real x[4];
    for (int k = 0; k < 4; k++) x[k] = known(control[k], valid);
    feed(d, time, RW_CONTROL, x);
}

void rw_diagnoser_finish(rw_diagnoser *d, rw_time time)
{
    rw_engine_finish(&d->engine, d->vehicle, d->plan, &rw_plant_default, time);
}

int rw_diagnoser_poll(rw_diagnoser *d, rw_notification *notifications)
{
    const rw_engine *e = &d->engine;
    const int count = (int)rw_engine_poll(&d->engine, d->vehicle);
    for (int k = 0; k < count; k++) {
        const rw_change *one = &e->fresh[k];
        notifications[k].event = one->what == RW_WITHDRAWN ? &e->withdrawn[one->place] : &e->events[one->place];
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

const char *rw_diagnoser_verdict_text(const rw_diagnoser *d)
{
    static const char *const words[] = {"not judged", "healthy so far", "fault found", "ambiguous"};
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
