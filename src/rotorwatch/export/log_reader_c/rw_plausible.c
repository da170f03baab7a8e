/* Values that are damage of the log, not of the vehicle: logs/plausible.py, by its definition in rw_lone.h. They become unknown. */
#include "rw_log.h"

#include "rw_lone.h"
#include "rw_tables.h"

#include <math.h>
#include <string.h>

/* What is known of one signal: lone values by their deviation. */
typedef struct {
    bool *valid;
    double *size, floor;
} lone;

static const int COUPLED[] = {RW_OUTPUTS, RW_CONTROL, RW_GYRO, RW_RATES, RW_ACCEL};
#define COUPLED_COUNT 5

/* The signals in the order of `plausible.FLOORS`, with the least deviation that counts. */
static const struct {
    int kind;
    double floor;
} FLOORS[] = {{RW_CONTROL, RW_FLOOR_CONTROL}, {RW_OUTPUTS, RW_FLOOR_MOTORS}, {RW_GYRO, RW_FLOOR_RATES},        {RW_RATES, RW_FLOOR_RATES},
              {RW_ACCEL, RW_FLOOR_ACCEL},     {RW_ATTITUDE, RW_FLOOR_ATTITUDE}, {RW_VELOCITY, RW_FLOOR_VELOCITY}};
#define FLOOR_COUNT (sizeof FLOORS / sizeof *FLOORS)

static bool measure(rw_log *log, const rw_series *s, bool alike, lone *found)
{
    const size_t cells = s->n * s->width;
    double near[RW_ROTORS], *rough, *steps;
    int32_t *at;
    found->size = rw_reserve(log, cells, sizeof *found->size);
    const size_t kept = log->block_count;
    rough = rw_reserve(log, cells, sizeof *rough), steps = rw_reserve(log, s->n, sizeof *steps), at = rw_reserve(log, s->n, sizeof *at);
    if (!rough || !steps || !at || !found->size)
        return false;
    for (size_t c = 0; c < s->width; c++) {
        size_t m = 0, last = s->n;
        for (size_t i = 0; i < s->n; i++)
            if (found->valid[i * s->width + c]) {
                if (last < s->n)
                    steps[m++] = s->time[i] - s->time[last];
                last = i;
            }
        near[c] = m ? RW_FAR * fmax(rw_median(log, steps, m), 1e-6) : 0.0;
    }
    rw_lone_values_lone((int32_t)s->n, (int32_t)s->width, s->time, s->value, found->valid, found->floor, alike, near, rough, at, found->size);
    rw_release(log, kept);
    return true;
}

/* Index of the sample nearest to a time. */
static int32_t nearest(const rw_series *s, double time)
{
    size_t low = 0, high = s->n;
    while (low < high) {
        const size_t middle = low + (high - low) / 2;
        if (s->time[middle] < time)
            low = middle + 1;
        else
            high = middle;
    }
    low = low < 1 ? 1 : low > s->n - 1 ? s->n - 1 : low;
    return s->n < 2 ? 0 : (int32_t)(low - (time <= 0.5 * (s->time[low] + s->time[low - 1])));
}

/* Add to jumps (m,) those of a partner's samples. */
static bool support(rw_log *log, const rw_series *s, const lone *of, size_t m, const int32_t *rows, const int32_t *own, double *jumps)
{
    const size_t kept = log->block_count;
    double *calm = rw_reserve(log, s->n * s->width, sizeof *calm), *rough = rw_reserve(log, s->n * s->width, sizeof *rough);
    if (!calm || !rough)
        return false;
    rw_lone_values_support((int32_t)s->n, (int32_t)s->width, s->time, s->value, of->valid, of->size, of->floor, (int32_t)m, rows, own, calm, rough, jumps);
    rw_release(log, kept);
    return true;
}

/* Mark as wrong the lone values of a signal without a jump in any coupled one; alone: share of their own deviation that counts as one.
   kind: of the signal, -1: compared with its own columns alone. */
static bool unsupported(rw_log *log, int kind, const rw_series *s, const lone *all, const lone *of, double alone, bool *wrong)
{
    size_t m = 0, cells = s->n * s->width;
    int32_t *rows, *own, *theirs;
    double *jumps;
    bool coupled = false;
    for (size_t i = 0; i < cells; i++)
        m += of->size[i] > 0.0;
    rows = rw_reserve(log, m, sizeof *rows), own = rw_reserve(log, m, sizeof *own);
    theirs = rw_reserve(log, m, sizeof *theirs), jumps = rw_reserve(log, m, sizeof *jumps);
    if (!m || !rows || !own || !theirs || !jumps)
        return !m;
    for (size_t i = 0, k = 0; i < cells; i++)
        if (of->size[i] > 0.0)
            rows[k] = (int32_t)(i / s->width), own[k++] = (int32_t)(i % s->width);
    if (kind != RW_ATTITUDE && !support(log, s, of, m, rows, own, jumps)) /* one wrong angle changes the whole quaternion */
        return false;
    for (size_t k = 0; k < COUPLED_COUNT; k++)
        coupled = coupled || COUPLED[k] == kind;
    for (size_t p = 0; coupled && p < COUPLED_COUNT; p++) {
        const rw_series *partner = &log->series[COUPLED[p]];
        if (COUPLED[p] == kind || partner->n < 1 || partner->time == s->time)
            continue; /* absent, or the same numbers by another name */
        for (size_t k = 0; k < m; k++) {
            theirs[k] = nearest(partner, s->time[rows[k]]);
            own[k] = -1;
        }
        if (!support(log, partner, &all[COUPLED[p]], m, theirs, own, jumps))
            return false;
    }
    for (size_t i = 0, k = 0; i < cells; i++)
        if (of->size[i] > 0.0) {
            wrong[i] = wrong[i] || jumps[k] < fmax(RW_JUMPS, of->size[i] * alone);
            k++;
        }
    return true;
}

