/* PX4's ULog: topics to signals, as logs/ulog.py, logs/px4_topics.py and logs/px4_outputs.py read them.
   File format: https://docs.px4.io/main/en/dev_log/ulog_file_format.html */
#include "rw_log.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define HEADER 16 /* bytes before the first message */
#define MOST_FIELDS 20000
#define MOST_WIDTH 16
#define INSTANCES 4 /* of actuator_outputs */
#define BEGINS_WITHIN_US 30e6
#define ENOUGH 20 /* samples of a topic that is logged all the time */

typedef struct {
    const char *text; /* "name:type field;..." */
    size_t length, name_length;
} format;

typedef struct {
    const format *layout;
    int instance;
    size_t count, *at; /* of its data messages: how many, and where each begins */
    uint64_t first;
} subscription;

typedef struct {
    rw_log *log;
    format *formats;
    size_t format_count;
    subscription *subscriptions;
    size_t subscription_count;
    int32_t *place; /* message id -> subscription, -1: none */
    uint64_t start; /* us that is second 0 */
    size_t begins;
} ulog;

typedef struct {
    size_t offset;
    char type[16];
} field;

static uint64_t number(const uint8_t *p, size_t bytes)
{
    uint64_t value = 0;
    for (size_t k = 0; k < bytes; k++)
        value |= (uint64_t)p[k] << (8 * k);
    return value;
}

static bool is(const char *text, size_t length, const char *name)
{
    return strlen(name) == length && !memcmp(text, name, length);
}

static const format *format_of(const ulog *u, const char *name, size_t length)
{
    for (size_t k = 0; k < u->format_count; k++)
        if (u->formats[k].name_length == length && !memcmp(u->formats[k].text, name, length))
            return &u->formats[k];
    return NULL;
}

static size_t size_of_plain(const char *type, size_t length)
{
    static const struct {
        const char *name;
        size_t size;
    } plain[] = {{"float", 4},    {"double", 8},  {"uint64_t", 8}, {"int64_t", 8}, {"uint32_t", 4}, {"int32_t", 4}, {"uint16_t", 2},
                 {"int16_t", 2}, {"uint8_t", 1}, {"int8_t", 1},   {"bool", 1},    {"char", 1}};
    for (size_t k = 0; k < sizeof plain / sizeof *plain; k++)
        if (is(type, length, plain[k].name))
            return plain[k].size;
    return 0;
}

/* One field of a format, from `at` on: its type, count (0: no array) and name; false at the end. */
typedef struct {
    const char *type, *name;
    size_t type_length, name_length, count;
} part;

static bool next_part(const format *f, size_t *at, part *p)
{
    const char *text = f->text + *at, *end = f->text + f->length, *stop, *space, *bracket;
    if (text >= end)
        return false;
    stop = memchr(text, ';', (size_t)(end - text));
    if (!stop)
        stop = end;
    *at = (size_t)(stop - f->text) + 1;
    space = memchr(text, ' ', (size_t)(stop - text));
    if (!space)
        return false;
    bracket = memchr(text, '[', (size_t)(space - text));
    p->type = text;
    p->type_length = (size_t)((bracket ? bracket : space) - text);
    p->name = space + 1;
    p->name_length = (size_t)(stop - space - 1);
    p->count = 0;
    for (const char *c = bracket ? bracket + 1 : space; c < space && *c >= '0' && *c <= '9' && p->count < MOST_FIELDS; c++)
        p->count = 10 * p->count + (size_t)(*c - '0');
    return true;
}

/* Bytes of a type; 0 for one that is unknown, recursive or absurdly large. */
static size_t size_of(const ulog *u, const char *type, size_t length, int depth)
{
    size_t total = size_of_plain(type, length), at, one;
    const format *f;
    part p;
    if (total || depth > 10 || !(f = format_of(u, type, length)))
        return total;
    for (at = f->name_length + 1; next_part(f, &at, &p);) {
        one = size_of(u, p.type, p.type_length, depth + 1);
        total += one * (p.count ? p.count : 1);
        if (!one || total > 8 * MOST_FIELDS)
            return 0;
    }
    return total;
}

