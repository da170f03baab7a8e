/* A log through the diagnoser and its answer as JSON: the steps of `rotorwatch diagnose` up to the engine's events. */
#include "rw_log.h"

#include "rw_tables.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define PHASED 64   /* commands that tell the phase of slow ones */
#define ROOM 64     /* ticks in one call */

typedef struct {
    char *text;
    size_t length, room;
} words;

static void say(words *w, const char *format, ...)
{
    va_list arguments;
    int needs;
    if (!w->text)
        return;
    for (;;) {
        va_start(arguments, format);
        needs = vsnprintf(w->text + w->length, w->room - w->length, format, arguments);
        va_end(arguments);
        if (needs >= 0 && (size_t)needs < w->room - w->length) {
            w->length += (size_t)needs;
            return;
        }
        w->room = 2 * w->room + (needs > 0 ? (size_t)needs : 0);
        char *more = realloc(w->text, w->room);
        if (!more) {
            free(w->text);
            w->text = NULL;
            return;
        }
        w->text = more;
    }
}

/* A text as a JSON string. */
static void quote(words *w, const char *text)
{
    say(w, "\"");
    for (; *text; text++)
        if ((unsigned char)*text < 32 || *text == 127)
            say(w, "\\u%04x", (unsigned)*text);
        else
            say(w, *text == '"' || *text == '\\' ? "\\%c" : "%c", *text);
    say(w, "\"");
}

static void number(words *w, double value)
{
    char text[32];
    size_t length;
    snprintf(text, sizeof text, "%.4f", value);
    length = strlen(text);
    while (text[length - 1] == '0')
        text[--length] = 0;
    if (text[length - 1] == '.')
        text[--length] = 0;
    say(w, isfinite(value) ? "%s" : "null", strcmp(text, "-0") ? text : "0");
}

static void rotors(words *w, uint32_t set)
{
    const char *comma = "";
    say(w, "[");
    for (int k = 0; k < RW_ROTORS; k++)
        if (set >> k & 1) {
            say(w, "%s%d", comma, k + 1);
            comma = ", ";
        }
    say(w, "]");
}

/* Samples of all kinds in the order of their times, those of equal times in the order of kinds. */
typedef struct {
    const rw_series *series;
    uint32_t kinds; /* mask of those that are wanted */
    size_t at[RW_KINDS];
} stream;

static bool next_sample(stream *s, int32_t *kind, rw_time *time, rw_real *x)
{
    int found = -1;
    for (int k = 0; k < RW_KINDS; k++)
        if (s->kinds >> k & 1 && s->at[k] < s->series[k].n && (found < 0 || s->series[k].time[s->at[k]] < s->series[found].time[s->at[found]]))
            found = k;
    if (found < 0)
        return false;
    const rw_series *from = &s->series[found];
    const size_t row = s->at[found]++;
    *kind = found;
    *time = from->time[row];
    for (size_t k = 0; k < RW_ROTORS; k++)
        x[k] = k < from->width ? from->value[row * from->width + k] : (rw_real)NAN;
    return true;
}

typedef struct {
    rw_time start, end;
} span;

typedef struct {
    span *spans;
    size_t count;
    bool cannot; /* no memory */
} spans;

static void add_span(spans *s, rw_time start, rw_time end)
{
    if (!(s->count & (s->count - 1))) {
        span *more = realloc(s->spans, (s->count ? 2 * s->count : 1) * sizeof *more);
        if (!more) {
            s->cannot = true;
            return;
        }
        s->spans = more;
    }
    s->spans[s->count++] = (span){start, end};
}

static void take_ended(rw_airborne *a, spans *found)
{
    for (int k = 0; k < a->ended; k++)
        add_span(found, a->flights[k].start, fmin(a->flights[k].end, a->last));
    a->ended = 0;
}

/* The flights of a log: engine/motion/air_spans.py. */
static bool flights(rw_log *log, spans *found)
{
    rw_airborne *a = rw_reserve(log, 1, sizeof *a);
    stream s = {log->series, 1u << RW_OUTPUTS | 1u << RW_GYRO | 1u << RW_ACCEL | 1u << RW_VELOCITY | 1u << RW_STATE, {0}};
    const int32_t at = 0;
    int32_t kind;
    rw_time time;
    rw_real x[RW_ROTORS];
    if (!a)
        return false;
    rw_airborne_init(a);
    while (next_sample(&s, &kind, &time, x)) {
        rw_calls_fly(a, &log->vehicle, 1, &kind, &time, &at, x);
        take_ended(a, found);
    }
    rw_calls_wait(a, log->end);
    take_ended(a, found);
    if (a->start < a->last)
        add_span(found, a->start, a->last);
    return !found->cannot || rw_refuse(log, "there is not enough memory for this log");
}

