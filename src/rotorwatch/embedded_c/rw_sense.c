#include "rw_sense.h"

#include <string.h>

#define N RW_ROTORS
#define R(x) ((rw_real)(x))

static const double G0 = 9.80665;
static const rw_time HALF_SECOND = 0.5; /* side forces are averaged over, and vibration is held against */
static const rw_time LATE_S = 0.9, GAP_S = 4.0;
static const double MOST_TICKS = 1e9; /* numbers of ticks stay in 32 bits: a clock that jumped farther is not followed */
static const rw_time NO_COMMAND_S = 0.2; /* after a tick: there was none in it; the motion is kept for longer */

static int place(const rw_ring *r, int k, int size) { return (r->first + k) % size; }

/* Room for one more sample: its place, and how many were dropped for it (0 or 1); -1 where its time does not grow. */
static int room(rw_ring *r, const rw_time *times, int size, rw_time time, int *dropped)
{
    *dropped = 0;
    if (r->count > 0 && !(time > times[place(r, r->count - 1, size)])) return -1;
    if (r->count == 0) r->start = time;
    if (r->count == size) {
        r->first = (int16_t)((r->first + 1) % size);
        r->count--;
        *dropped = 1;
    }
    return place(r, r->count++, size);
}

/* Area under three columns between the times `from` and `to`, as straight lines between samples; nothing before and after them. */
static void area(const rw_ring *r, const rw_time *times, rw_real (*const values)[3], int size, rw_time from, rw_time to, double *sum)
{
    sum[0] = sum[1] = sum[2] = 0;
    for (int k = 0; k + 1 < r->count; k++) {
        const int i = place(r, k, size), j = place(r, k + 1, size);
        const rw_time width = times[j] - times[i];
        const rw_time a = from > times[i] ? from : times[i], b = to < times[j] ? to : times[j];
        if (!(a < b)) continue;
        const double middle = (0.5 * (a + b) - times[i]) / width;
        for (int c = 0; c < 3; c++) {
            const double left = (double)values[i][c], right = (double)values[j][c];
            sum[c] += (b - a) * (left + middle * (right - left));
        }
    }
}

/* Is the time from `from` to `to` covered by at least so many samples? */
static bool covered(const rw_ring *r, const rw_time *times, int size, rw_time from, rw_time to, int least)
{
    int within = 0;
    if (r->count < 2 || from < r->start || to > times[place(r, r->count - 1, size)] + 1e-9) return false;
    for (int k = 0; k < r->count; k++) {
        const rw_time time = times[place(r, k, size)];
        within += time >= from && time <= to;
    }
    return within >= least;
}

void rw_sense_init(rw_sense *s)
{
    memset(s, 0, sizeof *s);
    s->last = -1;
    s->gap_from = s->gap_to = -1;
    for (int i = 0; i < RW_WAITING; i++) s->bins[i].number = -1;
}

static rw_time end_of(const rw_sense *s, const rw_plan *p, int32_t number) { return s->origin + p->dt * number; }

static double whole_below(double x)
{
    const double whole = (double)(int64_t)x;
    return whole > x ? whole - 1.0 : whole;
}

/* Ticks that are told after the last command and before the next one. */
static int32_t gap(const rw_plan *p) { return (int32_t)(GAP_S / p->dt + 0.5); }