/* Place and type of a field "name" or "name[k]"; false where the format lacks it. */
static bool find(const ulog *u, const format *f, const char *wanted, field *found)
{
    const char *bracket = strchr(wanted, '[');
    const size_t length = bracket ? (size_t)(bracket - wanted) : strlen(wanted);
    const size_t index = bracket ? (size_t)strtoul(bracket + 1, NULL, 10) : 0;
    size_t offset = 0, at = f->name_length + 1, one;
    part p;
    while (next_part(f, &at, &p)) {
        if (!(one = size_of(u, p.type, p.type_length, 0)))
            return false;
        if (p.name_length == length && !memcmp(p.name, wanted, length) && (bracket ? index < p.count : !p.count)) {
            if (p.type_length >= sizeof found->type || !size_of_plain(p.type, p.type_length))
                return false;
            memcpy(found->type, p.type, p.type_length);
            found->type[p.type_length] = 0;
            found->offset = offset + index * one;
            return true;
        }
        offset += one * (p.count ? p.count : 1);
        if (offset > 8 * MOST_FIELDS)
            return false;
    }
    return false;
}

static double value_of(const uint8_t *p, const char *type)
{
    if (!strcmp(type, "float")) {
        const uint32_t bits = (uint32_t)number(p, 4);
        float real;
        memcpy(&real, &bits, 4);
        return (double)real;
    }
    if (!strcmp(type, "double")) {
        const uint64_t bits = number(p, 8);
        double wide;
        memcpy(&wide, &bits, 8);
        return wide;
    }
    if (!strcmp(type, "uint64_t"))
        return (double)number(p, 8);
    if (!strcmp(type, "int64_t"))
        return (double)(int64_t)number(p, 8);
    if (!strcmp(type, "uint32_t"))
        return (double)number(p, 4);
    if (!strcmp(type, "int32_t"))
        return (double)(int32_t)number(p, 4);
    if (!strcmp(type, "uint16_t"))
        return (double)number(p, 2);
    if (!strcmp(type, "int16_t"))
        return (double)(int16_t)number(p, 2);
    return !strcmp(type, "int8_t") ? (double)(int8_t)*p : (double)*p;
}

/* The next whole message: its kind, or 0 at the end. */
static uint8_t message(const rw_log *log, size_t *at, const uint8_t **body, size_t *size)
{
    if (*at + 3 > log->size || (*size = (size_t)number(log->data + *at, 2)) > log->size - *at - 3)
        return 0;
    *body = log->data + *at + 3;
    *at += 3 + *size;
    return (*body)[-1];
}

static bool parameter(rw_log *log, const uint8_t *body, size_t size)
{
    const size_t length = size ? body[0] : 0;
    const char *key = (const char *)body + 1, *space;
    if (size < 1 + length + 4 || !(space = memchr(key, ' ', length)))
        return true;
    if (!is(key, (size_t)(space - key), "float") && !is(key, (size_t)(space - key), "int32_t"))
        return true;
    return rw_parameter_add(log, space + 1, length - (size_t)(space + 1 - key), value_of(body + 1 + length, *key == 'f' ? "float" : "int32_t"));
}

static const char DAMAGED[] = "this ULog is damaged at byte %lu; rotorwatch diagnose reads around damage";