/* Whether thrusts are worth rebuilding from the rate controller's output (allocation.faster_control). */
static bool faster_control(rw_log *log)
{
    const rw_series *control = &log->series[RW_CONTROL], *motors = &log->series[RW_OUTPUTS];
    const double controls = rw_rate_hz(log, control), outputs = rw_rate_hz(log, motors);
    const double range = log->vehicle.output_high - log->vehicle.output_low;
    double least = INFINITY;
    size_t steps = 0;
    if (!control->n)
        return false;
    if (controls >= RW_FASTER * outputs)
        return true;
    for (size_t i = motors->width; i < motors->n * motors->width; i++) {
        const double before = motors->value[i - motors->width], now = motors->value[i];
        const double step = fabs((isnan(now) ? 0.0 : now) - (isnan(before) ? 0.0 : before));
        if (step > 0.0) {
            steps++;
            least = fmin(least, step);
        }
    }
    return steps > RW_ENOUGH_STEPS && least > RW_COARSE * range && RW_FASTER * controls >= outputs;
}

/* Usual time between two whole samples [s]; NaN with fewer than two. */
static double period(rw_log *log, const rw_series *s)
{
    double *steps = rw_reserve(log, s->n, sizeof *steps), last = NAN;
    size_t n = 0;
    for (size_t i = 0; steps && i < s->n; i++)
        if (rw_whole(s, i)) {
            if (s->time[i] > last)
                steps[n++] = s->time[i] - last;
            last = s->time[i];
        }
    return steps ? rw_median(log, steps, n) : (double)NAN;
}

/* The division of the flight into ticks: engine/motion/tick_table.py, with engine/intake/planning.py. */
static bool plan(rw_log *log, const spans *air, rw_plan *p)
{
    const rw_series *s = log->series;
    const bool rebuilt = faster_control(log);
    const rw_series *commands = &s[rebuilt ? RW_CONTROL : RW_OUTPUTS];
    const double hz = rw_rate_hz(log, commands), gyro_s = period(log, &s[RW_GYRO]);
    const double accel_s = s[RW_ACCEL].n ? period(log, &s[RW_ACCEL]) : (double)NAN;
    double longest = 0.0, phase = 0.0, slowest = fmax(isnan(gyro_s) ? 0.0 : gyro_s, isnan(accel_s) ? 0.0 : accel_s), first;
    size_t whole = 0;
    for (size_t i = 0; i < s[RW_OUTPUTS].n; i++)
        whole += rw_whole(&s[RW_OUTPUTS], i);
    if (commands->n < RW_LEAST_COMMANDS || !whole)
        return rw_refuse(log, "this log holds too few motor outputs to be assessed");
    for (size_t k = 0; k < air->count; k++)
        longest = fmax(longest, air->spans[k].end - air->spans[k].start);
    rw_plan_init(p);
    p->dt = rw_planning_tick_length(hz);
    p->ready = rw_planning_ready_after(rw_planning_ready_within(RW_PLAN_READY_S, longest), p->dt);
    p->lag = RW_PLAN_LAG_S;
    if (hz < 1.5 / p->dt) { /* slow commands are single samples: put them in the middle of their ticks */
        double x = 0.0, y = 0.0, turns;
        for (size_t i = 0; i < commands->n && i < PHASED; i++) {
            const double angle = 2.0 * RW_PI * commands->time[i] / p->dt;
            x += cos(angle), y += sin(angle);
        }
        turns = atan2(y, x) / (2.0 * RW_PI);
        phase = (turns - floor(turns)) * p->dt;
    }
    first = floor((commands->time[0] - phase) / p->dt) * p->dt + phase;
    p->phase = first - floor(first / p->dt) * p->dt;
    p->gyro = true;
    p->accel = s[RW_ACCEL].n > 0;
    p->gyro_half = rw_planning_half_averaged(p->dt, hz, rw_rate_hz(log, &s[RW_GYRO]));
    p->accel_half = p->accel ? rw_planning_half_averaged(p->dt, hz, rw_rate_hz(log, &s[RW_ACCEL])) : p->dt / 2.0;
    p->gyro_least = rw_planning_samples_in(p->gyro_half, gyro_s);
    p->accel_least = rw_planning_samples_in(p->accel_half, accel_s);
    p->side_least = rw_planning_samples_in(0.5 * RW_PLAN_SIDE_S, accel_s);
    p->late = fmax(RW_PLAN_LATE_S, RW_PLAN_LATE_PERIODS * slowest);
    p->before = (int32_t)fmax(2.0, rint(RW_PLAN_BEFORE_S / p->dt));
    p->rebuilt = rebuilt;
    return true;
}

