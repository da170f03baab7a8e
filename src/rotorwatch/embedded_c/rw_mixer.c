#include "rw_mixer.h"

#include <math.h>
#include <string.h>

#define N RW_ROTORS

static const rw_real PART = (rw_real)0.05;    /* share of full thrust by which both may differ before the rebuilt one is not trusted */
static const rw_real FLYING = (rw_real)0.05;  /* share above which a rotor does enough for a comparison */
static const rw_time GAIN_MEMORY_S = 20.0;    /* air density changes with height, slowly */
static const rw_time PAIR_WITHIN_S = 0.15;    /* outputs further than this from any sample of the rate controller have no partner */
static const rw_time TOGETHER_S = 0.002;      /* at equal rates outputs come within 1 ms of their rate controller's sample */
static const rw_time FRESH_S = 0.5;
#if RW_MIXER_UNKNOWN
static const double NOISE_SD = 0.004;         /* share; rounding, and the controller between two samples */
#endif

static rw_real magnitude(rw_real x) { return x < 0 ? -x : x; }

static rw_real clipped(rw_real x, rw_real low, rw_real high) { return x < low ? low : x > high ? high : x; }

static rw_real curve(const rw_vehicle *v, rw_real expo, rw_real u, rw_real battery)
{
    const rw_real a = clipped((u - v->u_min) / (v->u_max - v->u_min), 0, 1) * battery;
    return (1 - expo) * a + expo * a * a;
}

rw_real rw_mixer_curve(const rw_vehicle *v, rw_real u, rw_real battery) { return curve(v, v->expo, u, battery); }

void rw_mixer_init(rw_mixer *m)
{
    memset(m, 0, sizeof *m);
    m->gain = 1;
#if RW_MIXER_UNKNOWN
    for (int k = 0; k < N; k++) m->weights[RW_CONTROL_THROTTLE][k] = 1.0;
    for (int c = 0; c <= RW_CONTROLS; c++) m->spread[c][c] = 1.0;
#endif
}

/* Thrust of a rotor by a known mixer of gain 1. */
static rw_real mixed(const rw_vehicle *v, const rw_real *control, int k)
{
    rw_real sum = 0;
    for (int c = 0; c < RW_CONTROLS; c++) sum += control[c] * v->mixer[k][c];
    return sum;
}

/* What the mixer, as it is known now, asks of a rotor; of that, what is for yaw. */
static rw_real asks(const rw_mixer *m, const rw_vehicle *v, const rw_real *control, int k, rw_real *yaw)
{
#if RW_MIXER_UNKNOWN
    if (!v->mixer_known) {
        double sum = m->weights[RW_CONTROLS][k];
        for (int c = 0; c < RW_CONTROLS; c++) sum += (double)control[c] * m->weights[c][k];
        *yaw = (rw_real)((double)control[RW_CONTROL_YAW] * m->weights[RW_CONTROL_YAW][k]);
        return (rw_real)sum;
    }
#endif
    *yaw = control[RW_CONTROL_YAW] * m->gain * v->mixer[k][RW_CONTROL_YAW];
    return m->gain * mixed(v, control, k);
}

/* Does the mixer grant all of the yaw? It limits yaw last: to the room that roll and pitch leave every rotor around a throttle of at most
   0.5, but never below its headroom. */
static bool grants_yaw(const rw_vehicle *v, const rw_real *control)
{
    const rw_real yaw = magnitude(control[RW_CONTROL_YAW]);
    bool bounded = false;
    rw_real least = 0;
    if (!v->mixer_known) return yaw < v->yaw_headroom;
    for (int k = 0; k < N; k++) {
        const rw_real factor = v->mixer[k][RW_CONTROL_YAW];
        if (!(magnitude(factor) > (rw_real)1e-9)) continue;
        const rw_real tilt =
            control[RW_CONTROL_ROLL] * v->mixer[k][RW_CONTROL_ROLL] + control[RW_CONTROL_PITCH] * v->mixer[k][RW_CONTROL_PITCH];
        const rw_real level = clipped(control[RW_CONTROL_THROTTLE], 0, (rw_real)0.5) + tilt;
        const rw_real room = (control[RW_CONTROL_YAW] * factor > 0 ? 1 - level : level) / magnitude(factor);
        if (!bounded || room < least) least = room;
        bounded = true;
    }
    least *= (rw_real)0.95;
    return !bounded || yaw < (least > v->yaw_headroom ? least : v->yaw_headroom);
}