/* Definitions, parameters and topics of the log, in one walk. */
static bool walk(ulog *u)
{
    rw_log *log = u->log;
    size_t at, size, from, counts[2] = {0, 0};
    const uint8_t *body;
    uint8_t kind;
    bool begun = false;
    for (at = HEADER; (kind = message(log, &at, &body, &size));)
        counts[0] += kind == 'F', counts[1] += kind == 'A';
    u->formats = rw_reserve(log, counts[0], sizeof *u->formats);
    u->subscriptions = rw_reserve(log, counts[1], sizeof *u->subscriptions);
    u->place = rw_reserve(log, 1 << 16, sizeof *u->place);
    if (!u->formats || !u->subscriptions || !u->place)
        return false;
    for (size_t k = 0; k < 1 << 16; k++)
        u->place[k] = -1;
    for (at = from = HEADER; (kind = message(log, &at, &body, &size)); from = at) {
        if (!memchr("BFIMPQADLCSOR", kind, 13))
            return rw_refuse(log, DAMAGED, (unsigned long)from);
        if (memchr("ALC", kind, 3) && !begun)
            begun = true, u->begins = from;
        if (kind == 'B' && size >= 40)
            for (size_t k = 16; k < 40; k++)
                if (body[k])
                    return rw_refuse(log, "this ULog has data behind its end, which only rotorwatch diagnose reads");
        if (kind == 'F' && !begun) {
            const char *colon = memchr(body, ':', size);
            if (!colon)
                return rw_refuse(log, DAMAGED, (unsigned long)from);
            u->formats[u->format_count++] = (format){(const char *)body, size, (size_t)(colon - (const char *)body)};
        } else if (kind == 'P' && !begun) {
            if (!parameter(log, body, size))
                return false;
        } else if (kind == 'A') {
            const format *layout = size < 3 ? NULL : format_of(u, (const char *)body + 3, size - 3);
            if (!layout || u->place[number(body + 1, 2)] >= 0)
                return rw_refuse(log, DAMAGED, (unsigned long)from);
            u->place[number(body + 1, 2)] = (int32_t)u->subscription_count;
            u->subscriptions[u->subscription_count++] = (subscription){layout, body[0], 0, NULL, 0};
        } else if (kind == 'D') {
            const int32_t k = size < 2 ? -1 : u->place[number(body, 2)];
            if (k < 0)
                return rw_refuse(log, DAMAGED, (unsigned long)from);
            if (!u->subscriptions[k].count++ && size >= 10)
                u->subscriptions[k].first = number(body + 2, 8);
        } else if (!begun && memchr("DOSR", kind, 4))
            return rw_refuse(log, DAMAGED, (unsigned long)from);
    }
    log->warned_cut = from < log->size;
    for (size_t k = 0; k < u->subscription_count; k++) {
        subscription *s = &u->subscriptions[k];
        if (!(s->at = rw_reserve(log, s->count, sizeof *s->at)))
            return false;
        s->count = 0;
    }
    for (at = u->begins; begun && (kind = message(log, &at, &body, &size));)
        if (kind == 'D') {
            subscription *s = &u->subscriptions[u->place[number(body, 2)]];
            s->at[s->count++] = (size_t)(body - log->data) - 3;
        }
    return true;
}

/* The data of a topic's instance; the smallest instance there is stands for 0. NULL without any. */
static const subscription *topic(const ulog *u, const char *name, int instance)
{
    const subscription *found = NULL, *least = NULL;
    for (size_t k = 0; k < u->subscription_count; k++) {
        const subscription *s = &u->subscriptions[k];
        if (!s->count || !is(s->layout->text, s->layout->name_length, name))
            continue;
        if (s->instance == instance)
            found = s;
        if (!least || s->instance <= least->instance)
            least = s;
    }
    return found || instance ? found : least;
}

/* Fields of a topic as a series. Samples from before the start are left out, or count as second 0 with `early`. Returns whether the topic
   has them all, and some samples; sets `why` where the log is damaged. */
static bool table(ulog *u, const char *name, int instance, const char *const *fields, size_t width, bool early, rw_series *out)
{
    const subscription *s = topic(u, name, instance);
    field places[MOST_WIDTH], stamp;
    size_t at, size, least = 0;
    const uint8_t *body;
    out->n = 0;
    if (!s || !find(u, s->layout, "timestamp", &stamp) || strcmp(stamp.type, "uint64_t"))
        return false;
    least = stamp.offset + 8;
    for (size_t k = 0; k < width; k++) {
        size_t end;
        if (!find(u, s->layout, fields[k], &places[k]))
            return false;
        end = places[k].offset + size_of_plain(places[k].type, strlen(places[k].type));
        least = end > least ? end : least;
    }
    if (!rw_series_new(u->log, out, s->count, width))
        return false;
    out->n = 0;
    for (size_t i = 0; i < s->count; i++) {
        int64_t since;
        at = s->at[i];
        message(u->log, &at, &body, &size);
        if (size < least + 2)
            return rw_refuse(u->log, DAMAGED, (unsigned long)(body - u->log->data));
        since = (int64_t)(number(body + 2 + stamp.offset, 8) - u->start);
        if (since < 0 && !early)
            continue;
        out->time[out->n] = since < 0 ? 0.0 : (double)since * 1e-6;
        for (size_t k = 0; k < width; k++)
            out->value[out->n * width + k] = value_of(body + 2 + places[k].offset, places[k].type);
        out->n++;
    }
    return true;
}

static const char *const XYZ[] = {"xyz[0]", "xyz[1]", "xyz[2]"};

/* A signal of one kind from a topic; true where it has usable samples. */
static bool signal(ulog *u, const char *name, const char *const *fields, size_t width, double limit, rw_series *out)
{
    if (table(u, name, 0, fields, width, false, out) && rw_series_settle(u->log, out, limit))
        for (size_t i = 0; i < out->n * width; i++)
            if (!isnan(out->value[i]))
                return true;
    out->n = 0;
    return false;
}

