#include "rw_ticks.h"

#include <string.h>

#define N RW_ROTORS
#define R(x) ((rw_real)(x))

/* motion/ticks.py says what these are. */
static const rw_time SETTLE_S = 1.0, TUMBLE_S = 0.3;
static const rw_real UPSET_RATE = R(6.0), UPSET_LEVEL = R(0.42261826174069944); /* rad/s; cosine of 65 degrees */
static const rw_real CONTROLLED_SHARE = R(0.9), CONTROLLED_RATE = R(2.0);
static const rw_real LEAST_HOVER = R(0.02);
enum { AGAIN = 2 };

static rw_real magnitude(rw_real x) { return x < 0 ? -x : x; }

/* x, which is sorted, with one more value; all of `count` then. */
static void sorted_in(rw_real *x, int count, rw_real value)
{
    int i = count - 1;
    for (; i > 0 && x[i - 1] > value; i--) x[i] = x[i - 1];
    x[i] = value;
}

static rw_real middle(const rw_real *x, int count) { return count % 2 ? x[count / 2] : R(0.5) * (x[count / 2 - 1] + x[count / 2]); }

void rw_ticks_init(rw_ticks *s)
{
    memset(s, 0, sizeof *s);
    rw_contact_init(&s->contact);
    s->flight = RW_LASTS;
    s->hop = -RW_LASTS;
    s->hover = 1;
    s->learned = -1;
}

void rw_ticks_settle(rw_ticks *s, const rw_sensed *row, rw_time start)
{
    rw_real load = 1, sum = 0;
    if (s->flight < start || s->flight > start) {
        s->flight = start;
        s->settled = 0;
    }
    for (int k = 0; k < N; k++) sum += row->share[k];
    if (!row->some || !(sum > 0) || !(row->when >= start && row->when < start + SETTLE_S) || s->settled == RW_SETTLING) return;
    if (row->load_ok) load = row->load < R(0.5) ? R(0.5) : row->load > R(2.0) ? R(2.0) : row->load;
    s->settled++;
    sorted_in(s->settling, s->settled, sum / R(N) / load);
}

/* What carries the vehicle from the start of this flight on. */
static void hovers(rw_ticks *s, const rw_plan *p, const rw_sensed *row)
{
    rw_real level = p->hover;
    if (!(level > 0) && s->settled > 0) level = middle(s->settling, s->settled);
    if (!(level > 0)) { /* nothing was commanded in its first second */
        rw_real ordered[N];
        for (int k = 0; k < N; k++) sorted_in(ordered, k + 1, row->share[k]);
        level = middle(ordered, N);
    }
    s->hover = level > LEAST_HOVER ? level : LEAST_HOVER;
    s->flight = RW_LASTS;
}

void rw_ticks_make(rw_ticks *s, const rw_vehicle *v, const rw_plan *p, const rw_sensed *row, rw_time start, rw_made *out)
{
    const bool inside = start < RW_LASTS;
    const int width = (int)(TUMBLE_S / p->dt + 0.5) > 2 ? (int)(TUMBLE_S / p->dt + 0.5) : 2;
    rw_real fastest = 0, most = 0;
    bool fresh, controlled, turns = false;
    rw_shove shove;
    memset(out, 0, sizeof *out);
    if (!s->begun && p->hover > 0) s->hover = p->hover;
    s->begun = true;
    out->tick.time = row->time;
    out->tick.command_time = row->when;
    out->tick.air_start = start;
    out->tick.restart = inside && (start < s->hop || start > s->hop);
    if (s->flight <= row->time ? s->settled > 0 || inside : out->tick.restart && s->settled == 0) hovers(s, p, row);
    if (out->tick.restart) {
        s->hop = start;
        s->gone = false;
        s->tumbling = 0;
        s->learned = -1;
        s->settled = 0;
    }
    out->tick.mode = !inside ? RW_GROUND : row->time >= start + p->ready ? RW_JUDGE : RW_LEARN;

    /* Once tumbling, never hovering again in this flight. */
    fastest = magnitude(row->rate[0]) > magnitude(row->rate[1]) ? magnitude(row->rate[0]) : magnitude(row->rate[1]);
    out->tick.upset = fastest > UPSET_RATE || row->level < UPSET_LEVEL;
    s->tumbling = (int16_t)(!(inside && out->tick.upset) ? 0 : s->tumbling < width ? s->tumbling + 1 : width);
    s->gone = s->gone || s->tumbling >= width;
    out->tick.upset = out->tick.upset || (s->gone && inside);
    fastest = fastest > magnitude(row->rate[2]) ? fastest : magnitude(row->rate[2]);

    for (int k = 0; k < N; k++) {
        const rw_real thrust = row->share[k] / s->hover;
        out->u[RW_U_THRUST + k] = shove.thrust[k] = thrust;
        for (int a = 0; a < RW_AXES; a++) out->y[a] += v->effectiveness[a][k] * thrust;
        turns = turns || magnitude(v->effectiveness[RW_YAW][k]) > 0;
        most = row->share[k] > most ? row->share[k] : most;
    }
    fresh = row->some && row->rate_ok && (row->load_ok || !p->accel) && inside;
    shove.time = row->time;
    for (int a = 0; a < 3; a++) {
        shove.torque[a] = out->y[a];
        shove.rate_dot[a] = row->rate_dot[a];
    }
    shove.side[0] = row->push[0];
    shove.side[1] = row->push[1];
    shove.load = row->load;
    shove.shake = row->shake;
    shove.fresh = fresh;
    shove.accelerometer = p->accel;
    out->touch = rw_contact_tick(&s->contact, &shove);

    controlled = fresh && most < CONTROLLED_SHARE && fastest < CONTROLLED_RATE;
    if (out->touch.hit) s->learned = 0;
    else if (s->learned >= 0 && controlled) s->learned++;
    if (out->tick.mode == RW_JUDGE && s->learned >= 0 && s->learned < (int32_t)(p->ready / p->dt + 0.5)) out->tick.mode = RW_LEARN;

    for (int a = 0; a < RW_AXES; a++) {
        out->valid[a] = row->some && (a == RW_THRUST ? row->load_ok : row->rate_ok) && !out->tick.upset && !out->touch.hit && inside;
    }
    out->valid[RW_YAW] = out->valid[RW_YAW] && turns; /* rotors that make no yaw torque explain none */
    for (int a = 0; a < 3; a++) {
        out->u[RW_U_RATE_DOT + a] = row->rate_dot[a];
        out->u[RW_U_RATE + a] = row->rate[a];
    }
    out->u[RW_U_LOAD] = row->load * R(N);
    out->u[RW_U_SIDE] = row->side[0];
    out->u[RW_U_SIDE + 1] = row->side[1];
    out->u[RW_U_FULL] = 1 / s->hover;
    out->u[RW_U_MODE] = out->tick.mode;
    out->u[RW_U_AGAIN] = out->touch.hit ? AGAIN : out->tick.restart ? 1 : 0;
}
