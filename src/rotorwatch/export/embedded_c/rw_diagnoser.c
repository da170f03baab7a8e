#include "rw_diagnoser.h"

#include <math.h>
#include <string.h>

static const rw_time FINAL_S = 60.0; /* what ended so long ago is not withdrawn any more */

void rw_diagnoser_init(rw_diagnoser *d, const rw_vehicle *v, const rw_plan *p)
{
    memset(d, 0, sizeof *d);
    d->vehicle = v;
    d->plan = p;
    rw_front_init(&d->front);
    rw_losses_init(&d->losses);
    rw_report_init(&d->report);
    rw_changes_init(&d->changes);
    rw_estimator_init(&d->estimator);
    rw_estimator_begin(&d->estimator, &rw_plant_default);
    rw_result_init(&d->out);
}

/* One tick through the estimator, and its events. */
static void judge(rw_diagnoser *d, const rw_made *made)
{
    const rw_result *out = &d->out;
    rw_found found;
    rw_real u[RW_INPUTS];
    rw_made_inputs(made, d->vehicle, u);
    rw_whole_run(&rw_plant_default, &d->estimator, 1, u, made->wrench, made->valid, &d->out);
    rw_found_init(&found);
    memcpy(found.theta, out->theta, sizeof found.theta);
    memcpy(found.theta_sd, out->theta_sd, sizeof found.theta_sd);
    memcpy(found.active, out->active, sizeof found.active);
    memcpy(found.share, out->share, sizeof found.share);
    memcpy(found.gives, out->gives, sizeof found.gives);
    memcpy(found.onsets, out->onsets, sizeof found.onsets);
    memcpy(found.probability, out->probability, sizeof found.probability);
    found.announced = out->announced;
    rw_losses_on(&d->losses, d->vehicle, made->time, made->when, made->mode, made->restart, &found);
    rw_report_tick(&d->report, made->time, made->start, made->upset);
    if (made->touch.is_new) rw_report_contact(&d->report, made->touch.time, made->touch.push, made->touch.size);
    d->judged = d->judged || made->mode == RW_JUDGE;
}

/* After a sample, before which the flight that had begun at `was` went on. What waited for a landing is worked off at once; else at most
   RW_BURST ticks, so that no call in flight keeps the processor for all that have waited. */
static void go_on(rw_diagnoser *d, rw_time was)
{
    rw_made made;
    rw_made_init(&made);
    if (was < RW_LASTS && (d->front.start < was || d->front.start > was)) {
        while (d->front.certain && rw_front_next(&d->front, d->vehicle, d->plan, &made)) judge(d, &made);
        rw_report_landed(&d->report, d->front.before_end);
    }
    for (int done = 0; done < RW_BURST && rw_front_next(&d->front, d->vehicle, d->plan, &made); done++) judge(d, &made);
}

void rw_diagnoser_gyro(rw_diagnoser *d, rw_time time, const rw_real *rate, bool valid)
{
    const rw_time was = d->front.start;
    rw_front_gyro(&d->front, d->vehicle, d->plan, time, valid ? rate[0] : (rw_real)NAN, rate[1], rate[2]);
    go_on(d, was);
}

void rw_diagnoser_accel(rw_diagnoser *d, rw_time time, const rw_real *force, bool valid)
{
    const rw_time was = d->front.start;
    rw_front_accel(&d->front, d->vehicle, d->plan, time, valid ? force[0] : (rw_real)NAN, force[1], force[2]);
    go_on(d, was);
}

void rw_diagnoser_velocity(rw_diagnoser *d, rw_time time, rw_real climb, rw_real speed)
{
    const rw_time was = d->front.start;
    rw_front_speed(&d->front, d->vehicle, d->plan, time, climb, speed);
    go_on(d, was);
}

void rw_diagnoser_velocity_ned(rw_diagnoser *d, rw_time time, const rw_real *velocity)
{
    const rw_time was = d->front.start;
    rw_front_velocity(&d->front, d->vehicle, d->plan, time, velocity[0], velocity[1], velocity[2]);
    go_on(d, was);
}