/* Of two signals the faster one; within 10 % the first. */
static void fastest(ulog *u, const rw_series *first, const rw_series *second, rw_series *out)
{
    *out = second->n && (!first->n || rw_rate_hz(u->log, second) > 1.1 * rw_rate_hz(u->log, first)) ? *second : *first;
}

/* Columns of vehicle_local_position, where its flags say that they are known. */
static void where_known(ulog *u, const char *const *fields, const char *const *known, double limit, rw_series *out)
{
    rw_series flags;
    if (!table(u, "vehicle_local_position", 0, fields, 3, false, out))
        return;
    if (table(u, "vehicle_local_position", 0, known, 3, false, &flags))
        for (size_t i = 0; i < 3 * out->n; i++)
            if (flags.value[i] == 0.0)
                out->value[i] = NAN;
    rw_series_settle(u->log, out, limit);
}

static void motion(ulog *u)
{
    static const char *const SPEEDS[] = {"rollspeed", "pitchspeed", "yawspeed"};
    static const char *const GYRO[] = {"gyro_rad[0]", "gyro_rad[1]", "gyro_rad[2]"};
    static const char *const ACCEL[] = {"accelerometer_m_s2[0]", "accelerometer_m_s2[1]", "accelerometer_m_s2[2]"};
    static const char *const Q[] = {"q[0]", "q[1]", "q[2]", "q[3]"};
    static const char *const V[] = {"vx", "vy", "vz"}, *const V_KNOWN[] = {"v_xy_valid", "v_xy_valid", "v_z_valid"};
    static const char *const P[] = {"x", "y", "z"}, *const P_KNOWN[] = {"xy_valid", "xy_valid", "z_valid"};
    rw_series a, b, *s = u->log->series;
    if (!signal(u, "vehicle_angular_velocity", XYZ, 3, 100.0, &a))
        signal(u, "vehicle_attitude", SPEEDS, 3, 100.0, &a);
    s[RW_RATES] = a;
    signal(u, "sensor_combined", GYRO, 3, 100.0, &b);
    fastest(u, &a, &b, &s[RW_GYRO]);
    signal(u, "vehicle_acceleration", XYZ, 3, 1000.0, &a);
    signal(u, "sensor_combined", ACCEL, 3, 1000.0, &b);
    fastest(u, &a, &b, &s[RW_ACCEL]);
    if (table(u, "vehicle_attitude", 0, Q, 4, false, &a)) {
        for (size_t i = 0; i < a.n; i++) {
            double *q = &a.value[4 * i], length = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
            for (size_t k = 0; k < 4; k++)
                q[k] = fabs(length - 1.0) < 0.1 ? q[k] / length : (double)NAN;
        }
        if (rw_series_settle(u->log, &a, 1.1))
            s[RW_ATTITUDE] = a;
    }
    where_known(u, V, V_KNOWN, 300.0, &s[RW_VELOCITY]);
    where_known(u, P, P_KNOWN, 1e6, &u->log->position);
}

/* The rate controller's output: torque and thrust setpoints (1.13 and later), else actuator_controls_0. */
static void control(ulog *u)
{
    static const char *const FIELDS[] = {"control[0]", "control[1]", "control[2]", "control[3]"};
    rw_series torque, thrust, *out = &u->log->series[RW_CONTROL];
    if (!table(u, "vehicle_torque_setpoint", 0, XYZ, 3, false, &torque) || !table(u, "vehicle_thrust_setpoint", 0, XYZ, 3, false, &thrust)
        || !thrust.n) {
        signal(u, "actuator_controls_0", FIELDS, 4, 10.0, out);
        return;
    }
    if (!rw_series_settle(u->log, &thrust, INFINITY) || !rw_series_new(u->log, out, torque.n, 4))
        return;
    for (size_t i = 0, j = 0; i < torque.n; i++) {
        /* The latest thrust setpoint at this torque setpoint; both are published within the same cycle. */
        while (j + 1 < thrust.n && thrust.time[j + 1] <= torque.time[i] + 1e-3)
            j++;
        out->time[i] = torque.time[i];
        memcpy(&out->value[4 * i], &torque.value[3 * i], 3 * sizeof(double));
        out->value[4 * i + 3] = -thrust.value[3 * j + 2];
    }
    rw_series_settle(u->log, out, 10.0);
}