/* What the ticks of a log show beside the engine's records. upset: since when the vehicle tumbles in a flight, RW_LASTS: never. The
   arrays: of each tick, as rw_carried_on_ground takes them; commanded: up to the last one with commands. */
typedef struct {
    size_t assessed, aloft, hovering, count, commanded, room;
    rw_time upset, *time;
    rw_real *thrust, *load, *hover, *axial;
    bool *valid, *restart, *ground;
    int32_t *mode;
} seen;

static bool room_for_ticks(rw_log *log, const rw_plan *p, seen *all)
{
    const size_t n = (size_t)(log->end / p->dt) + 64;
    all->room = n;
    all->time = rw_reserve(log, n, sizeof *all->time), all->thrust = rw_reserve(log, n * (size_t)log->vehicle.rotors, sizeof *all->thrust);
    all->load = rw_reserve(log, n, sizeof *all->load), all->hover = rw_reserve(log, n, sizeof *all->hover);
    all->axial = rw_reserve(log, n, sizeof *all->axial), all->valid = rw_reserve(log, n, sizeof *all->valid);
    all->restart = rw_reserve(log, n, sizeof *all->restart), all->ground = rw_reserve(log, n, sizeof *all->ground);
    all->mode = rw_reserve(log, n, sizeof *all->mode);
    return !log->why[0];
}

static void look(seen *all, const rw_vehicle *v, const spans *air, const rw_made *made, int32_t count)
{
    for (int32_t i = 0; i < count; i++) {
        const rw_made *one = &made[i];
        const size_t n = all->count;
        double carried = 0.0;
        bool after = false; /* the end of its flight */
        for (int k = 0; k < v->rotors; k++)
            carried += one->thrust[k] / v->rotors;
        for (size_t k = 0; k < air->count; k++)
            after = after || (one->when > air->spans[k].end && one->time >= air->spans[k].start
                              && (k + 1 == air->count || one->time < air->spans[k + 1].start));
        if (n < all->room) {
            all->time[n] = one->time, all->load[n] = one->load, all->hover[n] = one->hover, all->axial[n] = one->axial;
            all->valid[n] = one->valid[3] && !after, all->restart[n] = one->restart, all->mode[n] = after ? RW_GROUND : one->mode;
            memcpy(&all->thrust[n * (size_t)v->rotors], one->thrust, (size_t)v->rotors * sizeof *all->thrust);
            all->count++;
            all->commanded = one->some ? all->count : all->commanded;
        }
        if (one->mode == RW_GROUND || after)
            continue;
        all->aloft++;
        all->hovering += carried > RW_CARRIES_LEAST && carried < RW_CARRIES_MOST && !one->upset;
        all->assessed += one->mode == RW_ASSESS && (one->valid[0] || one->valid[1] || one->valid[2] || one->valid[3]);
        if (one->upset)
            all->upset = fmin(all->upset, one->time);
    }
}

/* The ticks in which the ground carries a part of the vehicle; before a fall it does not. False where the outputs are not those that flew. */
static bool find_ground(rw_log *log, const spans *air, const rw_engine *g, const rw_plan *p, seen *all)
{
    const size_t n = all->commanded;
    rw_real *carried = rw_reserve(log, 2 * n, sizeof *carried), *some = rw_reserve(log, n, sizeof *some);
    int32_t *rows = rw_reserve(log, n, sizeof *rows);
    rw_time *starts = rw_reserve(log, air->count, sizeof *starts), *ends = rw_reserve(log, air->count, sizeof *ends);
    if (!carried || !some || !rows || !starts || !ends)
        return false;
    for (size_t k = 0; k < air->count; k++)
        starts[k] = air->spans[k].start, ends[k] = air->spans[k].end;
    rw_carried_on_ground((int32_t)n, log->vehicle.rotors, p->dt, all->time, all->thrust, all->load, all->valid, all->mode, all->restart, all->hover,
                         all->axial, g->estimator.branches.all[0].s[RW_AIR], (int32_t)air->count, starts, ends, carried, some, rows, all->ground);
    for (size_t i = 0; i < n; i++)
        all->ground[i] = all->ground[i] && all->time[i] <= all->upset - RW_FALLS_S;
    return rw_outputs_flew(log, starts, ends, air->count);
}