void rw_diagnoser_state(rw_diagnoser *d, rw_time time, int landed, int armed)
{
    const rw_time was = d->front.start;
    rw_front_state(&d->front, d->vehicle, d->plan, time, landed, armed);
    go_on(d, was);
}

void rw_diagnoser_attitude(rw_diagnoser *d, rw_time time, const rw_real *q)
{
    const rw_time was = d->front.start;
    rw_front_attitude(&d->front, d->vehicle, d->plan, time, q[0], q[1], q[2], q[3]);
    go_on(d, was);
}

void rw_diagnoser_battery(rw_diagnoser *d, rw_time time, rw_real ratio)
{
    const rw_time was = d->front.start;
    rw_front_voltage(&d->front, d->vehicle, d->plan, time, ratio);
    go_on(d, was);
}

void rw_diagnoser_outputs(rw_diagnoser *d, rw_time time, const rw_real *output, rw_rotors known)
{
    const rw_time was = d->front.start;
    rw_real u[RW_ROTORS];
    for (int k = 0; k < RW_ROTORS; k++) u[k] = (known >> k) & 1 && isfinite(output[k]) ? output[k] : (rw_real)NAN;
    rw_front_outputs(&d->front, d->vehicle, d->plan, time, u);
    go_on(d, was);
}

void rw_diagnoser_control(rw_diagnoser *d, rw_time time, const rw_real *control, bool valid)
{
    const rw_time was = d->front.start;
    rw_real demand[4];
    for (int k = 0; k < 4; k++) demand[k] = valid && isfinite(control[k]) ? control[k] : (rw_real)NAN;
    rw_front_control(&d->front, d->vehicle, d->plan, time, demand);
    go_on(d, was);
}

void rw_diagnoser_finish(rw_diagnoser *d, rw_time time)
{
    const rw_time was = d->front.start;
    rw_front_finish(&d->front, d->vehicle, d->plan, time);
    do go_on(d, was);
    while (d->front.count);
}

int rw_diagnoser_poll(rw_diagnoser *d, rw_notification *notifications)
{
    rw_change *const changes = d->poll.changes;
    const bool flies = d->front.start < RW_LASTS;
    const int32_t lost = rw_losses_losses(&d->losses, d->vehicle, flies, &d->poll.records, d->poll.losses);
    const int32_t deviating = rw_deviations_found(&d->front.deviations, d->vehicle, d->poll.overrides);
    d->event_count = (uint8_t)rw_report_events(&d->report, d->vehicle, d->poll.losses, lost, d->poll.overrides, deviating, d->listed);
    const rw_time final = d->front.newest - FINAL_S;
    const int32_t count = rw_changes_look(&d->changes, d->listed, d->event_count, final, -1, false, d->withdrawn, changes);
    for (int k = 0; k < count; k++) {
        notifications[k].event = changes[k].what == RW_WITHDRAWN ? &d->withdrawn[changes[k].place] : &d->listed[changes[k].place];
        notifications[k].number = (uint16_t)changes[k].number;
        notifications[k].kind = (uint8_t)changes[k].what;
    }
    return (int)count;
}

int rw_diagnoser_events(const rw_diagnoser *d, const rw_event **events)
{
    *events = d->listed;
    return d->event_count;
}

int rw_diagnoser_main(const rw_diagnoser *d) { return (int)rw_events_main_event(d->listed, d->event_count); }

int rw_diagnoser_verdict(const rw_diagnoser *d)
{
    const bool judged = d->judged && !d->front.air.unseen; /* what is not seen is not healthy */
    return (int)rw_events_verdict(d->listed, d->event_count, judged);
}

const char *rw_diagnoser_verdict_text(const rw_diagnoser *d)
{
    static const char *const words[] = {"not judged", "healthy so far", "fault found", "ambiguous"};
    return words[rw_diagnoser_verdict(d)];
}

int rw_diagnoser_words(const rw_notification *notification, char *text)
{
    const bool withdrawn = notification->kind == RW_WITHDRAWN;
    rw_words words;
    rw_words_init(&words);
    rw_words_event(&words, notification->event, withdrawn, notification->event->kind == RW_CONTACT ? "knock or contact" : "output overridden");
    memcpy(text, words.at, RW_TEXT);
    return (int)rw_words_severity(notification->event, withdrawn);
}