void rw_sense_thrust(rw_sense *s, const rw_plan *p, rw_time time, const rw_real *thrust, bool ok)
{
    int32_t at;
    if (!s->begun) {
        s->begun = true;
        s->origin = whole_below((time - p->phase) / p->dt) * p->dt + p->phase + 0.5 * p->dt;
    }
    if (!(time - s->origin < MOST_TICKS * p->dt && time - s->origin > -MOST_TICKS * p->dt)) return;
    at = (int32_t)((time - s->origin) / p->dt);
    if (at < s->commanded) at = s->commanded;
    for (int32_t k = at > 0 ? at - 1 : 0; ok && k <= at + 1; k++) {
        const rw_time end = end_of(s, p, k);
        if (!(time > end - p->dt && time <= end) || k < s->next) continue;
        if (s->bins[k % RW_WAITING].number != k) {
            memset(&s->bins[k % RW_WAITING], 0, sizeof s->bins[0]);
            s->bins[k % RW_WAITING].number = k;
        }
        for (int i = 0; i < N; i++) s->bins[k % RW_WAITING].sum[i] += thrust[i];
        s->bins[k % RW_WAITING].when += time - s->origin;
        if (s->bins[k % RW_WAITING].count < INT16_MAX) s->bins[k % RW_WAITING].count++;
    }
    if (s->last < 0) { /* the first tick is the one that the first command is in */
        s->last = at;
    } else if (at - s->commanded > 2 * gap(p)) { /* nothing flies in a longer gap */
        s->gap_from = s->commanded + gap(p);
        s->gap_to = at - gap(p);
        if (s->next >= s->gap_from) s->next = s->gap_to;
        s->last = at;
    } else if (at > s->last) {
        s->last = at;
    }
    s->commanded = at;
}

void rw_sense_gyro(rw_sense *s, rw_time time, const rw_real *rate)
{
    int dropped;
    const int k = room(&s->gyros, s->gyro_time, RW_GYRO_KEPT, time, &dropped);
    if (k < 0) return;
    s->gyro_time[k] = time;
    memcpy(s->gyro[k], rate, sizeof s->gyro[k]);
}

/* Vibration up to a time, as far as samples have come. */
static void shaken(rw_sense *s, rw_time until)
{
    while (s->fed < s->accels.count) {
        const int k = place(&s->accels, s->fed, RW_ACCEL_KEPT);
        rw_real sum[3];
        if (s->accel_time[k] > until) return;
        while (s->tail < s->fed) {
            const int old = place(&s->accels, s->tail, RW_ACCEL_KEPT);
            if (s->accel_time[old] >= s->accel_time[k] - HALF_SECOND) break;
            for (int c = 0; c < 3; c++) s->before[c] -= (double)s->accel[old][c];
            s->tail++;
        }
        for (int c = 0; c < 3; c++) sum[c] = s->tail < s->fed ? (rw_real)s->before[c] : 0;
        rw_vibration_sample(&s->vibration, s->accel[k], sum, s->fed - s->tail);
        for (int c = 0; c < 3; c++) s->before[c] = (s->tail < s->fed ? s->before[c] : 0) + (double)s->accel[k][c];
        s->fed++;
    }
}

void rw_sense_accel(rw_sense *s, rw_time time, const rw_real *force)
{
    int dropped, k;
    if (s->accels.count == RW_ACCEL_KEPT) {
        const int oldest = place(&s->accels, 0, RW_ACCEL_KEPT);
        shaken(s, s->accel_time[oldest] + HALF_SECOND); /* what needs the sample that goes is counted first */
        if (s->tail == 0) {
            for (int c = 0; c < 3; c++) s->before[c] -= (double)s->accel[oldest][c];
            s->tail = 1;
        }
    }
    k = room(&s->accels, s->accel_time, RW_ACCEL_KEPT, time, &dropped);
    if (k < 0) return;
    s->fed = (int16_t)(s->fed - dropped);
    s->tail = (int16_t)(s->tail - dropped);
    s->accel_time[k] = time;
    memcpy(s->accel[k], force, sizeof s->accel[k]);
}

void rw_sense_level(rw_sense *s, rw_time time, rw_real level)
{
    int dropped;
    const int k = room(&s->levels, s->level_time, RW_LEVELS, time, &dropped);
    if (k < 0) return;
    s->level_time[k] = time;
    s->level[k] = level;
}