/* Number of rotors by parameter; 0: unknown. */
static int rotor_count(const rw_log *log)
{
    static const int TYPES[][2] = {{2, 4}, {3, 2}, {13, 6}, {14, 8}, {15, 3}, {29, 12}, {35, 10}};
    const int count = (int)rw_parameter_of(log, "CA_ROTOR_COUNT", 0), type = (int)rw_parameter_of(log, "MAV_TYPE", 0);
    if (count > 0 && count <= 12)
        return count;
    for (size_t k = 0; k < sizeof TYPES / sizeof *TYPES; k++)
        if (TYPES[k][0] == type)
            return TYPES[k][1];
    return 0;
}

/* An instance of actuator_outputs read as rotors, as logs/px4_outputs.py: columns, values in us or shares, its limits. */
typedef struct {
    rw_series series;
    bool found, pulses, named;
    double swing, pwm_min, pwm_max;
} reading;

static const char *const DRIVERS[] = {"PWM_MAIN", "PWM_AUX", "UAVCAN_EC", "HIL_ACT", "PCA9685", "VOXL_ESC", "TAP_ESC"};
#define DRIVER_COUNT 7
#define CAN 2

static double driver_parameter(const rw_log *log, int driver, const char *word, int output, double otherwise)
{
    char name[24];
    strcpy(name, DRIVERS[driver]);
    strcat(name, word);
    if (output > 0) {
        char digits[3] = {(char)('0' + output / 10), (char)('0' + output % 10), 0};
        strcat(name, output < 10 ? digits + 1 : digits);
    }
    return rw_parameter_of(log, name, otherwise);
}

/* Low and high end of a column's finite values, one value in 200 left out for damage; those that are `without` do not count. */
static bool extremes(ulog *u, const rw_series *s, size_t column, double without, double *low, double *high)
{
    double *fine = rw_reserve(u->log, s->n, sizeof *fine);
    size_t n = 0, out;
    if (!fine)
        return false;
    for (size_t i = 0; i < s->n; i++) {
        const double x = s->value[i * s->width + column];
        if (isfinite(x) && x != without)
            fine[n++] = x;
    }
    out = n / 200;
    *low = *high = NAN;
    if (n) {
        *low = rw_ranked(u->log, fine, n, out);
        *high = rw_ranked(u->log, fine, n, n - 1 - out);
    }
    return n > 0;
}

static double limit_of(const rw_log *log, int driver, const char *word, const int *picked, size_t count)
{
    char common[16] = "PWM_MAIN_";
    double value;
    for (size_t k = 0; k < count; k++) {
        char one[8] = "_";
        strcat(one, word);
        if ((value = driver_parameter(log, driver < 0 ? 0 : driver, one, picked[k] + 1, 0.0)) > 0.0)
            return value;
    }
    strcat(common, word);
    if ((value = rw_parameter_of(log, common, 0.0)) > 0.0)
        return value;
    strcpy(common, "PWM_");
    strcat(common, word);
    value = rw_parameter_of(log, common, 0.0);
    return value > 0.0 ? value : 0.0;
}