/* Outputs that are lone in the part that the rate controller's output does not explain. */
static bool beyond_mixer(rw_log *log, const lone *motors, bool *wrong)
{
    enum { TERMS = 6 };
    const rw_series *s = &log->series[RW_OUTPUTS], *c = &log->series[RW_CONTROL];
    rw_series rest;
    lone of = {NULL, NULL, motors->floor};
    double *terms = rw_reserve(log, s->n * TERMS, sizeof *terms);
    size_t *whole = rw_reserve(log, c->n, sizeof *whole), wholes = 0;
    bool *fit = rw_reserve(log, s->n, sizeof *fit);
    of.valid = rw_reserve(log, s->n * s->width, sizeof *of.valid);
    if (!terms || !whole || !fit || !of.valid || !rw_series_new(log, &rest, s->n, s->width))
        return false;
    for (size_t i = 0; i < c->n; i++)
        if (rw_whole(c, i))
            whole[wholes++] = i;
    if (wholes < RW_FIT_EVERY || s->n < RW_FIT_EVERY)
        return true;
    for (size_t i = 0, after = 0; i < s->n; i++) {
        double *x = &terms[i * TERMS];
        while (after < wholes && c->time[whole[after]] < s->time[i])
            after++;
        const size_t b = whole[after < wholes ? after : wholes - 1], a = whole[after ? after - 1 : 0];
        const double part = b > a && c->time[b] > c->time[a] ? fmin(fmax((s->time[i] - c->time[a]) / (c->time[b] - c->time[a]), 0.0), 1.0) : 1.0;
        const bool near = fmin(fabs(c->time[a] - s->time[i]), fabs(c->time[b] - s->time[i])) < RW_PARTNER_S;
        for (size_t k = 0; k < 4; k++)
            x[k] = c->value[4 * a + k] + part * (c->value[4 * b + k] - c->value[4 * a + k]);
        x[4] = x[3] * x[3], x[5] = 1.0;
        fit[i] = near;
        rest.time[i] = s->time[i];
        for (size_t k = 0; k < s->width; k++) {
            of.valid[i * s->width + k] = near && motors->valid[i * s->width + k] && !wrong[i * s->width + k];
            fit[i] = fit[i] && of.valid[i * s->width + k];
        }
    }
    for (size_t start = 0; start < s->n; start += RW_FIT_EVERY) {
        const size_t first = start > RW_FITTED ? start - RW_FITTED : 0, stop = start + RW_FIT_EVERY < s->n ? start + RW_FIT_EVERY : s->n;
        double square[TERMS * TERMS] = {0}, vector[TERMS * TERMS], right[TERMS][RW_ROTORS] = {{0}}, weight[TERMS][RW_ROTORS] = {{0}}, most = 0.0;
        for (size_t i = first; i < stop; i++)
            for (size_t r = 0; fit[i] && r < TERMS; r++) {
                for (size_t k = 0; k < TERMS; k++)
                    square[r * TERMS + k] += terms[i * TERMS + r] * terms[i * TERMS + k];
                for (size_t k = 0; k < s->width; k++)
                    right[r][k] += terms[i * TERMS + r] * s->value[i * s->width + k];
            }
        rw_eigen(TERMS, square, vector);
        for (size_t e = 0; e < TERMS; e++)
            most = fmax(most, square[e * TERMS + e]);
        for (size_t e = 0; e < TERMS; e++)
            for (size_t k = 0; k < s->width && square[e * TERMS + e] > 1e-12 * most; k++) {
                double along = 0.0;
                for (size_t r = 0; r < TERMS; r++)
                    along += vector[e * TERMS + r] * right[r][k];
                for (size_t r = 0; r < TERMS; r++)
                    weight[r][k] += vector[e * TERMS + r] * along / square[e * TERMS + e];
            }
        for (size_t i = start; i < stop; i++)
            for (size_t k = 0; k < s->width; k++) {
                double explained = 0.0;
                for (size_t r = 0; r < TERMS; r++)
                    explained += terms[i * TERMS + r] * weight[r][k];
                rest.value[i * s->width + k] = s->value[i * s->width + k] - explained;
            }
    }
    return measure(log, &rest, false, &of) && unsupported(log, -1, &rest, NULL, &of, RW_ALONE_IN_AXIS, wrong);
}