static bool ready(const rw_sense *s, const rw_plan *p, rw_time now)
{
    const rw_time end = end_of(s, p, s->next), motion = end + p->lag;
    const int newest_gyro = place(&s->gyros, s->gyros.count + RW_GYRO_KEPT - 1, RW_GYRO_KEPT);
    const int newest_accel = place(&s->accels, s->accels.count + RW_ACCEL_KEPT - 1, RW_ACCEL_KEPT);
    const rw_time longest = p->accel_half > 0.5 * p->dt ? p->accel_half : 0.5 * p->dt;
    if (s->next > s->last) return false;
    if (s->last + 1 - s->next >= RW_WAITING - 1 || now > motion + 0.5 * p->dt + LATE_S) return true;
    if (p->gyro && !(s->gyros.count > 0 && s->gyro_time[newest_gyro] >= motion + p->gyro_half)) return false;
    return !p->accel || (s->accels.count > 0 && s->accel_time[newest_accel] >= motion + longest);
}

bool rw_sense_next(rw_sense *s, const rw_plan *p, rw_time now, rw_sensed *out)
{
    const rw_time half = 0.5 * p->dt;
    rw_time end, centre;
    double sum[3], first[3], last[3];
    if (!s->begun) return false;
    while (s->last < s->commanded + gap(p) - 1 && s->next > s->last && now > end_of(s, p, s->next) + NO_COMMAND_S && now < 1e8) s->last++;
    if (!ready(s, p, now)) return false;
    end = end_of(s, p, s->next);
    memset(out, 0, sizeof *out);
    out->number = s->next;
    out->time = end + p->lag + half;
    out->when = end - half;
    if (s->bins[s->next % RW_WAITING].number == s->next && s->bins[s->next % RW_WAITING].count > 0) {
        const int16_t count = s->bins[s->next % RW_WAITING].count;
        out->some = true;
        out->when = s->origin + s->bins[s->next % RW_WAITING].when / count;
        for (int i = 0; i < N; i++) out->share[i] = s->bins[s->next % RW_WAITING].sum[i] / R(count);
    }
    centre = out->when + p->lag;
    out->rate_ok = true;
    out->level = out->load = 1;
    if (p->gyro) {
        const rw_time from = centre - p->gyro_half, to = centre + p->gyro_half, part = 0.25 * p->gyro_half;
        area(&s->gyros, s->gyro_time, s->gyro, RW_GYRO_KEPT, from, to, sum);
        area(&s->gyros, s->gyro_time, s->gyro, RW_GYRO_KEPT, from, from + part, first);
        area(&s->gyros, s->gyro_time, s->gyro, RW_GYRO_KEPT, to - part, to, last);
        for (int c = 0; c < 3; c++) {
            out->rate[c] = (rw_real)(sum[c] / (to - from));
            out->rate_dot[c] = (rw_real)((last[c] - first[c]) / part / (2.0 * p->gyro_half - part));
        }
        out->rate_ok = covered(&s->gyros, s->gyro_time, RW_GYRO_KEPT, from, to, p->gyro_least);
    }
    if (p->accel) {
        const rw_time from = centre - p->accel_half, to = centre + p->accel_half;
        shaken(s, centre - half);
        out->shake = rw_vibration_rms(&s->vibration);
        area(&s->accels, s->accel_time, s->accel, RW_ACCEL_KEPT, from, to, sum);
        out->push[0] = (rw_real)(sum[0] / (to - from));
        out->push[1] = (rw_real)(sum[1] / (to - from));
        out->load = (rw_real)(-sum[2] / (to - from) / G0);
        out->load_ok = covered(&s->accels, s->accel_time, RW_ACCEL_KEPT, from, to, p->accel_least);
        if (covered(&s->accels, s->accel_time, RW_ACCEL_KEPT, centre + half - HALF_SECOND, centre + half, p->side_least)) {
            area(&s->accels, s->accel_time, s->accel, RW_ACCEL_KEPT, centre + half - HALF_SECOND, centre + half, sum);
            out->side[0] = (rw_real)(sum[0] / HALF_SECOND);
            out->side[1] = (rw_real)(sum[1] / HALF_SECOND);
        }
    }
    for (int k = 0; k < s->levels.count; k++) {
        const int i = place(&s->levels, k, RW_LEVELS);
        if (k == 0 || s->level_time[i] <= out->time) out->level = s->level[i];
    }
    s->next++;
    if (s->next == s->gap_from) {
        s->next = s->gap_to;
        s->gap_from = -1;
    }
    return true;
}