static bool on_ground(const seen *all, rw_time time)
{
    size_t i = 0;
    while (i + 1 < all->commanded && all->time[i] < time)
        i++;
    return all->commanded && all->ground[i];
}

/* Height above the place of take-off at a time; NaN where it is not known (witnesses/near_ground.py). */
static size_t position_at(const rw_series *s, rw_time time)
{
    size_t found = s->n;
    for (size_t i = 0; i < s->n && s->time[i] <= time; i++)
        if (rw_whole(s, i))
            found = i;
    return found < s->n && time - s->time[found] <= RW_FRESH_S ? found : s->n;
}

/* Whether what begins and is announced at these times is so near the height of take-off that the ground explains it as well. */
static bool near_ground(const rw_log *log, const spans *air, rw_time begins, rw_time announced)
{
    const rw_series *s = &log->position;
    size_t at[3];
    double low = INFINITY, high = -INFINITY;
    for (size_t k = 0; k < air->count; k++) {
        const rw_time start = air->spans[k].start;
        if (!(start <= begins && begins <= air->spans[k].end + RW_FRESH_S))
            continue;
        if (start - 1.0 < log->series[RW_OUTPUTS].time[0]) /* a log that begins in the air does not show where the ground is */
            return false;
        at[0] = position_at(s, start - 1.0), at[1] = position_at(s, begins), at[2] = position_at(s, announced);
        if (at[0] == s->n || at[1] == s->n || at[2] == s->n)
            return false;
        for (size_t i = at[0]; i <= at[2]; i++)
            if (rw_whole(s, i))
                low = fmin(low, s->value[3 * i + 2]), high = fmax(high, s->value[3 * i + 2]);
        if (high - low < RW_MOVES_M)
            return false;
        return s->value[3 * at[0] + 2] - fmin(s->value[3 * at[1] + 2], s->value[3 * at[2] + 2]) < RW_NEAR_M;
    }
    return false;
}

/* The whole log through the engine: engine/driver.py, fly. */
static bool fly(rw_log *log, const spans *air, const rw_plan *p, rw_plant *plant, rw_engine *g, seen *all)
{
    rw_made *made = rw_reserve(log, ROOM, sizeof *made);
    rw_result *out = rw_reserve(log, ROOM, sizeof *out);
    stream s = {log->series, (1u << RW_RATES) - 1, {0}};
    const int32_t at = 0;
    rw_time time, reached = -RW_LASTS, end = log->end;
    rw_real x[RW_ROTORS];
    rw_fed fed;
    int32_t kind;
    size_t next = 0;
    if (!made || !out)
        return false;
    rw_fed_init(&fed);
    rw_feed_begin(g, plant);
    g->trim.every = RW_LASTS; /* looked at once, at the end */
    while (next_sample(&s, &kind, &time, x)) {
        while (next < air->count && air->spans[next].start <= time) {
            if (air->spans[next].start > reached)
                g->fell = fmin(air->spans[next].end, RW_LASTS);
            next++;
        }
        reached = time;
        do {
            rw_feed_feed(g, &log->vehicle, p, plant, 0, 1, &kind, &time, &at, x, made, out, ROOM, &fed);
            look(all, &log->vehicle, air, made, fed.ticks);
        } while (!fed.samples);
    }
    do {
        rw_feed_finish(g, &log->vehicle, p, plant, end, made, out, ROOM, &fed);
        look(all, &log->vehicle, air, made, fed.ticks);
        end = RW_LASTS;
    } while (fed.ticks);
    return true;
}

/* The engine's events; returns how many. Outputs that left the mixer count in flight, and end with it. What began while the ground carried
   a part of the vehicle, or near its height, the ground explains as well; so no loss ends there. */
