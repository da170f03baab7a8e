/* Whether the outputs are those that flew: of the tests of engine/motion/trust.py and mixing.py, `outputs_that_never_move`,
   `outputs_at_rest` and `outputs_in_another_order`. Of a log that fails one nothing is assessed. */
#include "rw_log.h"

#include "rw_tables.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

static bool in_the_air(rw_time time, const rw_time *starts, const rw_time *ends, size_t flights)
{
    for (size_t k = 0; k < flights; k++)
        if (time >= starts[k] && time < ends[k])
            return true;
    return false;
}

static bool every_output_moves(rw_log *log, const rw_time *starts, const rw_time *ends, size_t flights)
{
    const rw_series *s = &log->series[RW_OUTPUTS];
    double low[RW_ROTORS], high[RW_ROTORS];
    const double least = RW_STILL * (log->vehicle.output_high - log->vehicle.output_low);
    size_t rows = 0, move = 0, still = s->width;
    for (size_t k = 0; k < s->width; k++)
        low[k] = INFINITY, high[k] = -INFINITY;
    for (size_t i = 0; i < s->n; i++) {
        if (!in_the_air(s->time[i], starts, ends, flights))
            continue;
        rows++;
        for (size_t k = 0; k < s->width; k++) {
            low[k] = fmin(low[k], s->value[i * s->width + k]); /* fmin passes over NaN */
            high[k] = fmax(high[k], s->value[i * s->width + k]);
        }
    }
    for (size_t k = 0; k < s->width; k++)
        if (high[k] - low[k] > least)
            move++;
        else
            still = k;
    if (rows < RW_WINDOW_LEAST * RW_LEAST_WINDOWS || move == s->width || move < 2)
        return true;
    return rw_refuse(log, "motor output %d never moves in flight while the others do: this log does not show what drove these motors", (int)still + 1);
}

/* Angle that the vehicle turned through, back and forth counted alike [rad]. */
static double turned(const rw_series *gyro, rw_time start, rw_time end)
{
    double angle = 0.0, before = 0.0;
    rw_time last = end;
    for (size_t i = 0; i < gyro->n; i++) {
        const double *x = &gyro->value[3 * i], rate = rw_whole(gyro, i) ? sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2]) : 0.0;
        if (gyro->time[i] < start || gyro->time[i] >= end)
            continue;
        angle += fmax(gyro->time[i] - last, 0.0) * (rate + before) / 2.0;
        last = gyro->time[i], before = rate;
    }
    return angle;
}

/* Whether outputs that stand still for a while do so while the vehicle does not turn: else something else drove the motors. */
static bool rest_in_calm(rw_log *log, const rw_time *starts, const rw_time *ends, size_t flights)
{
    const rw_series *s = &log->series[RW_OUTPUTS];
    const double range = log->vehicle.u_max - log->vehicle.u_min;
    size_t first = s->n, last = s->n, samples = 0;
    for (size_t i = 0; i <= s->n; i++) {
        bool moved = i == s->n || first == s->n;
        size_t inner = 0;
        if (i < s->n && (!rw_whole(s, i) || !in_the_air(s->time[i], starts, ends, flights)))
            continue;
        for (size_t k = 0; k < s->width && !moved; k++)
            moved = fabs(s->value[i * s->width + k] - s->value[last * s->width + k]) > 1e-6 * range;
        if (moved && first < s->n) {
            const double seconds = s->time[last] - s->time[first];
            for (size_t k = 0; k < s->width; k++) { /* motors that are off, or all at their limits, may rest */
                const double u = s->value[first * s->width + k];
                inner += u > log->vehicle.u_min + 0.02 * range && u < log->vehicle.u_max - 0.02 * range;
            }
            if (samples >= 5 && seconds >= RW_STILL_S && 2 * inner > s->width) {
                const double angle = turned(&log->series[RW_GYRO], s->time[first], s->time[last]);
                const bool lasts = seconds > RW_STILL_LONG_S && samples > RW_STILL_SAMPLES && angle > RW_STILL_LONG_RAD;
                if (angle > RW_STILL_RAD || lasts)
                    return rw_refuse(log, "the motor outputs do not change from %.1f to %.1f s while the vehicle turns: they did not drive the motors", s->time[first], s->time[last]);
            }
        }
        if (moved)
            first = i, samples = 0;
        last = i;
        samples++;
    }
    return true;
}

/* cost[k][j] of each window, as of `Mixing.costs`; NaN in windows that say nothing. */
typedef struct {
    double cost[RW_ROTORS][RW_ROTORS];
} window;