/* These columns as pulses or shares, whichever their values and the log's parameters allow; moving: only if all move as rotors do. */
static bool in_unit(ulog *u, const rw_series *all, const int *picked, size_t n, int driver, bool moving, reading *out)
{
    double low[MOST_WIDTH], top[MOST_WIDTH], start[MOST_WIDTH], unused, swing = 0.0, widest = 0.0, narrowest = INFINITY, highest = -INFINITY;
    bool shares = true, negative = false, pulses = driver != CAN, counts = true, still = true;
    rw_series *s = &out->series;
    if (!n || !rw_series_new(u->log, s, all->n, n))
        return false;
    memcpy(s->time, all->time, all->n * sizeof *s->time);
    for (size_t i = 0; i < all->n; i++)
        for (size_t k = 0; k < n; k++)
            s->value[i * n + k] = all->value[i * all->width + (size_t)picked[k]];
    for (size_t k = 0; k < n; k++) {
        if (!extremes(u, s, k, NAN, &low[k], &top[k]))
            return false;
        extremes(u, s, k, 0.0, &start[k], &unused); /* 0 is no pulse at all */
        shares = shares && fabs(top[k]) <= 1.01 && low[k] >= -1.01;
        negative = negative || low[k] < -0.05;
        pulses = pulses && start[k] >= 800.0 && top[k] <= 2500.0;
        counts = counts && top[k] <= 8191.0 && low[k] >= 0.0 && top[k] >= 2.0;
        highest = top[k] > highest ? top[k] : highest;
        widest = top[k] - low[k] > widest ? top[k] - low[k] : widest;
        narrowest = top[k] - low[k] < narrowest ? top[k] - low[k] : narrowest;
        swing += (top[k] - low[k]) / (double)n;
    }
    out->named = driver >= 0 && !isnan(driver_parameter(u->log, driver, "_FUNC", picked[0] + 1, NAN));
    out->swing = swing;
    out->pulses = false;
    out->pwm_min = out->pwm_max = 0.0;
    if (shares) {
        if (widest <= 0.01)
            return false;
        for (size_t i = 0; negative && i < s->n * n; i++) /* old HIL and lock-step SITL drivers */
            s->value[i] = (s->value[i] + 1.0) / 2.0;
        out->swing = negative ? swing / 2.0 : swing;
        return out->found = true;
    }
    if (pulses) {
        if (moving && narrowest <= 100.0)
            return false;
        out->pulses = true;
        out->swing = swing / 1e3;
        out->pwm_min = limit_of(u->log, driver, "MIN", picked, n);
        out->pwm_max = limit_of(u->log, driver, "MAX", picked, n);
        return out->found = true;
    }
    if (!counts)
        return false;
    /* Counts of a UAVCAN or DShot command as shares of full. */
    out->swing = 0.0;
    {
        const bool can = driver == CAN || highest > 1999.0;
        double least[MOST_WIDTH], most[MOST_WIDTH];
        bool ordered = true;
        for (size_t k = 0; k < n; k++) {
            least[k] = can ? driver_parameter(u->log, CAN, "_MIN", picked[k] + 1, 0.0) : 0.0;
            most[k] = can ? driver_parameter(u->log, CAN, "_MAX", picked[k] + 1, 8191.0) : 1999.0;
            ordered = ordered && least[k] < most[k];
        }
        for (size_t k = 0; k < n; k++) {
            if (!ordered)
                least[k] = 0.0, most[k] = 8191.0;
            still = still && top[k] - low[k] < 0.01 * (most[k] - least[k]);
            out->swing += (top[k] - low[k]) / (most[k] - least[k]) / (double)n;
        }
        for (size_t i = 0; i < s->n * n; i++)
            s->value[i] = fmax((s->value[i] - least[i % n]) / (most[i % n] - least[i % n]), 0.0);
    }
    return out->found = !still;
}

static bool moves(const rw_series *s, size_t column)
{
    double seen[10], most = 0.0;
    size_t distinct = 0, finite = 0, k;
    for (size_t i = 0; i < s->n; i++) {
        const double x = s->value[i * s->width + column];
        if (!isfinite(x))
            continue;
        finite++;
        most = fmax(most, fabs(x));
        for (k = 0; k < distinct && seen[k] != x; k++)
            ;
        if (k == distinct && distinct < 10)
            seen[distinct++] = x;
    }
    return finite && (distinct >= 10 || most <= 1.01);
}

/* The rotors among the outputs of one instance. */
static bool read_outputs(ulog *u, rw_series *all, int count, reading *out)
{
    rw_log *log = u->log;
    int picked[MOST_WIDTH], functions[DRIVER_COUNT][13], named = 0, driver;
    size_t n = 0;
    bool only_can = false;
    memset(functions, 0, sizeof functions);
    for (size_t i = 0; i < all->n * all->width; i++)
        if (all->value[i] == 65535.0) /* drivers that take counts log this while disarmed */
            all->value[i] = 0.0;
    for (size_t i = 0; i < log->parameter_count; i++)
        for (int d = 0; d < DRIVER_COUNT; d++) {
            const size_t length = strlen(DRIVERS[d]);
            const char *name = log->parameters[i].name;
            const double function = log->parameters[i].value;
            if (!strncmp(name, DRIVERS[d], length) && !strncmp(name + length, "_FUNC", 5) && function >= 101.0 && function <= 112.0)
                functions[d][(int)function - 100] = atoi(name + length + 5);
        }
    for (int d = 0; d < DRIVER_COUNT; d++) {
        int motors = 0, highest = 0;
        for (int m = 1; m <= 12; m++)
            if (functions[d][m])
                motors++, highest = m;
        if (!motors)
            continue;
        named++;
        only_can = d == CAN;
        if (highest != motors) /* one is left out */
            continue;
        for (n = 0; n < (size_t)motors; n++)
            picked[n] = functions[d][n + 1] - 1;
        for (n = 0; n < (size_t)motors && picked[n] >= 0 && picked[n] < (int)all->width; n++)
            ;
        if (n == (size_t)motors && in_unit(u, all, picked, n, d, false, out))
            return true;
    }
    only_can = named == 1 ? only_can : !named && rw_parameter_of(log, "UAVCAN_ENABLE", 0.0) >= 3.0;
    driver = only_can && !(rw_parameter_of(log, "DSHOT_CONFIG", 0.0) > 0.0) ? CAN : -1;
    if (count > 0 && count <= (int)all->width) {
        for (n = 0; n < (size_t)count; n++)
            picked[n] = (int)n;
        if (in_unit(u, all, picked, n, driver, false, out))
            return true;
    }
    n = 0;
    for (int k = 0; k < (int)all->width; k++) {
        reading one = {0};
        if (moves(all, (size_t)k) && in_unit(u, all, &k, 1, driver, true, &one))
            picked[n++] = k;
    }
    return in_unit(u, all, picked, n, driver, false, out);
}