static int32_t events(rw_log *log, const spans *air, const rw_engine *g, const seen *all, rw_event *out)
{
    rw_event *losses = rw_reserve(log, RW_RECORDS, sizeof *losses);
    rw_override *overrides = rw_reserve(log, RW_OVERRIDES, sizeof *overrides);
    int32_t lost = 0, many = 0, count;
    if (!losses || !overrides)
        return 0;
    count = rw_calls_losses(&g->losses, &log->vehicle, false, losses);
    for (int32_t i = 0; i < count; i++)
        if (!on_ground(all, losses[i].onset) && !near_ground(log, air, losses[i].onset, losses[i].detected)) {
            losses[lost] = losses[i];
            if (on_ground(all, losses[i].end) || near_ground(log, air, losses[i].end, losses[i].end))
                losses[lost].end = RW_LASTS;
            lost++;
        }
    lost = rw_many_with_growth(&g->trim.growth, losses, lost, RW_RECORDS);
    count = rw_calls_overrides(&g->front.deviations, &log->vehicle, overrides);
    for (int32_t i = 0; i < count; i++)
        for (size_t k = 0; k < air->count; k++)
            if (air->spans[k].start <= overrides[i].onset && overrides[i].onset < air->spans[k].end
                && overrides[i].detected <= air->spans[k].end + RW_PLAN_CONFIRM_S) {
                if (!on_ground(all, overrides[i].onset)) {
                    overrides[many] = overrides[i];
                    overrides[many].end = fmin(overrides[many].end, air->spans[k].end);
                    many++;
                }
                break;
            }
    count = rw_calls_events(&g->report, &log->vehicle, losses, lost, overrides, many, out);
    return on_ground(all, g->trim.mount.onset) ? count : rw_mount_put(&g->trim.mount, out, count, RW_EVENTS);
}

static void tell_event(words *w, const rw_event *e)
{
    const char *comma = "";
    int at = 0;
    say(w, "{\"kind\": \"%s\", \"rotors\": ", e->kind >= 0 && e->kind < RW_KIND_COUNT && RW_KIND_NAMES[e->kind] ? RW_KIND_NAMES[e->kind] : "");
    rotors(w, e->rotors);
    say(w, ", \"alternatives\": [");
    for (int k = 0; k < e->alternative_count; k++) {
        say(w, "%s", k ? ", " : "");
        rotors(w, e->alternatives[k]);
    }
    say(w, "], \"onset_s\": ");
    number(w, e->onset);
    say(w, ", \"detected_s\": ");
    number(w, e->detected);
    say(w, ", \"end_s\": ");
    number(w, e->end >= RW_LASTS ? (double)NAN : e->end);
    say(w, ", \"loss\": [");
    for (int k = 0; k < RW_ROTORS && e->kind == RW_LOSS && at < RW_TOGETHER; k++)
        if (e->rotors >> k & 1) {
            say(w, "%s", comma);
            number(w, e->loss[at++]);
            comma = ", ";
        }
    say(w, "], \"interval\": [");
    for (int k = 0; k < at; k++) {
        say(w, k ? ", [" : "[");
        number(w, e->lower[k]);
        say(w, ", ");
        number(w, e->upper[k]);
        say(w, "]");
    }
    say(w, "], \"probability\": ");
    number(w, e->probability);
    say(w, "}");
}

