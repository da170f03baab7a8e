/* ArduPilot's DataFlash logs in their binary form: records to signals, as logs/dataflash.py and its parts read them. A record is A3 95, a
   type number and the fields that the type's FMT record names, packed and little-endian. */
#include "rw_log.h"

#include "rw_tables.h"

#include <ctype.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define FMT 128
#define FMT_LENGTH 89
#define NEAR_START 512 /* bytes that a ground station may have put before the first record */
#define MOST_WIDTH 16
#define STEP_BACK_US 0.5e6 /* larger steps back are not due to the order of records */
#define DAY_US 86400e6
#define EDGE_RECORDS 5 /* up to so many beyond a gap at an end of the log are damaged */
#define SMALL_STEP_S 0.005
#define ENOUGH 20000 /* records, spread over the log, to determine the unit of a column */

typedef struct {
    bool known;
    uint8_t length;
    char name[5], codes[17], columns[65];
    size_t count; /* of its records */
} format;

typedef struct {
    rw_log *log;
    format formats[256];
    size_t *at; /* places of the records */
    size_t count;
    double start, stop; /* us of the first and the last */
    int outputs[RW_ROTORS], rotors; /* servo output of each rotor, from 1 */
    char announced[2][24]; /* "QUAD", "X": the frame that the firmware names */
} dataflash;

static size_t size_of(char code)
{
    static const char codes[] = "bBhHiIqQgfdnNZMcCeELa";
    static const uint8_t sizes[] = {1, 1, 2, 2, 4, 4, 8, 8, 2, 4, 8, 4, 16, 64, 1, 2, 2, 4, 4, 4, 64};
    const char *found = code ? strchr(codes, code) : NULL;
    return found ? sizes[found - codes] : 0;
}

static uint64_t number(const uint8_t *p, size_t bytes)
{
    uint64_t value = 0;
    for (size_t k = 0; k < bytes; k++)
        value |= (uint64_t)p[k] << (8 * k);
    return value;
}

static double value_of(const uint8_t *p, char code)
{
    const uint64_t raw = number(p, size_of(code) > 8 ? 0 : size_of(code));
    float real;
    double wide;
    uint32_t bits = (uint32_t)raw;
    switch (code) {
    case 'b': return (double)(int8_t)raw;
    case 'B': case 'M': return (double)raw;
    case 'h': return (double)(int16_t)raw;
    case 'H': return (double)raw;
    case 'c': return (double)(int16_t)raw / 1e2;
    case 'C': return (double)raw / 1e2;
    case 'i': return (double)(int32_t)raw;
    case 'I': return (double)raw;
    case 'e': return (double)(int32_t)raw / 1e2;
    case 'E': return (double)raw / 1e2;
    case 'L': return (double)(int32_t)raw / 1e7;
    case 'q': return (double)(int64_t)raw;
    case 'Q': return (double)raw;
    case 'f': memcpy(&real, &bits, 4); return (double)real;
    case 'd': memcpy(&wide, &raw, 8); return wide;
    case 'g': /* half precision */
        wide = ldexp((double)((raw & 1023) + (raw >> 10 & 31 ? 1024 : 0)), (int)(raw >> 10 & 31 ? raw >> 10 & 31 : 1) - 25);
        return (raw >> 10 & 31) == 31 ? (double)NAN : raw >> 15 ? -wide : wide;
    default: return NAN;
    }
}

/* Place of a column in a record and its code; false where the format lacks it. */
static bool find(const format *f, const char *wanted, size_t *offset, char *code)
{
    const char *name = f->columns;
    const size_t length = strlen(wanted);
    *offset = 3;
    for (size_t k = 0; f->codes[k]; k++) {
        const char *comma = strchr(name, ',');
        size_t given = comma ? (size_t)(comma - name) : strlen(name);
        while (given && *name == ' ')
            name++, given--;
        if (given == length && !memcmp(name, wanted, length)) {
            *code = f->codes[k];
            return true;
        }
        *offset += size_of(f->codes[k]);
        name = comma ? comma + 1 : "";
    }
    return false;
}

static void text_of(char *out, const uint8_t *p, size_t size)
{
    memcpy(out, p, size);
    out[size] = 0;
}

