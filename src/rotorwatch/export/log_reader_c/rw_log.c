/* What both readers share: memory, parameters, series of samples and their medians. */
#include "rw_log.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define DAY_S 86400.0 /* a longer gap is a damaged time stamp */

bool rw_refuse(rw_log *log, const char *sentence, ...)
{
    va_list arguments;
    if (log->why[0])
        return false; /* the first cause */
    va_start(arguments, sentence);
    vsnprintf(log->why, sizeof log->why, sentence, arguments);
    va_end(arguments);
    return false;
}

void *rw_reserve(rw_log *log, size_t count, size_t size)
{
    void *block;
    if (log->block_count == log->block_room) {
        const size_t room = 2 * log->block_room + 64;
        void **blocks = realloc(log->blocks, room * sizeof *blocks);
        if (!blocks) {
            rw_refuse(log, "there is not enough memory for this log");
            return NULL;
        }
        log->blocks = blocks;
        log->block_room = room;
    }
    block = calloc(count ? count : 1, size);
    if (!block) {
        rw_refuse(log, "there is not enough memory for this log");
        return NULL;
    }
    return log->blocks[log->block_count++] = block;
}

void rw_release(rw_log *log, size_t kept)
{
    while (log->block_count > kept)
        free(log->blocks[--log->block_count]);
}

void rw_log_close(rw_log *log)
{
    rw_release(log, 0);
    free(log->blocks);
}

double rw_parameter_of(const rw_log *log, const char *name, double otherwise)
{
    for (size_t k = 0; k < log->parameter_count; k++)
        if (!strcmp(log->parameters[k].name, name))
            return log->parameters[k].value;
    return otherwise;
}

bool rw_parameter_add(rw_log *log, const char *name, size_t length, double value)
{
    rw_parameter *one;
    /* The simulator's own may say which rotor fails; no autopilot has longer names, and damaged logs hold other numbers. */
    if (length < 2 || length >= sizeof one->name || !strncmp(name, "SIM_", 4) || !(fabs(value) < 1e9))
        return true;
    if (!(log->parameter_count & (log->parameter_count - 1)) && (log->parameter_count >= 64 || !log->parameter_count)) {
        rw_parameter *more = rw_reserve(log, log->parameter_count ? 2 * log->parameter_count : 64, sizeof *more);
        if (!more)
            return false;
        if (log->parameter_count)
            memcpy(more, log->parameters, log->parameter_count * sizeof *more);
        log->parameters = more;
    }
    one = &log->parameters[log->parameter_count++];
    memcpy(one->name, name, length);
    one->name[length] = 0;
    one->value = value;
    return true;
}

bool rw_series_new(rw_log *log, rw_series *s, size_t n, size_t width)
{
    s->n = n;
    s->width = width;
    s->time = rw_reserve(log, n, sizeof *s->time);
    s->value = rw_reserve(log, n * width, sizeof *s->value);
    if (!s->time || !s->value) {
        s->n = 0;
        return false;
    }
    return true;
}

bool rw_whole(const rw_series *s, size_t row)
{
    for (size_t k = 0; k < s->width; k++)
        if (isnan(s->value[row * s->width + k]))
            return false;
    return true;
}

/* The k-th smallest of x (n,), k < n; reorders x. */
static double ranked(double *x, size_t n, size_t k)
{
    size_t low = 0, high = n - 1;
    while (low < high) {
        const double pivot = x[low + (high - low) / 2];
        size_t i = low, j = high;
        for (;;) {
            while (x[i] < pivot)
                i++;
            while (pivot < x[j])
                j--;
            if (i >= j)
                break;
            const double swapped = x[i];
            x[i++] = x[j];
            x[j--] = swapped;
        }
        if (k <= j)
            high = j;
        else
            low = j + 1;
    }
    return x[k];
}

double rw_ranked(rw_log *log, const double *x, size_t n, size_t k)
{
    const size_t kept = log->block_count;
    double *copy, found;
    if (k >= n || !(copy = rw_reserve(log, n, sizeof *copy)))
        return NAN;
    memcpy(copy, x, n * sizeof *copy);
    found = ranked(copy, n, k);
    rw_release(log, kept);
    return found;
}

double rw_quantile(rw_log *log, const double *x, size_t n, double share)
{
    const double place = (double)(n - 1) * share;
    const size_t low = n ? (size_t)place : 0;
    const double a = rw_ranked(log, x, n, low), part = place - (double)low, b = low + 1 < n ? rw_ranked(log, x, n, low + 1) : a;
    return part < 0.5 ? a + (b - a) * part : b - (b - a) * (1.0 - part);
}

double rw_median(rw_log *log, const double *x, size_t n)
{
    const double middle = rw_ranked(log, x, n, n / 2);
    return n % 2 || !n ? middle : (rw_ranked(log, x, n, n / 2 - 1) + middle) / 2;
}

double rw_rate_hz(rw_log *log, const rw_series *s)
{
    const size_t kept = log->block_count;
    double *steps, step;
    if (s->n < 2 || !(steps = rw_reserve(log, s->n - 1, sizeof *steps)))
        return 0.0;
    for (size_t i = 0; i + 1 < s->n; i++)
        steps[i] = s->time[i + 1] - s->time[i];
    step = rw_median(log, steps, s->n - 1);
    rw_release(log, kept);
    return step > 0.0 ? 1.0 / step : 0.0;
}

bool rw_series_settle(rw_log *log, rw_series *s, double limit)
{
    for (size_t i = 0; i < s->n * s->width; i++)
        if (!(fabs(s->value[i]) <= limit))
            s->value[i] = NAN;
    for (size_t i = 0; i < s->n; i++)
        if (!isfinite(s->time[i]) || (i && !(s->time[i] >= s->time[i - 1] && s->time[i] - s->time[i - 1] <= DAY_S)))
            return rw_refuse(log, "the times of this log are damaged; rotorwatch diagnose reads around damage");
    return true;
}

void rw_eigen(int n, double *a, double *vector)
{
    for (int k = 0; k < n * n; k++)
        vector[k] = k % (n + 1) ? 0.0 : 1.0;
    for (int turn = 0; turn < 12; turn++) /* Jacobi's rotations */
        for (int p = 0; p < n; p++)
            for (int q = p + 1; q < n; q++) {
                double angle, c, s;
                if (a[p * n + q] == 0.0)
                    continue;
                angle = 0.5 * atan2(2.0 * a[p * n + q], a[q * n + q] - a[p * n + p]);
                c = cos(angle), s = sin(angle);
                for (int k = 0; k < n; k++) {
                    const double x = a[k * n + p], y = a[k * n + q];
                    a[k * n + p] = c * x - s * y, a[k * n + q] = s * x + c * y;
                }
                for (int k = 0; k < n; k++) {
                    const double x = a[p * n + k], y = a[q * n + k], v = vector[p * n + k], w = vector[q * n + k];
                    a[p * n + k] = c * x - s * y, a[q * n + k] = s * x + c * y;
                    vector[p * n + k] = c * v - s * w, vector[q * n + k] = s * v + c * w;
                }
            }
}