/* Lone records in which most outputs are no command (0: off, or impossible) become unknown. */
static void whole_records(rw_log *log)
{
    rw_series *s = &log->series[RW_OUTPUTS];
    double *steps = rw_reserve(log, s->n, sizeof *steps), usual;
    size_t broken = 0;
    if (!steps || s->n < 3 || s->width < 2)
        return;
    for (size_t i = 1; i < s->n; i++)
        steps[i - 1] = s->time[i] - s->time[i - 1];
    usual = RW_FAR * fmax(rw_median(log, steps, s->n - 1), 1e-6);
    for (int turn = 0; turn < 2; turn++) {
        for (size_t i = 1; i + 1 < s->n; i++) {
            size_t known = 0;
            for (size_t k = 0; k < s->width; k++)
                known += !isnan(s->value[i * s->width + k]);
            if (2 * known > s->width || !rw_whole(s, i - 1) || !rw_whole(s, i + 1) || !(s->time[i + 1] - s->time[i - 1] < usual))
                continue;
            broken += !turn;
            for (size_t k = 0; turn && k < s->width; k++)
                s->value[i * s->width + k] = NAN;
        }
        if (!broken || (double)broken > RW_HABIT * (double)s->n)
            return;
    }
}

/* Whether many samples repeat the one before, with its time; `drop` removes them. */
static bool repeats(rw_series *s, bool drop)
{
    size_t again = 0, kept = 0;
    for (size_t i = 0; i < s->n; i++) {
        const double *x = &s->value[i * s->width];
        bool same = i && s->time[i] == s->time[i - 1];
        for (size_t k = 0; same && k < s->width; k++)
            same = x[k] == x[(ptrdiff_t)k - (ptrdiff_t)s->width] || (isnan(x[k]) && isnan(x[(ptrdiff_t)k - (ptrdiff_t)s->width]));
        again += same;
    }
    if (!((double)again > RW_HABIT * (double)s->n))
        return false;
    for (size_t i = 0; drop && i < s->n; i++) {
        const double *x = &s->value[i * s->width], *before = &s->value[(kept ? kept - 1 : 0) * s->width];
        bool same = kept && s->time[i] == s->time[kept - 1];
        for (size_t k = 0; same && k < s->width; k++)
            same = x[k] == before[k] || (isnan(x[k]) && isnan(before[k]));
        if (same)
            continue;
        s->time[kept] = s->time[i];
        memmove(&s->value[kept * s->width], x, s->width * sizeof *x);
        kept++;
    }
    s->n = drop ? kept : s->n;
    return true;
}

bool rw_without_damage(rw_log *log)
{
    lone all[RW_KINDS] = {{0}};
    bool often = false, *wrong[RW_KINDS] = {0};
    for (size_t k = 0; k < COUPLED_COUNT; k++)
        often = repeats(&log->series[COUPLED[k]], false) || often;
    for (int k = 0; often && k < RW_KINDS; k++)
        repeats(&log->series[k], k != RW_STATE && !(k == RW_RATES && log->series[k].time == log->series[RW_GYRO].time));
    if (often && log->series[RW_RATES].time == log->series[RW_GYRO].time)
        log->series[RW_RATES].n = log->series[RW_GYRO].n;
    whole_records(log);
    for (size_t f = 0; f < FLOOR_COUNT; f++) {
        const int kind = FLOORS[f].kind;
        const rw_series *s = &log->series[kind];
        const size_t cells = s->n * s->width;
        if (!s->n)
            continue;
        all[kind].floor = FLOORS[f].floor * (kind == RW_OUTPUTS && log->pulses ? 1e3 : 1.0);
        all[kind].valid = rw_reserve(log, cells, sizeof *all[kind].valid);
        wrong[kind] = rw_reserve(log, cells, sizeof *wrong[kind]);
        if (!all[kind].valid || !wrong[kind])
            return false;
        for (size_t i = 0; i < cells; i++)
            all[kind].valid[i] = !isnan(s->value[i]);
        if (!measure(log, s, kind == RW_OUTPUTS, &all[kind]))
            return false;
    }
    for (size_t f = 0; f < FLOOR_COUNT; f++) {
        const int kind = FLOORS[f].kind;
        rw_series *s = &log->series[kind];
        size_t count = 0, known = 0;
        if (!s->n)
            continue;
        if (!unsupported(log, kind, s, all, &all[kind], RW_ALONE, wrong[kind])
            || (kind == RW_OUTPUTS && log->series[RW_CONTROL].n && !beyond_mixer(log, &all[kind], wrong[kind])))
            return false;
        for (size_t i = 0; i < s->n * s->width; i++)
            count += wrong[kind][i], known += all[kind].valid[i];
        for (size_t i = 0; (double)count <= RW_HABIT * (double)known && i < s->n * s->width; i++)
            if (wrong[kind][i]) {
                s->value[i] = NAN;
                all[kind].valid[i] = false;
            }
    }
    return !log->why[0];
}