/* A definition from a FMT record; false for one that contradicts itself. */
static bool define(dataflash *d, const uint8_t *record)
{
    format f = {true, record[4], "", "", "", 0}, *known = &d->formats[record[3]];
    size_t size = 3;
    text_of(f.name, record + 5, 4);
    text_of(f.codes, record + 9, 16);
    text_of(f.columns, record + 25, 64);
    for (size_t k = 0; f.codes[k]; k++) {
        if (!size_of(f.codes[k]))
            return false;
        size += size_of(f.codes[k]);
    }
    if (!f.name[0] || f.length < size)
        return false;
    if (known->known && (strcmp(known->name, f.name) || strcmp(known->codes, f.codes) || known->length != f.length))
        return false; /* several logs in one, or damage */
    f.count = known->count;
    *known = f;
    return true;
}

/* All records of the log, in the order of the file. */
static bool index_records(dataflash *d)
{
    rw_log *log = d->log;
    const uint8_t *data = log->data;
    size_t at = 0, tail = log->size, room = 0;
    static const char DAMAGED[] = "this log is damaged at byte %lu; rotorwatch diagnose reads around damage";
    while (tail && !data[tail - 1])
        tail--; /* logs may end in empty pages */
    while (at + FMT_LENGTH <= log->size && at < NEAR_START && !(data[at] == 0xA3 && data[at + 1] == 0x95 && data[at + 2] == FMT))
        at++;
    if (at + FMT_LENGTH > log->size || at >= NEAR_START)
        return rw_refuse(log, "this is neither a ULog nor a binary DataFlash log");
    d->formats[FMT] = (format){true, FMT_LENGTH, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns", 0};
    for (int turn = 0; turn < 2; turn++) { /* count, then list */
        if (turn && !(d->at = rw_reserve(log, room, sizeof *d->at)))
            return false;
        for (size_t from = at; from + 3 <= log->size; from += d->formats[data[from + 2]].length) {
            const format *f = &d->formats[data[from + 2]];
            if (data[from] != 0xA3 || data[from + 1] != 0x95 || !f->known) {
                if (from >= tail)
                    break;
                return rw_refuse(log, DAMAGED, (unsigned long)from);
            }
            if (from + f->length > log->size) {
                log->warned_cut = true;
                break;
            }
            if (turn)
                d->at[d->count++] = from;
            else {
                room++;
                if (data[from + 2] == FMT && !define(d, data + from))
                    return rw_refuse(log, DAMAGED, (unsigned long)from);
                d->formats[data[from + 2]].count++;
            }
        }
    }
    return true;
}

/* Boot time of a record [us]; NaN where it has none. */
static double stamp(const dataflash *d, const uint8_t *record)
{
    const format *f = &d->formats[record[2]];
    const double scale = !strncmp(f->columns, "TimeUS", 6) ? 1.0 : !strncmp(f->columns, "TimeMS", 6) ? 1e3 : 0.0;
    return scale > 0.0 && strchr("QIqi", f->codes[0]) ? scale * value_of(record + 3, f->codes[0]) : (double)NAN;
}

/* Whether a gap next to a few stamps at an end of the log is rather damage: `wrong_gap` of logs/series.py. */
static bool wrong_gap(double gap_s)
{
    static const double UNITS[] = {1e-6, 1e-3}, DIGITS[] = {1, 2, 4, 8, 10};
    if (!(gap_s > 4.0))
        return false;
    for (size_t k = 0; k < 2; k++)
        if (fabs(gap_s - UNITS[k] * exp2(rint(log2(gap_s / UNITS[k])))) < 0.2)
            return true;
    for (size_t k = 0; k < 5; k++)
        if (fabs(gap_s - pow(10.0, floor(log10(gap_s) + 1e-3)) * DIGITS[k]) < 0.2)
            return true;
    return gap_s > 600.0;
}

/* First and last time, without a few records beyond a gap at either end, and whether the clock is steady between. */
static bool clock_of(dataflash *d)
{
    double *us = rw_reserve(d->log, d->count, sizeof *us);
    size_t n = 0, first = 0, last;
    for (size_t k = 0; us && k < d->count; k++) {
        us[n] = stamp(d, d->log->data + d->at[k]);
        n += !isnan(us[n]);
    }
    if (!us)
        return false;
    if (!n)
        return rw_refuse(d->log, "this log has no times, as ArduCopter 3.1 and before wrote it; rotorwatch diagnose rebuilds them");
    last = n - 1;
    for (size_t k = 0; k < EDGE_RECORDS && k + 1 < n; k++) {
        if (wrong_gap((us[k + 1] - us[k]) * 1e-6))
            first = k + 1;
        if (wrong_gap((us[n - 1 - k] - us[n - 2 - k]) * 1e-6))
            last = n - 2 - k;
    }
    d->start = d->stop = us[first];
    for (size_t k = first; k < n && k <= last; k++) {
        if (k > first && (us[k] < us[k - 1] - STEP_BACK_US || us[k] > us[k - 1] + DAY_US))
            return rw_refuse(d->log, "the clock of this log jumps; rotorwatch diagnose corrects that");
        d->start = fmin(d->start, us[k]);
        d->stop = fmax(d->stop, us[k]);
    }
    d->log->end = (d->stop - d->start) / 1e6;
    return true;
}

static const format *named(const dataflash *d, const char *name)
{
    for (size_t k = 0; k < 256; k++)
        if (d->formats[k].known && d->formats[k].count && !strcmp(d->formats[k].name, name))
            return &d->formats[k];
    return NULL;
}

static bool has(const dataflash *d, const char *message, const char *column)
{
    const format *f = named(d, message);
    size_t offset;
    char code;
    return f && find(f, column, &offset, &code);
}

/* Samples in the order of time: small steps back are records out of order; more is damage. */
static bool ordered(rw_log *log, rw_series *s)
{
    double moved[MOST_WIDTH];
    for (size_t i = 1; i < s->n; i++) {
        const double time = s->time[i];
        size_t to = i;
        if (!(time < s->time[i - 1]))
            continue;
        if (s->time[i - 1] - time > SMALL_STEP_S)
            return rw_refuse(log, "the times of this log are damaged; rotorwatch diagnose reads around damage");
        memcpy(moved, &s->value[i * s->width], s->width * sizeof *moved);
        while (to && s->time[to - 1] > time) {
            s->time[to] = s->time[to - 1];
            memcpy(&s->value[to * s->width], &s->value[(to - 1) * s->width], s->width * sizeof *moved);
            to--;
        }
        s->time[to] = time;
        memcpy(&s->value[to * s->width], moved, s->width * sizeof *moved);
    }
    return true;
}

/* Columns of a message as a series, those that it lacks NaN; instance: column and number, -1: all records. False without any. */
static bool rows(dataflash *d, const char *message, const char *const *columns, size_t width, const char *instance, int chosen, rw_series *out)
{
    const format *f = named(d, message);
    size_t offset[MOST_WIDTH], of_instance = 0;
    char code[MOST_WIDTH], instance_code = 0;
    double us = d->start;
    bool any = false;
    out->n = 0;
    if (!f)
        return false;
    for (size_t k = 0; k < width; k++) {
        if (!find(f, columns[k], &offset[k], &code[k]))
            code[k] = 0;
        any = any || code[k];
    }
    if (!any || (chosen >= 0 && !find(f, instance, &of_instance, &instance_code)) || !rw_series_new(d->log, out, f->count, width))
        return false;
    out->n = 0;
    for (size_t i = 0; i < d->count; i++) {
        const uint8_t *record = d->log->data + d->at[i];
        const double own = stamp(d, record);
        us = isnan(own) ? us : own; /* those without a time have that of the one before */
        if (&d->formats[record[2]] != f || (chosen >= 0 && value_of(record + of_instance, instance_code) != chosen))
            continue;
        if (us < d->start || us > d->stop)
            continue;
        out->time[out->n] = (us - d->start) / 1e6;
        for (size_t k = 0; k < width; k++)
            out->value[out->n * width + k] = code[k] ? value_of(record + offset[k], code[k]) : (double)NAN;
        out->n++;
    }
    return out->n && ordered(d->log, out);
}

/* The same of sensor instance 0, or of the one with most records where there is no 0. */
static bool instance_rows(dataflash *d, const char *message, const char *const *columns, size_t width, rw_series *out)
{
    static const char *const NAMES[] = {"I", "Instance", "Inst", "IMU", "C"};
    const char *name = NULL;
    size_t counts[256] = {0}, best = 0;
    rw_series numbers;
    for (size_t k = 0; k < 5 && !name; k++)
        name = has(d, message, NAMES[k]) ? NAMES[k] : NULL;
    if (!name)
        return rows(d, message, columns, width, NULL, -1, out);
    if (rows(d, message, columns, width, name, 0, out) || d->log->why[0])
        return !d->log->why[0];
    if (!rows(d, message, &name, 1, NULL, -1, &numbers))
        return false;
    for (size_t i = 0; i < numbers.n; i++)
        if (numbers.value[i] >= 0.0 && numbers.value[i] < 256.0)
            counts[(size_t)numbers.value[i]]++;
    for (size_t k = 1; k < 256; k++)
        best = counts[k] > counts[best] ? k : best;
    return rows(d, message, columns, width, name, (int)best, out);
}

/* Values out of (low, high) of their column become unknown. */
static void within(rw_series *s, const double (*limits)[2])
{
    for (size_t i = 0; i < s->n * s->width; i++)
        if (!(s->value[i] >= limits[i % s->width][0] && s->value[i] <= limits[i % s->width][1]))
            s->value[i] = NAN;
}

/* 99th percentile of the magnitudes of columns `first` to `last` in some rows. */
static double peak(rw_log *log, const rw_series *s, size_t first, size_t last, double share)
{
    const size_t every = s->n / ENOUGH > 1 ? s->n / ENOUGH : 1;
    double *sizes = rw_reserve(log, s->n * (last - first + 1), sizeof *sizes);
    size_t n = 0;
    for (size_t i = 0; sizes && i < s->n; i += every)
        for (size_t k = first; k <= last; k++)
            if (isfinite(s->value[i * s->width + k]))
                sizes[n++] = fabs(s->value[i * s->width + k]);
    return n ? rw_quantile(log, sizes, n, share) : 0.0;
}

/* Whether controller outputs are in units of RW_RAW_TORQUE for full output, as up to 3.3, by the differences of the motors that they cause. */
static bool control_is_raw(rw_log *log, const rw_series *control)
{
    const rw_series *motors = &log->series[RW_OUTPUTS];
    const size_t every = control->n / ENOUGH > 1 ? control->n / ENOUGH : 1;
    double *moved = rw_reserve(log, (control->n / every + 1) * motors->width, sizeof *moved), *asked = rw_reserve(log, (control->n / every + 1) * 3, sizeof *asked);
    size_t n = 0, m = 0, at = 0;
    if (!moved || !asked)
        return false;
    for (size_t i = 0; i < control->n && motors->n >= 10 && control->n >= 10; i += every) {
        const double *c = &control->value[i * control->width], *x;
        double mean = 0.0;
        while (at < motors->n - 1 && motors->time[at] < control->time[i])
            at++;
        if (fabs(motors->time[at] - control->time[i]) >= 0.3 || !rw_whole(motors, at) || !isfinite(c[0]) || !isfinite(c[1]) || !isfinite(c[2]))
            continue;
        x = &motors->value[at * motors->width];
        for (size_t k = 0; k < motors->width; k++)
            mean += x[k] / (double)motors->width;
        for (size_t k = 0; k < motors->width; k++)
            moved[n++] = fabs(x[k] - mean) / (RW_PULSE_MOST_US - RW_PULSE_LEAST_US);
        for (size_t k = 0; k < 3; k++)
            asked[m++] = fabs(c[k]);
    }
    if (n) {
        const double differs = rw_quantile(log, moved, n, 0.8), output = rw_quantile(log, asked, m, 0.8);
        if (differs > 5e-4 && output > 0.0)
            return output > 2.0 * sqrt(RW_RAW_TORQUE) * differs;
    }
    return peak(log, control, 0, 2, 0.99) > sqrt(RW_RAW_TORQUE);
}

/* Angular rates of the rate controller: degrees, up to 3.3 hundredths of them, by the gyro's rates where the vehicle turns fastest. */
static void rates(dataflash *d, bool hundredths)
{
    static const char *const COLUMNS[] = {"R", "P", "Y"};
    static const double TURN[][2] = {{-80, 80}, {-80, 80}, {-80, 80}};
    rw_log *log = d->log;
    rw_series *s = &log->series[RW_RATES];
    const rw_series *gyro = &log->series[RW_GYRO];
    double *ours, *theirs;
    size_t n = 0, at = 0, fast = 0;
    if (!rows(d, "RATE", COLUMNS, 3, NULL, -1, s))
        return;
    const size_t every = s->n / ENOUGH > 1 ? s->n / ENOUGH : 1;
    ours = rw_reserve(log, 3 * (s->n / every + 1), sizeof *ours), theirs = rw_reserve(log, 3 * (s->n / every + 1), sizeof *theirs);
    for (size_t i = 0; i < 3 * s->n; i++)
        s->value[i] *= RW_PI / 180.0;
    for (size_t i = 0; ours && theirs && gyro->n >= 10 && s->n >= 10 && i < s->n; i += every) {
        while (at < gyro->n - 1 && gyro->time[at] < s->time[i])
            at++;
        if (fabs(gyro->time[at] - s->time[i]) < 0.1 && rw_whole(gyro, at) && rw_whole(s, i))
            for (size_t k = 0; k < 3; k++, n++)
                ours[n] = fabs(s->value[3 * i + k]), theirs[n] = fabs(gyro->value[3 * at + k]);
    }
    if (n >= 30) {
        const double least = rw_quantile(log, theirs, n, 0.9);
        for (size_t i = 0; i < n; i++)
            if (theirs[i] >= least)
                ours[fast] = ours[i], theirs[fast++] = theirs[i];
        hundredths = rw_median(log, ours, fast) > 10.0 * rw_median(log, theirs, fast);
    }
    for (size_t i = 0; hundredths && i < 3 * s->n; i++)
        s->value[i] /= 100.0;
    within(s, TURN);
}

static void control(dataflash *d)
{
    static const char *const COLUMNS[] = {"ROut", "POut", "YOut", "AOut"};
    static const double LIMITS[][2] = {{-10.0, 10.0}, {-10.0, 10.0}, {-10.0, 10.0}, {-0.5, 1.6}};
    rw_series *s = &d->log->series[RW_CONTROL];
    if (!rows(d, "RATE", COLUMNS, 4, NULL, -1, s))
        return;
    const double torque = control_is_raw(d->log, s) ? RW_RAW_TORQUE : 1.0, throttle = peak(d->log, s, 3, 3, 0.99) > 2.0 ? RW_RAW_THROTTLE : 1.0;
    for (size_t i = 0; i < s->n * 4; i++)
        s->value[i] /= i % 4 < 3 ? torque : throttle;
    within(s, LIMITS);
    rates(d, torque > 1.0);
}

static void motion(dataflash *d)
{
    static const char *const IMU[] = {"GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ"}, *const V[] = {"VN", "VE", "VD"}, *const P[] = {"PN", "PE", "PD"};
    static const char *const ANGLES[] = {"Roll", "Pitch", "Yaw"}, *const LIFT[] = {"BatVolt"};
    static const double TURN[][2] = {{-80, 80}, {-80, 80}, {-80, 80}}, FORCE[][2] = {{-640, 640}, {-640, 640}, {-640, 640}};
    static const double SPEED[][2] = {{-150, 150}, {-150, 150}, {-150, 150}}, PLACE[][2] = {{-1e5, 1e5}, {-1e5, 1e5}, {-1e5, 1e5}};
    rw_series imu, degrees, *s = d->log->series;
    double before[4] = {1.0, 0.0, 0.0, 0.0};
    const char *message = named(d, "IMU") ? "IMU" : named(d, "IMU2") ? "IMU2" : "IMU3";
    const bool second = rw_parameter_of(d->log, "AHRS_EKF_TYPE", 0.0) == 2.0;
    if (instance_rows(d, message, IMU, 6, &imu) && rw_series_new(d->log, &s[RW_GYRO], imu.n, 3) && rw_series_new(d->log, &s[RW_ACCEL], imu.n, 3)) {
        for (size_t i = 0; i < imu.n; i++)
            for (size_t k = 0; k < 3; k++) {
                s[RW_GYRO].time[i] = s[RW_ACCEL].time[i] = imu.time[i];
                s[RW_GYRO].value[3 * i + k] = imu.value[6 * i + k];
                s[RW_ACCEL].value[3 * i + k] = imu.value[6 * i + 3 + k];
            }
        within(&s[RW_GYRO], TURN);
        within(&s[RW_ACCEL], FORCE);
    }
    message = named(d, "ANG") && (!named(d, "ATT") || named(d, "ANG")->count > named(d, "ATT")->count) ? "ANG" : "ATT";
    if (rows(d, message, ANGLES, 3, NULL, -1, &degrees) && rw_series_new(d->log, &s[RW_ATTITUDE], degrees.n, 4))
        for (size_t i = 0; i < degrees.n; i++) {
            static const double MOST[] = {200.0, 100.0, 400.0};
            double c[3], n[3], along = 0.0, *q = &s[RW_ATTITUDE].value[4 * i];
            bool fine = true;
            for (size_t k = 0; k < 3; k++) {
                const double half = degrees.value[3 * i + k] * (RW_PI / 180.0) / 2.0;
                fine = fine && fabs(degrees.value[3 * i + k]) <= MOST[k];
                c[k] = cos(half), n[k] = sin(half);
            }
            s[RW_ATTITUDE].time[i] = degrees.time[i];
            q[0] = c[0] * c[1] * c[2] + n[0] * n[1] * n[2], q[1] = n[0] * c[1] * c[2] - c[0] * n[1] * n[2];
            q[2] = c[0] * n[1] * c[2] + n[0] * c[1] * n[2], q[3] = c[0] * c[1] * n[2] - n[0] * n[1] * c[2];
            for (size_t k = 0; k < 4; k++)
                along += q[k] * before[k];
            for (size_t k = 0; k < 4; k++) { /* q and -q are the same attitude: the sign that makes the series continuous */
                q[k] = !fine ? (double)NAN : along < 0.0 ? -q[k] : q[k];
                before[k] = fine ? q[k] : before[k];
            }
        }
    message = second && named(d, "NKF1") ? "NKF1" : named(d, "XKF1") ? "XKF1" : named(d, "NKF1") ? "NKF1" : "EKF1";
    if (instance_rows(d, message, V, 3, &s[RW_VELOCITY]))
        within(&s[RW_VELOCITY], SPEED);
    if (instance_rows(d, message, P, 3, &d->log->position))
        within(&d->log->position, PLACE);
    if (rows(d, "MOTB", LIFT, 1, NULL, -1, &s[RW_VOLTAGE])) { /* as a share of full */
        rw_series *v = &s[RW_VOLTAGE];
        size_t n = 0;
        for (size_t i = 0; i < v->n; i++)
            if (v->value[i] > 0.3 && v->value[i] <= 2.0)
                v->time[n] = v->time[i], v->value[n++] = v->value[i];
        v->n = n;
    }
}

static int motor_of(double function)
{
    return function >= 33 && function <= 40 ? (int)function - 32 : function >= 82 && function <= 85 ? (int)function - 73 : 0;
}

/* The servo output of each rotor: logs/dataflash_rotors.py. */
static bool rotor_outputs(dataflash *d, int frame_class)
{
    static const int COUNTS[][2] = {{1, 4}, {2, 6}, {3, 8}, {4, 8}, {5, 6}, {7, 3}, {10, 2}, {12, 12}, {14, 10}};
    rw_log *log = d->log;
    int mapped[16] = {0}, expected = 0, functions = 0, motors = 0;
    for (size_t k = 0; k < sizeof COUNTS / sizeof *COUNTS; k++)
        expected = COUNTS[k][0] == frame_class ? COUNTS[k][1] : expected;
    for (int output = 1; output <= 32; output++) {
        char name[32];
        double function;
        int motor;
        snprintf(name, sizeof name, "SERVO%d_FUNCTION", output);
        function = rw_parameter_of(log, name, NAN);
        motor = motor_of(function);
        functions += !isnan(function);
        if (motor && (!mapped[motor] || motor == output))
            mapped[motor] = output;
    }
    for (int k = 1; k < 16; k++)
        motors += mapped[k] > 0;
    if (functions && !motors)
        return rw_refuse(log, "no output of this log has a motor function");
    d->rotors = 0;
    for (int k = 1; expected ? d->rotors < expected : k < 16; k++) {
        const int output = motors ? mapped[k] : k;
        if (frame_class == 7 && k == 3) /* a tricopter's rotors are motors 1, 2 and 4 */
            continue;
        if (!expected && !output)
            continue;
        if (!output)
            return rw_refuse(log, "this log does not say which output drives motor %d", k);
        d->outputs[d->rotors++] = output;
    }
    d->rotors = motors || expected ? d->rotors : 0;
    return true;
}

static bool motors(dataflash *d, int frame_class)
{
    static const char *const PREFIXES[] = {"C", "Ch", "Chan"};
    rw_log *log = d->log;
    char names[MOST_WIDTH][8];
    const char *columns[MOST_WIDTH];
    size_t width = 0, outputs[MOST_WIDTH];
    rw_series all, *out = &log->series[RW_OUTPUTS];
    for (size_t k = 1; k <= 14; k++)
        for (size_t p = 0; p < 3; p++) {
            snprintf(names[width], sizeof *names, "%s%d", PREFIXES[p], (int)k);
            if (has(d, "RCOU", names[width])) {
                columns[width] = names[width];
                outputs[width++] = k;
                break;
            }
        }
    if (!width || !rows(d, "RCOU", columns, width, NULL, -1, &all))
        return rw_refuse(log, "this log holds no motor outputs (RCOU records)");
    if (!rotor_outputs(d, frame_class))
        return false;
    if (!d->rotors) /* neither outputs nor frame are named: those that move */
        for (size_t k = 0; k < width && d->rotors < RW_ROTORS; k++) {
            double low = INFINITY, high = -INFINITY;
            for (size_t i = 0; i < all.n; i++) {
                const double u = all.value[i * width + k];
                if (u > 500.0 && u < 2600.0)
                    low = fmin(low, u), high = fmax(high, u);
            }
            if (high > low)
                d->outputs[d->rotors++] = (int)outputs[k];
        }
    if (!d->rotors || !rw_series_new(log, out, all.n, (size_t)d->rotors))
        return rw_refuse(log, "none of the outputs of this log drives a motor");
    memcpy(out->time, all.time, all.n * sizeof *out->time);
    for (int r = 0; r < d->rotors; r++) {
        size_t k = 0;
        while (k < width && outputs[k] != (size_t)d->outputs[r])
            k++;
        if (k == width)
            return rw_refuse(log, "output %d, which drives motor %d, is not in this log", d->outputs[r], r + 1);
        for (size_t i = 0; i < all.n; i++) {
            const double u = all.value[i * width + k];
            out->value[i * out->width + (size_t)r] = u >= RW_PULSE_LEAST_US && u <= RW_PULSE_MOST_US ? u : (double)NAN; /* 0: the output is off */
        }
    }
    log->pulses = true;
    log->motors = "RCOU";
    return true;
}

/* Parameters, and what the texts say of firmware and frame. */
static bool texts(dataflash *d)
{
    static const char *const OTHERS[] = {"ArduPlane", "ArduRover", "APMrover", "APM:Plane", "APM:Rover", "ArduSub", "Blimp", "AntennaTracker"};
    const format *parm = named(d, "PARM"), *msg = named(d, "MSG");
    size_t name_at = 0, value_at = 0, text_at = 0;
    char code, value_code = 0;
    const bool known = parm && find(parm, "Name", &name_at, &code) && code == 'N' && find(parm, "Value", &value_at, &value_code);
    const bool says = msg && find(msg, "Message", &text_at, &code) && code == 'Z';
    for (size_t i = 0; i < d->count; i++) {
        const uint8_t *record = d->log->data + d->at[i];
        const format *f = &d->formats[record[2]];
        char text[65];
        if (known && f == parm) {
            size_t length;
            text_of(text, record + name_at, 16);
            length = strlen(text);
            for (size_t k = 0; k < length; k++)
                if (!(isupper((unsigned char)text[k]) || (k && (isdigit((unsigned char)text[k]) || text[k] == '_'))))
                    length = 0;
            if (length && isnan(rw_parameter_of(d->log, text, NAN)) && !rw_parameter_add(d->log, text, length, value_of(record + value_at, value_code)))
                return false;
        } else if (says && f == msg) {
            text_of(text, record + text_at, 64);
            for (size_t k = 0; k < sizeof OTHERS / sizeof *OTHERS; k++) {
                const char *at = strstr(text, OTHERS[k]);
                if (at && (at[strlen(OTHERS[k])] == ' '))
                    return rw_refuse(d->log, "this log is of another vehicle (%s); rotorwatch diagnoses multirotors only", OTHERS[k]);
            }
            if (!d->announced[0][0])
                sscanf(text, "Frame: %23[A-Za-z0-9_]/%23[A-Za-z0-9_]", d->announced[0], d->announced[1]);
        }
    }
    return true;
}

/* Landings and arming: EV, ARM. */
static void states(dataflash *d)
{
    static const char *const ID[] = {"Id"}, *const STATE[] = {"ArmState"};
    rw_series ev, arm, *out = &d->log->series[RW_STATE];
    size_t at[2] = {0, 0};
    rows(d, "EV", ID, 1, NULL, -1, &ev);
    rows(d, "ARM", STATE, 1, NULL, -1, &arm);
    if (!rw_series_new(d->log, out, ev.n + arm.n, 2))
        return;
    out->n = 0;
    while (at[0] < ev.n || at[1] < arm.n) {
        const bool event = at[1] >= arm.n || (at[0] < ev.n && ev.time[at[0]] <= arm.time[at[1]]);
        const rw_series *s = event ? &ev : &arm;
        const size_t i = at[event ? 0 : 1]++;
        const double id = s->value[i];
        double landed = -1.0, armed = -1.0;
        if (!event)
            armed = id != 0.0;
        else if (id == 10.0 || id == 11.0)
            armed = id == 10.0;
        else if (id == 18.0 || id == 28.0)
            landed = id == 18.0;
        for (size_t k = 0; event && armed >= 0.0 && k < arm.n; k++) /* logged twice */
            if ((arm.value[k] != 0.0) == (armed != 0.0) && fabs(arm.time[k] - s->time[i]) < 1.0) {
                armed = -1.0;
                break;
            }
        if (landed < 0.0 && armed < 0.0)
            continue;
        out->time[out->n] = s->time[i];
        out->value[2 * out->n] = landed;
        out->value[2 * out->n++ + 1] = armed;
    }
}

bool rw_dataflash_read(rw_log *log)
{
    static const char *const HELICOPTER[] = {"H_COL_MIN", "H_COL_MAX", "H_RSC_MODE", "H_SV_MAN"};
    dataflash *d = rw_reserve(log, 1, sizeof *d);
    int frame_class, announced = 0, kind = -1;
    double class_;
    if (!d)
        return false;
    d->log = log;
    log->format = "dataflash";
    log->autopilot = "ArduPilot";
    if (!index_records(d) || !clock_of(d) || !texts(d))
        return false;
    for (size_t k = 0; k < 4; k++)
        if (!isnan(rw_parameter_of(log, HELICOPTER[k], NAN)))
            return rw_refuse(log, "this log is of a helicopter (H_ parameters); rotorwatch diagnoses multirotors only");
    for (char *c = d->announced[0]; *c; c++)
        *c = (char)toupper((unsigned char)*c);
    for (size_t k = 0; k < sizeof RW_CLASS_NAMES / sizeof *RW_CLASS_NAMES; k++)
        if (!strcmp(d->announced[0], RW_CLASS_NAMES[k].name))
            announced = RW_CLASS_NAMES[k].number;
    for (int k = 0; k < 4; k++)
        if (!strcmp(d->announced[1], ((const char *const[]){"PLUS", "X", "V", "H"})[k]))
            kind = k;
    /* The frame that the autopilot announces, where its parameters lack theirs. */
    if (announced && kind >= 0 && isnan(rw_parameter_of(log, "FRAME", NAN))) {
        if (isnan(rw_parameter_of(log, "FRAME_CLASS", NAN)) && !rw_parameter_add(log, "FRAME_CLASS", 11, announced))
            return false;
        if (isnan(rw_parameter_of(log, "FRAME_TYPE", NAN)) && !rw_parameter_add(log, "FRAME_TYPE", 10, kind))
            return false;
    }
    class_ = rw_parameter_of(log, "FRAME_CLASS", 0.0);
    frame_class = class_ > 0.0 ? (int)class_ : announced;
    if (!motors(d, frame_class))
        return false;
    motion(d);
    control(d);
    states(d);
    return !log->why[0] && rw_ardupilot_airframe(log, d->announced[0]);
}