/* The costs of one window of m rows: y: thrusts of its outputs, d: what the mixer's rows demand, both (m, n). */
static void costs(double *y, double *d, size_t m, size_t n, bool trim, window *out)
{
    double of_y[RW_ROTORS] = {0}, of_d[RW_ROTORS] = {0}, power_y = 0.0, power_d = 0.0, gain;
    for (size_t i = 0; i < m; i++) {
        double mean_y = 0.0, mean_d = 0.0;
        for (size_t k = 0; k < n; k++)
            mean_y += y[i * n + k] / (double)n, mean_d += d[i * n + k] / (double)n;
        for (size_t k = 0; k < n; k++)
            y[i * n + k] -= mean_y, d[i * n + k] -= mean_d;
    }
    for (size_t k = 0; k < n && !trim; k++) {
        double mean_y = 0.0, mean_d = 0.0;
        for (size_t i = 0; i < m; i++)
            mean_y += y[i * n + k] / (double)m, mean_d += d[i * n + k] / (double)m;
        for (size_t i = 0; i < m; i++)
            y[i * n + k] -= mean_y, d[i * n + k] -= mean_d;
    }
    for (size_t k = 0; k < n; k++) {
        for (size_t i = 0; i < m; i++)
            of_y[k] += y[i * n + k] * y[i * n + k], of_d[k] += d[i * n + k] * d[i * n + k];
        power_y += of_y[k], power_d += of_d[k];
    }
    const double cells = (double)(m * n);
    const bool seen = m >= RW_WINDOW_LEAST && power_y > cells * RW_SEEN * RW_SEEN && power_d > cells * RW_ROUNDED * RW_ROUNDED;
    gain = seen ? sqrt(power_y / power_d) : 0.0;
    for (size_t k = 0; k < n; k++)
        for (size_t j = 0; j < n; j++) {
            double both = 0.0;
            for (size_t i = 0; i < m; i++)
                both += y[i * n + k] * d[i * n + j];
            out->cost[k][j] = seen ? (of_y[k] + gain * gain * of_d[j] - 2.0 * gain * both) / fmax(fmax(of_y[k], 0.1 * power_y / (double)n), 1e-12) : (double)NAN;
        }
}

/* A row of the mixer for each output, all different, for which no exchange of two lowers the sum of costs (`mixing._assigned`). */
static void assign(double cost[RW_ROTORS][RW_ROTORS], size_t n, size_t *rows)
{
    bool taken[RW_ROTORS] = {false};
    for (size_t k = 0; k < n; k++)
        cost[k][k] -= RW_OWN, rows[k] = n; /* rotors with equal commands keep their places */
    for (size_t turn = 0; turn < n; turn++) { /* the most probable first */
        size_t best = n, row = n;
        for (size_t k = 0; k < n; k++)
            for (size_t j = 0; j < n; j++)
                if (rows[k] == n && !taken[j] && (best == n || cost[k][j] < cost[best][row]))
                    best = k, row = j;
        rows[best] = row;
        taken[row] = true;
    }
    for (;;) {
        double most = -1e-9;
        size_t a = n, b = n;
        for (size_t i = 0; i < n; i++)
            for (size_t j = 0; j < n; j++) {
                const double change = cost[i][rows[j]] + cost[j][rows[i]] - cost[i][rows[i]] - cost[j][rows[j]];
                if (change < most)
                    most = change, a = i, b = j;
            }
        if (a == n)
            return;
        const size_t row = rows[a];
        rows[a] = rows[b], rows[b] = row;
    }
}

/* Whether the windows agree that outputs follow other rows of the mixer than their own. */
static bool another_order(const window *all, size_t count, size_t n, size_t *rows)
{
    double total[RW_ROTORS][RW_ROTORS] = {{0}};
    bool moved = false;
    if (count < RW_LEAST_WINDOWS)
        return false;
    for (size_t w = 0; w < count; w++)
        for (size_t k = 0; k < n; k++)
            for (size_t j = 0; j < n; j++)
                total[k][j] += log(fmax(all[w].cost[k][j], RW_EXACT));
    assign(total, n, rows);
    for (size_t k = 0; k < n; k++) {
        size_t votes = 0, tells = 0;
        for (size_t w = 0; w < count && rows[k] != k; w++) {
            const double gain = log(fmax(all[w].cost[k][k], RW_EXACT)) - log(fmax(all[w].cost[k][rows[k]], RW_EXACT));
            const bool says = fabs(gain) > log(RW_BETTER);
            tells += says;
            votes += says && gain > 0.0 && all[w].cost[k][rows[k]] < RW_FOLLOWS;
        }
        if (rows[k] != k && (double)votes < fmax(RW_LEAST_WINDOWS, RW_NEARLY_ALL * (double)tells))
            return false;
        moved = moved || rows[k] != k;
    }
    return moved;
}

