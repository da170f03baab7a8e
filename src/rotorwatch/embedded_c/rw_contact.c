#include "rw_contact.h"

#include <math.h>
#include <string.h>

#define N RW_ROTORS
#define R(x) ((rw_real)(x))

#ifdef ROTORWATCH_FLOAT
#define ROOT sqrtf
#else
#define ROOT sqrt
#endif

/* motion/contact.py says what these are. */
static const double G0 = 9.80665;
static const rw_real SIDEWAYS = R(0.5), UPWARD = R(0.8), SHAKES = R(2.5), TURNS = R(5.0);
static const rw_real LEAST_GAIN[3] = {R(0.0015), R(0.0015), R(0.03)};
static const rw_time TOGETHER_S = 1.0;

static rw_real magnitude(rw_real x) { return x < 0 ? -x : x; }

static rw_real larger(rw_real a, rw_real b) { return a > b ? a : b; }

void rw_vibration_init(rw_vibration *s) { memset(s, 0, sizeof *s); }

void rw_vibration_sample(rw_vibration *s, const rw_real *force, const rw_real *sum, int count)
{
    double square = 0;
    for (int i = 0; i < 3 && count > 0; i++) {
        const double away = (double)force[i] - (double)sum[i] / count;
        square += away * away;
    }
    s->total += square < G0 * G0 ? square : G0 * G0;
    if (s->count < UINT32_MAX) s->count++;
}

rw_real rw_vibration_rms(const rw_vibration *s) { return s->count ? (rw_real)sqrt(s->total / s->count) : 0; }

void rw_contact_init(rw_contact *s)
{
    memset(s, 0, sizeof *s);
    s->hit = -RW_LASTS;
}

/* By how much column i differs from the mean of the ticks before; all of these are fresh. */
static rw_real since(const rw_contact *s, rw_real value, int i)
{
    rw_real sum = 0;
    for (int k = 0; k < RW_TICKS_BEFORE; k++) sum += s->before[k][i];
    return value - sum / R(RW_TICKS_BEFORE);
}

/* Torque that the motion takes at least, beyond what was commanded that way and the loss of any two rotors explains. */
static rw_real spun(const rw_shove *x)
{
    rw_real most = 0, first = 0, second = 0;
    for (int axis = 0; axis < 3; axis++) {
        const rw_real turn = x->rate_dot[axis];
        const rw_real commanded = turn > 0 ? x->torque[axis] : turn < 0 ? -x->torque[axis] : 0;
        const rw_real left = LEAST_GAIN[axis] * R(N) * magnitude(turn) - larger(commanded, 0);
        most = axis == 0 ? left : larger(most, left);
    }
    for (int k = 0; k < N; k++) {
        const rw_real thrust = x->thrust[k];
        if (k == 0 || thrust > first) {
            second = first;
            first = thrust;
        } else if (k == 1 || thrust > second) {
            second = thrust;
        }
    }
    return most - (first + second);
}

rw_touch rw_contact_tick(rw_contact *s, const rw_shove *x)
{
    rw_real mean = 0, sizes[3] = {0, 0, 0}, limits[3], turning = 0;
    bool usable = x->fresh && x->accelerometer, turns;
    rw_touch found;
    int best = -1;
    for (int axis = 0; axis < 3; axis++) turning = larger(turning, magnitude(x->rate_dot[axis]));
    turns = larger(turning, s->turning) > TURNS;
    s->turning = turning;
    for (int k = 0; k < N; k++) mean += x->thrust[k] / R(N);
    for (int k = 0; k < RW_TICKS_BEFORE; k++) usable = usable && s->fresh[k];

    limits[RW_TURNED] = 0;
    limits[RW_PUSHED_SIDEWAYS] = larger(SIDEWAYS, SHAKES * x->shake / R(G0));
    limits[RW_PUSHED_UP] = larger(UPWARD, SHAKES * x->shake / R(G0));
    if (x->fresh) sizes[RW_TURNED] = spun(x);
    if (usable && turns) { /* what hits a vehicle turns it as well, vibration does not */
        const rw_real forward = since(s, x->side[0], 0), right = since(s, x->side[1], 1);
        const rw_real up = since(s, x->load, 2), lift = since(s, x->load - mean, 3);
        sizes[RW_PUSHED_SIDEWAYS] = ROOT(forward * forward + right * right) / R(G0);
        sizes[RW_PUSHED_UP] = up < lift ? up : lift; /* not because the motors, cut, still turn */
    }
    for (int kind = 0; kind < (x->accelerometer ? 3 : 1); kind++) {
        if (best < 0 || sizes[kind] - limits[kind] > sizes[best] - limits[best]) best = kind;
    }

    s->before[s->next][0] = x->fresh && x->accelerometer ? x->side[0] : 0;
    s->before[s->next][1] = x->fresh && x->accelerometer ? x->side[1] : 0;
    s->before[s->next][2] = x->fresh && x->accelerometer ? x->load : 0;
    s->before[s->next][3] = x->fresh && x->accelerometer ? x->load - mean : 0;
    s->fresh[s->next] = x->fresh;
    s->next = (int16_t)((s->next + 1) % RW_TICKS_BEFORE);

    memset(&found, 0, sizeof found);
    if (!(sizes[best] - limits[best] > 0)) return found;
    if (x->time - s->hit > TOGETHER_S) {
        s->last.time = x->time;
        s->last.size = sizes[best];
        s->last.push = (uint8_t)best;
        found.news = true;
    } else if ((best == RW_TURNED) == (s->last.push == RW_TURNED) && sizes[best] > s->last.size) {
        s->last.size = sizes[best];
        s->last.push = (uint8_t)best;
        found.news = true;
    }
    s->hit = x->time;
    found.time = s->last.time;
    found.size = s->last.size;
    found.push = s->last.push;
    found.hit = true;
    return found;
}