static void tell(words *w, rw_log *log, const char *name, const spans *air, const rw_plan *p, const seen *all, const rw_event *found, int32_t count)
{
    const rw_vehicle *v = &log->vehicle;
    const double assessed_s = (double)all->assessed * p->dt;
    const int32_t main_event = rw_events_main_event(found, count);
    /* What happens before a fall may not be seen: without an event it is not called harmless. */
    const int32_t verdict = rw_events_verdict(found, count, assessed_s >= RW_ASSESSED_LEAST_S && all->upset >= RW_LASTS);
    static const char *const VERDICTS[] = {"not assessed", "nothing found", "fault", "ambiguous"};
    say(w, "{\"schema\": 1, \"flight\": {\"name\": ");
    quote(w, name);
    say(w, ", \"format\": \"%s\", \"autopilot\": \"%s\", \"frame\": \"%s\", \"rotors\": %d, \"geometry\": [", log->format, log->autopilot, log->frame,
        v->rotors);
    for (int k = 0; k < v->rotors; k++) {
        say(w, "%s{\"x\": ", k ? ", " : "");
        number(w, v->effectiveness[1][k] / v->effectiveness[3][k]);
        say(w, ", \"y\": ");
        number(w, -v->effectiveness[0][k] / v->effectiveness[3][k]);
        say(w, ", \"spin\": %d}", (v->effectiveness[2][k] > 0.0) - (v->effectiveness[2][k] < 0.0));
    }
    say(w, "], \"duration_s\": ");
    number(w, log->end);
    say(w, ", \"hops\": [");
    for (size_t k = 0; k < air->count; k++) {
        say(w, k ? ", [" : "[");
        number(w, air->spans[k].start);
        say(w, ", ");
        number(w, air->spans[k].end);
        say(w, "]");
    }
    say(w, "], \"assessed_s\": ");
    number(w, assessed_s);
    say(w, ", \"tick_s\": ");
    number(w, p->dt);
    say(w, "}, \"verdict\": \"%s\", \"main_event\": ", VERDICTS[verdict]);
    say(w, main_event < 0 ? "null" : "%d", (int)main_event);
    say(w, ", \"events\": [");
    for (int32_t k = 0; k < count; k++) {
        say(w, "%s", k ? ", " : "");
        tell_event(w, &found[k]);
    }
    say(w, "], \"tumbled_s\": ");
    number(w, all->upset < RW_LASTS ? all->upset : (double)NAN);
    say(w, ", \"warnings\": [%s]", log->warned_cut ? "\"the log ends in the middle of a record; everything before it was read\"" : "");
    say(w, ", \"left_to_diagnose\": \"%s\"}\n", RW_LEFT_TO_DIAGNOSE);
}

static bool assess(words *w, rw_log *log, const char *name, spans *air)
{
    seen all = {0};
    rw_plan p;
    rw_plant *plant = rw_reserve(log, 1, sizeof *plant);
    rw_engine *g = rw_reserve(log, 1, sizeof *g);
    rw_event *found = rw_reserve(log, RW_EVENTS, sizeof *found);
    const rw_series *s = log->series;
    if (!plant || !g || !found)
        return false;
    if (log->size >= 7 && !memcmp(log->data, "ULog\x01\x12\x35", 7)) {
        if (!rw_ulog_read(log))
            return false;
    } else if (!rw_dataflash_read(log))
        return false;
    if (!s[RW_GYRO].n)
        return rw_refuse(log, "this log has no gyro");
    if (!rw_without_damage(log))
        return false;
    for (int k = 0; k < RW_RATES; k++)
        if (s[k].n && k != RW_STATE)
            log->end = fmax(log->end, s[k].time[s[k].n - 1]);
    rw_plant_init(plant);
    rw_engine_init(g);
    if (!flights(log, air) || !plan(log, air, &p))
        return false;
    log->vehicle.coaxial = rw_prior_before_take_off(plant, &log->vehicle, p.dt);
    all.upset = RW_LASTS;
    if (!room_for_ticks(log, &p, &all) || (air->count && !fly(log, air, &p, plant, g, &all)) || !find_ground(log, air, g, &p, &all))
        return false;
    if (all.aloft && rw_rate_hz(log, &s[RW_OUTPUTS]) >= RW_AEROBATIC_HZ && rw_rate_hz(log, &s[RW_GYRO]) >= RW_AEROBATIC_HZ
        && (double)all.hovering < RW_HOVERING * (double)all.aloft)
        return rw_refuse(log, "this vehicle does not hover, which only rotorwatch diagnose assesses");
    tell(w, log, name, air, &p, &all, found, events(log, air, g, &all, found));
    return !log->why[0];
}

char *rw_assess_log(const uint8_t *data, size_t size, const char *name)
{
    words w = {malloc(4096), 0, 4096};
    spans air = {0};
    rw_log *log = calloc(1, sizeof *log);
    if (log) {
        log->data = data;
        log->size = size;
        rw_vehicle_init(&log->vehicle);
        if (!assess(&w, log, name, &air)) {
            w.length = 0;
            say(&w, "{\"schema\": 1, \"flight\": {\"name\": ");
            quote(&w, name);
            say(&w, "}, \"error\": ");
            quote(&w, log->why);
            say(&w, "}\n");
        }
        rw_log_close(log);
    } else {
        free(w.text);
        w.text = NULL;
    }
    free(log);
    free(air.spans);
    return w.text;
}