/* Whether the outputs of two publishers alternate in one instance (`px4_outputs.tracks`): two out of three jumps lead back. */
static bool alternates(const rw_series *s, double step)
{
    size_t back = 0;
    for (size_t i = 2; i < s->n; i++) {
        double before = 0.0, after = 0.0, across = 0.0;
        for (size_t k = 0; k < s->width; k++) {
            const double *x = &s->value[i * s->width + k];
            const ptrdiff_t row = (ptrdiff_t)s->width;
            before = fmax(before, fabs(x[-row] - x[-2 * row]));
            after = fmax(after, fabs(x[0] - x[-row]));
            across = fmax(across, fabs(x[0] - x[-2 * row]));
        }
        back += fmin(before, after) > fmax(4.0 * across, step);
    }
    return s->n >= 60 && back >= 20;
}

static bool motors(ulog *u)
{
    static const char *const CONTROL[] = {"control[0]", "control[1]", "control[2]",  "control[3]", "control[4]", "control[5]",
                                          "control[6]", "control[7]", "control[8]", "control[9]", "control[10]", "control[11]"};
    static const char *const OUTPUT[] = {"output[0]",  "output[1]",  "output[2]",  "output[3]",  "output[4]",  "output[5]",
                                         "output[6]",  "output[7]",  "output[8]",  "output[9]",  "output[10]", "output[11]",
                                         "output[12]", "output[13]", "output[14]", "output[15]"};
    rw_log *log = u->log;
    const int count = rotor_count(log);
    rw_series all;
    reading best = {0};
    size_t width;
    for (width = 12; width && !table(u, "actuator_motors", 0, CONTROL, width, false, &all) && !log->why[0]; width--)
        ;
    if (width && all.n) {
        double share[12], most = 0.0;
        int used = 0, picked[MOST_WIDTH];
        for (size_t k = 0; k < width; k++) {
            share[k] = 0.0;
            for (size_t i = 0; i < all.n; i++)
                share[k] += isfinite(all.value[i * width + k]) ? 1.0 / (double)all.n : 0.0;
            most = fmax(most, share[k]);
        }
        for (size_t k = 0; k < width; k++)
            if (most > 0.0 && share[k] > 0.1 * most) /* a damaged NaN can be a number */
                used = (int)k + 1;
        if (used) {
            const size_t n = (size_t)(count ? (count < (int)width ? count : (int)width) : used);
            rw_series *out = &log->series[RW_OUTPUTS];
            for (size_t k = 0; k < n; k++)
                picked[k] = (int)k;
            if (!rw_series_new(log, out, all.n, n))
                return false;
            memcpy(out->time, all.time, all.n * sizeof *out->time);
            for (size_t i = 0; i < all.n; i++)
                for (size_t k = 0; k < n; k++)
                    out->value[i * n + k] = all.value[i * width + (size_t)picked[k]];
            log->motors = "actuator_motors";
            return rw_series_settle(log, out, 1.5);
        }
    }
    for (int instance = 0; instance < INSTANCES && !log->why[0]; instance++) {
        reading one = {0};
        for (width = 16; width && !table(u, "actuator_outputs", instance, OUTPUT, width, false, &all) && !log->why[0]; width--)
            ;
        if (width && all.n && read_outputs(u, &all, count, &one)
            && (!best.found || one.named > best.named || (one.named == best.named && one.swing > best.swing)))
            best = one;
    }
    if (log->why[0])
        return false;
    if (!best.found)
        return rw_refuse(log, "this log holds no motor outputs (actuator_motors or actuator_outputs)");
    if (alternates(&best.series, best.pulses ? 10.0 : 0.01))
        return rw_refuse(log, "the outputs of two publishers alternate in this log, which only rotorwatch diagnose tells apart");
    log->series[RW_OUTPUTS] = best.series;
    log->motors = "actuator_outputs";
    log->pulses = best.pulses;
    log->pwm_min = best.pwm_min;
    log->pwm_max = best.pwm_max;
    return rw_series_settle(log, &log->series[RW_OUTPUTS], best.pulses ? 3000.0 : 1.5);
}