/* A common gain, by a forgetting average over samples whose own gain explains all rotors: none limited, none overridden. */
static void learn_gain(rw_mixer *m, const rw_vehicle *v, rw_time time, const rw_real *control, const rw_real *thrust)
{
    rw_real power = 0, product = 0, least = thrust[0], apart = 0, demand[N];
    for (int k = 0; k < N; k++) {
        demand[k] = mixed(v, control, k);
        power += demand[k] * demand[k];
        product += thrust[k] * demand[k];
        least = thrust[k] < least ? thrust[k] : least;
    }
    const rw_real own = product / (power > (rw_real)1e-12 ? power : (rw_real)1e-12);
    for (int k = 0; k < N; k++) {
        const rw_real off = magnitude(thrust[k] - own * demand[k]);
        apart = off > apart ? off : apart;
    }
    if (!(least > FLYING && apart < PART && own > (rw_real)0.6 && own < (rw_real)1.7)) return;
    const rw_real fade = (rw_real)exp((m->usable - time) / GAIN_MEMORY_S);
    m->above = m->above * fade + product;
    m->below = m->below * fade + power;
    m->usable = time;
    m->gain = m->above / m->below;
}

#if RW_MIXER_UNKNOWN
/* All factors, by recursive least squares of the thrusts on the rate controller's output. */
static void learn_mixer(rw_mixer *m, const rw_real *control, const rw_real *thrust, rw_real top)
{
    double x[RW_CONTROLS + 1], Px[RW_CONTROLS + 1], size = NOISE_SD * NOISE_SD;
    for (int k = 0; k < N; k++) {
        if (!(thrust[k] > FLYING && thrust[k] < (rw_real)0.95 * top)) return;
    }
    for (int c = 0; c <= RW_CONTROLS; c++) x[c] = c < RW_CONTROLS ? (double)control[c] : 1.0;
    for (int c = 0; c <= RW_CONTROLS; c++) {
        Px[c] = 0.0;
        for (int d = 0; d <= RW_CONTROLS; d++) Px[c] += m->spread[c][d] * x[d];
        size += x[c] * Px[c];
    }
    for (int k = 0; k < N; k++) {
        double left = (double)thrust[k];
        for (int c = 0; c <= RW_CONTROLS; c++) left -= x[c] * m->weights[c][k];
        for (int c = 0; c <= RW_CONTROLS; c++) m->weights[c][k] += Px[c] / size * left;
    }
    for (int c = 0; c <= RW_CONTROLS; c++) {
        for (int d = 0; d <= RW_CONTROLS; d++) m->spread[c][d] -= Px[c] / size * Px[d];
    }
}
#endif

/* Outputs against the rate controller's output of the same moment. */
static void compare(rw_mixer *m, const rw_vehicle *v, rw_time time, rw_time known, const rw_real *output, rw_real battery,
                    const rw_real *control, rw_comparison *c)
{
    c->time = time;
    c->known = known;
    c->top = curve(v, v->mixer_expo, v->u_max, battery);
    c->yaw_granted = grants_yaw(v, control);
    for (int k = 0; k < N; k++) {
        c->output[k] = output[k];
        c->demand[k] = curve(v, v->mixer_expo, output[k], battery);
        c->asked[k] = asks(m, v, control, k, &c->yaw[k]);
    }
    if (v->mixer_known) learn_gain(m, v, time, control, c->demand);
#if RW_MIXER_UNKNOWN
    else learn_mixer(m, control, c->demand, c->top);
#endif
    for (int k = 0; k < N; k++) {
        /* Each sample is judged by what was known before it; the first one by what it has taught. */
        if (!m->compared) c->asked[k] = asks(m, v, control, k, &c->yaw[k]);
        c->deviation[k] = c->demand[k] - clipped(c->asked[k], 0, c->top);
        const bool good = magnitude(c->deviation[k]) < PART;
        m->trusted[k] = good && m->good[k];
        m->good[k] = good;
    }
    m->compared = true;
    m->time = time;
}