bool rw_outputs_flew(rw_log *log, const rw_time *starts, const rw_time *ends, size_t flights)
{
    const rw_series *s = &log->series[RW_OUTPUTS], *c = &log->series[RW_CONTROL], *v = &log->series[RW_VOLTAGE];
    const rw_vehicle *vehicle = &log->vehicle;
    const size_t n = s->width, kept = log->block_count;
    const double hz = rw_rate_hz(log, s);
    const size_t every = hz > RW_MIXING_HZ ? (size_t)(hz / RW_MIXING_HZ) : 1;
    size_t *whole = rw_reserve(log, c->n, sizeof *whole), wholes = 0, rows = 0, order[RW_ROTORS];
    double *y = rw_reserve(log, s->n * n, sizeof *y), *d = rw_reserve(log, s->n * n, sizeof *d), *time = rw_reserve(log, s->n, sizeof *time);
    double *part = rw_reserve(log, s->n * n, sizeof *part), *asked = rw_reserve(log, s->n * n, sizeof *asked);
    bool *paired = rw_reserve(log, s->n, sizeof *paired), found = false;
    window *all;
    if (!every_output_moves(log, starts, ends, flights) || !rest_in_calm(log, starts, ends, flights) || !whole || !y || !d || !time || !part || !asked || !paired)
        return false;
    for (size_t i = 0; i < c->n; i++)
        if (rw_whole(c, i))
            whole[wholes++] = i;
    for (size_t i = 0, after = 0, lift = 0; vehicle->mixer_known && wholes > 1 && i < s->n; i += every) {
        double ratio = 1.0, demand[4];
        bool free = rw_whole(s, i) && in_the_air(s->time[i], starts, ends, flights);
        while (lift < v->n && v->time[lift] <= s->time[i])
            lift++;
        ratio = lift ? v->value[lift - 1] : 1.0;
        for (size_t k = 0; k < n && free; k++) {
            const double share = (s->value[i * n + k] - vehicle->u_min) / (vehicle->u_max - vehicle->u_min);
            const double a = fmin(fmax(share, 0.0), 1.0) * ratio, f = (1.0 - vehicle->mixer_expo) * a + vehicle->mixer_expo * a * a;
            free = f > RW_LIMIT && f < (1.0 - RW_LIMIT) * fmax(ratio, 1e-3);
            y[rows * n + k] = f;
        }
        if (!free)
            continue;
        while (after < wholes && c->time[whole[after]] < s->time[i])
            after++;
        const size_t b = after < 1 ? 1 : after > wholes - 1 ? wholes - 1 : after, first = whole[b - 1], last = whole[b];
        const double gap = c->time[last] - c->time[first];
        const double share = gap > 0.0 ? fmin(fmax((s->time[i] - c->time[first]) / gap, 0.0), 1.0) : 1.0;
        paired[rows] = fabs(s->time[i] - c->time[first]) < RW_PAIR_S && fabs(c->time[last] - s->time[i]) < RW_PAIR_S;
        for (size_t r = 0; r < 4; r++)
            demand[r] = c->value[4 * first + r] + share * (c->value[4 * last + r] - c->value[4 * first + r]);
        for (size_t k = 0; k < n; k++) {
            d[rows * n + k] = 0.0;
            for (size_t r = 0; r < 4; r++)
                d[rows * n + k] += vehicle->mixer[k][r] * demand[r];
        }
        time[rows++] = s->time[i];
    }
    all = rw_reserve(log, rows ? (size_t)((time[rows - 1] - time[0]) / RW_WINDOW_S) + 3 : 1, sizeof *all);
    if (!all)
        return false;
    for (int trim = 1; trim >= 0 && !found && rows >= RW_WINDOW_LEAST * RW_LEAST_WINDOWS; trim--) {
        size_t count = 0;
        for (size_t i = 0; i < rows;) {
            size_t m = 0;
            const double here = floor(time[i] / RW_WINDOW_S);
            for (; i < rows && floor(time[i] / RW_WINDOW_S) == here; i++)
                if (paired[i]) {
                    memcpy(&part[m * n], &y[i * n], n * sizeof *part);
                    memcpy(&asked[m++ * n], &d[i * n], n * sizeof *asked);
                }
            costs(part, asked, m, n, trim, &all[count]);
            count += !isnan(all[count].cost[0][0]);
        }
        found = another_order(all, count, n, order);
    }
    rw_release(log, kept);
    for (size_t k = 0; found && k < n; k++)
        if (order[k] != k)
            return rw_refuse(log, "the motor outputs are not in the frame's order: output %d follows the rate controller as motor %d", (int)k + 1, (int)order[k] + 1);
    return true;
}