/* Changes of whether the vehicle has landed and is armed, merged in the order of time. */
static bool states(ulog *u)
{
    static const char *const LANDED[] = {"landed"}, *const ARMED[] = {"armed"}, *const STATE[] = {"arming_state"};
    rw_series s[2], *out = &u->log->series[RW_STATE];
    size_t at[2] = {0, 0};
    bool by_status = false;
    table(u, "vehicle_land_detected", 0, LANDED, 1, true, &s[0]);
    if (!table(u, "actuator_armed", 0, ARMED, 1, true, &s[1]))
        by_status = table(u, "vehicle_status", 0, STATE, 1, true, &s[1]);
    if (u->log->why[0] || !rw_series_new(u->log, out, s[0].n + s[1].n, 2))
        return false;
    out->n = 0;
    for (int who = 0; who < 2; who++)
        for (size_t i = 0; i < s[who].n; i++)
            s[who].value[i] = who && by_status ? s[who].value[i] == 2.0 : s[who].value[i] != 0.0;
    while (at[0] < s[0].n || at[1] < s[1].n) {
        const int who = at[1] >= s[1].n || (at[0] < s[0].n && s[0].time[at[0]] <= s[1].time[at[1]]) ? 0 : 1;
        const size_t i = at[who]++;
        if (i && s[who].value[i] == s[who].value[i - 1])
            continue;
        out->time[out->n] = s[who].time[i];
        out->value[2 * out->n] = who ? -1.0 : s[who].value[i];
        out->value[2 * out->n + 1] = who ? s[who].value[i] : -1.0;
        out->n++;
    }
    return true;
}

/* MAV_TYPE by vehicle_status: system_type, else is_vtol and vehicle_type (1.10 and later). */
static void kind_of_vehicle(ulog *u)
{
    static const char *const FIELDS[] = {"system_type", "is_vtol", "vehicle_type"};
    double usual[3] = {0.0, 0.0, 0.0};
    rw_series s;
    for (size_t k = 0; k < 3; k++)
        if (table(u, "vehicle_status", 0, &FIELDS[k], 1, true, &s) && s.n)
            usual[k] = rw_median(u->log, s.value, s.n);
    u->log->mav_type = usual[0] > 0.0 ? usual[0] : usual[1] > 0.0 ? 22.0 : usual[2] == 2.0 ? 1.0 : usual[2] == 3.0 ? 10.0 : 0.0;
}

bool rw_ulog_read(rw_log *log)
{
    static const char *const VOLTAGE[] = {"voltage_v"};
    ulog u = {0};
    double earliest = INFINITY;
    bool near = false, some = false;
    rw_series battery;
    u.log = log;
    u.begins = HEADER;
    log->format = "PX4 ULog";
    log->autopilot = "PX4";
    if (log->size < HEADER)
        return rw_refuse(log, "this ULog ends within its header");
    u.start = number(log->data + 8, 8);
    if (!walk(&u))
        return false;
    for (size_t k = 0; k < u.subscription_count; k++) {
        const subscription *s = &u.subscriptions[k];
        if (s->count < ENOUGH || !(is(s->layout->text, s->layout->name_length, "sensor_combined")
                                   || is(s->layout->text, s->layout->name_length, "vehicle_attitude")))
            continue;
        some = true;
        near = near || fabs((double)s->first - (double)u.start) < BEGINS_WITHIN_US;
        earliest = fmin(earliest, (double)s->first);
    }
    if (some && !near) /* the header's start time is damaged */
        u.start = (uint64_t)earliest;
    motion(&u);
    control(&u);
    kind_of_vehicle(&u);
    if (log->why[0] || !motors(&u) || !states(&u))
        return false;
    if (signal(&u, "battery_status", VOLTAGE, 1, 5000.0, &battery))
        log->end = battery.time[battery.n - 1];
    return rw_px4_airframe(log);
}