int rw_mixer_outputs(rw_mixer *m, const rw_vehicle *v, rw_time time, const rw_real *output, bool valid, rw_real battery, rw_comparison *out)
{
    /* A sample of the rate controller before these outputs, if there is one. */
    int at = (int)m->control_count - 1;
    while (at >= 0 && !(m->control[at].time < time)) at--;
    if (at >= 0 && time - m->control[at].time < TOGETHER_S) {
        compare(m, v, time, time, output, battery, m->control[at].value, out);
        return 1;
    }
    if (at < 0 || !valid) return 0;
    if (m->pending_count == RW_PENDING) memmove(&m->pending[0], &m->pending[1], --m->pending_count * sizeof m->pending[0]);
    m->pending[m->pending_count].time = time;
    m->pending[m->pending_count].battery = battery;
    memcpy(m->pending[m->pending_count].output, output, sizeof m->pending[0].output);
    m->pending_count++;
    return 0;
}

int rw_mixer_control(rw_mixer *m, const rw_vehicle *v, rw_time time, const rw_real *control, bool valid, rw_comparison *out)
{
    int made = 0;
    if (!valid) return 0;
    for (int i = 0; i < m->pending_count; i++) {
        const rw_time then = m->pending[i].time, from = m->control[m->control_count - 1].time;
        const bool close = time - then < TOGETHER_S;
        rw_real between[RW_CONTROLS];
        if (!(time - then < PAIR_WITHIN_S) || !(close || then - from < PAIR_WITHIN_S)) continue;
        const rw_real share = close ? 1 : (rw_real)((then - from) / (time - from));
        for (int c = 0; c < RW_CONTROLS; c++) {
            between[c] = close ? control[c] : (1 - share) * m->control[m->control_count - 1].value[c] + share * control[c];
        }
        compare(m, v, then, time > then ? time : then, m->pending[i].output, m->pending[i].battery, between, &out[made++]);
    }
    m->pending_count = 0;
    if (m->control_count == 2) m->control[0] = m->control[1];
    else m->control_count++;
    m->control[m->control_count - 1].time = time;
    memcpy(m->control[m->control_count - 1].value, control, sizeof m->control[0].value);
    return made;
}

/* Inverse of the thrust curve: the share of the output's range, times battery, that gives `thrust`, 0 or more. */
static rw_real drive(rw_real expo, rw_real thrust)
{
    if (expo < (rw_real)1e-6) return thrust;
    return (rw_real)((sqrt((double)((1 - expo) * (1 - expo) + 4 * expo * thrust)) - (double)(1 - expo)) / (2.0 * (double)expo));
}

bool rw_mixer_thrust(const rw_mixer *m, const rw_vehicle *v, rw_time time, const rw_real *control, bool valid, rw_real battery,
                     rw_real *thrust, bool *ok)
{
    const rw_real top = curve(v, v->mixer_expo, v->u_max, battery);
    bool inside = valid && m->compared && time - m->time < FRESH_S && grants_yaw(v, control), any = false;
    for (int k = 0; k < N; k++) {
        rw_real yaw;
        const rw_real demand = asks(m, v, control, k, &yaw);
        const rw_real share = drive(v->mixer_expo, clipped(demand, 0, 1));
        inside = inside && demand > (rw_real)0.005 && demand < (rw_real)0.99 * top;
        thrust[k] = (1 - v->expo) * share + v->expo * share * share;
    }
    for (int k = 0; k < N; k++) {
        ok[k] = inside && m->trusted[k];
        any = any || ok[k];
    }
    return any;
}
