#include "rw_events.h"

#include <math.h>
#include <string.h>

#define N RW_ROTORS
#define PAIRS (N * (N - 1) / 2)
#define BIT(k) ((rw_rotors)(1u << (unsigned)(k)))
#define R(x) ((rw_real)(x))

#ifdef ROTORWATCH_FLOAT
#define ROOT sqrtf
#define POWER_OF_E expf
#else
#define ROOT sqrt
#define POWER_OF_E exp
#endif

/* default/events.py says what these are. */
static const rw_real CREDIBLE = R(0.03), CERTAIN_OPPOSITE = R(0.99), CLEAR_SHARE = R(10.0 / 11.0);
static const rw_real MODEL_SD = R(0.004), CURVE_SHARE = R(0.08), CURVE_AND_COAXIAL_SHARE = R(0.1);
static const rw_real HIDDEN = R(20.0), PAIR_WEIGHT = R(1e-4);
static const rw_real WITHIN_95 = R(1.96);
static const rw_real CANCELS = R(0.05); /* of the largest lever */

static rw_real magnitude(rw_real x) { return x < 0 ? -x : x; }

static rw_rotors without(rw_rotors all, rw_rotors some) { return (rw_rotors)(all & (rw_rotors)~some); }

static bool two(rw_rotors set)
{
    int count = 0;
    for (int k = 0; k < N; k++) count += (set & BIT(k)) != 0;
    return count == 2;
}

static int lowest(rw_rotors set)
{
    int k = 0;
    while (k < N - 1 && !(set & BIT(k))) k++;
    return k;
}

/* Rotors that cancel the roll and pitch torque of rotor i: with those it can share a loss almost unseen. */
static rw_rotors opposite_of(const rw_vehicle *v, int i)
{
    rw_rotors found = 0;
    for (int j = 0; j < N; j++) {
        const bool roll = magnitude(v->effectiveness[RW_ROLL][i] + v->effectiveness[RW_ROLL][j]) < CANCELS;
        const bool pitch = magnitude(v->effectiveness[RW_PITCH][i] + v->effectiveness[RW_PITCH][j]) < CANCELS;
        if (j != i && roll && pitch) found |= BIT(j);
    }
    return found;
}

/* Rotors i < j of the pair with this number among the estimator's pairs. */
static void pair_of(int number, int *i, int *j)
{
    int first = 0;
    while (first < N - 2 && number >= N - 1 - first) {
        number -= N - 1 - first;
        first++;
    }
    *i = first;
    *j = first + 1 + number;
}

static int number_of(int i, int j) { return i * (2 * N - i - 1) / 2 + (j - i - 1); }

/* ---- Records. */

static void book_init(rw_book *b)
{
    memset(b, 0, sizeof *b);
    for (int k = 0; k < N; k++) b->of[k] = -1;
    b->suspicion = b->asked = -1;
}

static int8_t after_removal(int8_t place, int gone) { return (int8_t)(place == gone ? -1 : place > gone ? place - 1 : place); }

static void removed(rw_book *b, int gone)
{
    for (int i = gone; i + 1 < b->count; i++) b->records[i] = b->records[i + 1];
    b->count--;
    for (int k = 0; k < N; k++) b->of[k] = after_removal(b->of[k], gone);
    b->suspicion = after_removal(b->suspicion, gone);
    b->asked = after_removal(b->asked, gone);
}

/* Room for one more record: where there is none, that of the loss that ended first, else of the oldest suspicion, else the oldest. */
static rw_record *added(rw_book *b)
{
    if (b->count >= RW_RECORDS) {
        int least = -1;
        for (int i = 0; i < b->count; i++) {
            if (b->records[i].end < RW_LASTS && (least < 0 || b->records[i].end < b->records[least].end)) least = i;
        }
        for (int i = 0; least < 0 && i < b->count; i++) {
            if (b->records[i].suspicion) least = i;
        }
        removed(b, least < 0 ? 0 : least);
        if (b->forgotten < UINT16_MAX) b->forgotten++;
    }
    rw_record *const r = &b->records[b->count++];
    memset(r, 0, sizeof *r);
    r->end = RW_LASTS;
    return r;
}

static void only(rw_record *r, rw_rotors set)
{
    r->rotors = r->sets[0] = set;
    r->share[0] = 1;
    r->count = 1;
    r->hiding = 0;
}

/* ---- Courses of estimates. */

static void pushed(rw_course *c, int32_t tick, rw_real theta, rw_real sd)
{
    if (c->step == 0) c->step = 1;
    if (c->seen % c->step == 0) {
        if (c->kept == RW_ESTIMATES) {
            for (int i = 0; i < RW_ESTIMATES / 2; i++) {
                c->tick[i] = c->tick[2 * i];
                c->theta[i] = c->theta[2 * i];
                c->sd[i] = c->sd[2 * i];
            }
            c->kept = RW_ESTIMATES / 2;
            c->step *= 2;
        }
        c->tick[c->kept] = tick;
        c->theta[c->kept] = theta;
        c->sd[c->kept] = sd;
        c->kept++;
    }
    c->seen++;
}

/* What a loss that is over was for most of its time: where the first of its rotors was at its median up to the tick `last`. */
static void usual(rw_record *r, const rw_course *courses, int32_t last)
{
    const rw_course *const first = &courses[lowest(r->rotors)];
    rw_real ordered[RW_ESTIMATES];
    int count = 0, best = 0;
    for (int i = 0; i < first->kept && (i == 0 || first->tick[i] <= last); i++) {
        int j = count++;
        for (; j > 0 && ordered[j - 1] > first->theta[i]; j--) ordered[j] = ordered[j - 1];
        ordered[j] = first->theta[i];
    }
    if (count == 0) return;
    while (first->theta[best] < ordered[(count - 1) / 2] || first->theta[best] > ordered[(count - 1) / 2]) best++;
    for (int k = 0, place = 0; k < N && place < RW_TOGETHER; k++) {
        if (r->rotors & BIT(k)) {
            r->loss[place] = courses[k].theta[best];
            r->sd[place] = courses[k].sd[best];
            place++;
        }
    }
}

/* ---- Times. */

static int slot(int32_t tick) { return (int)(tick % RW_TICKS_KEPT); }

/* The earliest tick of this flight that is kept. */
static int32_t earliest(const rw_events *s)
{
    const int32_t kept = s->tick - RW_TICKS_KEPT + 1;
    return kept > s->first ? kept : s->first;
}

static rw_time command_time(const rw_events *s, int32_t tick)
{
    return tick <= s->first ? s->first_onset : s->time[slot(tick)] - (rw_time)s->age[slot(tick)];
}

/* The tick of a jump `since` ticks ago, not before this flight. */
static int32_t jumped(const rw_events *s, rw_real since)
{
    const int32_t tick = since >= 0 && since < R(1e9) ? s->tick - (int32_t)(since + R(0.5)) : s->first;
    return tick > s->first ? tick : s->first;
}

static rw_onset nearest(const rw_onset *onsets, int32_t tick)
{
    int best = 0;
    for (int p = 1; p < RW_PLACES; p++) {
        const int32_t apart = onsets[p].tick - tick, least = onsets[best].tick - tick;
        if ((apart < 0 ? -apart : apart) < (least < 0 ? -least : least)) best = p;
    }
    return onsets[best];
}

/* When each of the explanations of this tick may have begun. What began before the bank's reach was there at the last announcement. */
static void onsets_now(rw_events *s, const rw_found *found, rw_time now)
{
    rw_onset made[RW_PLACES];
    const int32_t reach = earliest(s);
    for (int p = 0; p < RW_PLACES; p++) {
        const int32_t tick = jumped(s, found->onsets[p]);
        int32_t before;
        if (tick == s->first && tick < reach) { /* nothing has jumped in this flight */
            made[p] = (rw_onset){s->first_onset, tick, tick - 1};
            continue;
        }
        if (tick < reach || (tick < s->tick - RW_REACH && s->announced)) {
            made[p] = s->announced ? nearest(s->onsets, tick) : (rw_onset){command_time(s, reach), reach, reach - 1};
            continue;
        }
        made[p].tick = tick;
        made[p].onset = command_time(s, tick);
        if (made[p].onset > now) made[p].onset = now;
        for (before = tick; before >= reach && s->time[slot(before)] >= made[p].onset; before--) {
        }
        while (before < s->tick && s->time[slot(before + 1)] < made[p].onset) before++;
        made[p].before = before;
    }
    memcpy(s->onsets, made, sizeof made);
}

/* ---- What an announcement has become: into the book. */

static void weigh(rw_record *r, const rw_standing *at, rw_rotors before)
{
    rw_real sum = 0;
    r->count = 0;
    for (int p = 0; p < RW_PLACES; p++) {
        const rw_rotors other = without(at->active[p], before);
        int i = 0;
        if (other == 0) continue; /* that nothing broke is weighed before anything is announced */
        while (i < r->count && r->sets[i] != other) i++;
        if (i == r->count) {
            r->sets[i] = other;
            r->share[i] = 0;
            r->count++;
        }
        r->share[i] += at->share[p];
        sum += at->share[p];
    }
    for (int i = 0; i < r->count && sum > 0; i++) r->share[i] /= sum;
}

static void settle(rw_book *b, const rw_events *s, const rw_standing *at)
{
    const rw_rotors now = at->active[0], gone = without(s->before, now), fresh = without(now, s->before);
    const rw_onset began = nearest(s->onsets, at->onset);
    if (!s->announced) return;
    for (int k = 0; k < N; k++) {
        const int place = b->of[k];
        rw_record *r;
        if (!(gone & BIT(k)) || place < 0) continue;
        r = &b->records[place];
        const rw_rotors ended = (rw_rotors)(r->rotors & gone);
        if (ended != r->rotors) { /* the others are weak still: a record of its own for those that work again */
            const rw_record whole = *r;
            only(r, without(r->rotors, ended));
            r = added(b);
            *r = whole;
            only(r, ended);
        }
        r->end = began.onset;
        usual(r, s->then, began.before);
        for (int j = k; j < N; j++) {
            if (ended & BIT(j)) b->of[j] = -1;
        }
    }
    if (fresh) {
        rw_time onset = began.onset, detected = at->found;
        rw_rotors suspected = 0;
        if (b->asked >= 0) { /* what opposite rotors were suspected of is now known */
            const rw_record *const suspect = &b->records[b->asked];
            for (int i = 0; i < suspect->count; i++) suspected |= suspect->sets[i];
            if (without(fresh, suspected) == 0) {
                onset = suspect->onset;
                detected = suspect->detected;
                removed(b, b->asked);
            }
        }
        rw_record *const r = added(b);
        r->onset = onset;
        r->detected = detected;
        r->rotors = fresh;
        r->hiding = s->hiding;
        r->hider = s->hider;
        weigh(r, at, s->before);
        for (int k = 0; k < N; k++) {
            if (fresh & BIT(k)) b->of[k] = (int8_t)(b->count - 1);
        }
    }
}

/* The flight is over: what lasted until the landing ended there. */
static void landed(rw_events *s)
{
    if (s->flown) {
        settle(&s->book, s, &s->judged);
        for (int k = 0; k < N; k++) {
            rw_record *const r = s->book.of[k] < 0 ? NULL : &s->book.records[s->book.of[k]];
            if (r && r->end >= RW_LASTS) {
                r->end = s->judged_time;
                usual(r, s->courses, s->tick);
            }
        }
    }
    for (int k = 0; k < N; k++) s->book.of[k] = -1;
    s->book.suspicion = s->book.asked = -1;
    s->announced = s->flown = false;
    s->before = 0;
}

/* ---- What is written down when something is announced or suspected. */

/* Pairs that only their rarity, not the data, rules out against the likeliest rotor: it and the ones opposite. */
static void hidden_pairs(rw_events *s, const rw_vehicle *v, const rw_real *probability)
{
    rw_real best = -1;
    int likeliest = -1;
    for (int k = 0; k < N; k++) {
        const rw_real p = probability[k] + probability[N + PAIRS + k];
        if (p > best) {
            best = p;
            likeliest = k;
        }
    }
    s->hiding = 0;
    for (int k = 0; k < PAIRS; k++) {
        if (probability[N + k] > best) return;
    }
    s->hider = (uint8_t)likeliest;
    const rw_rotors partners = opposite_of(v, likeliest);
    for (int j = 0; j < N; j++) {
        const int pair = j < likeliest ? number_of(j, likeliest) : number_of(likeliest, j);
        if ((partners & BIT(j)) && probability[N + pair] > HIDDEN * best * PAIR_WEIGHT) s->hiding |= BIT(j);
    }
}

/* A sudden shift of thrust that may be two opposite rotors. */
static void suspected(rw_events *s, const rw_vehicle *v, const rw_found *found, rw_time now)
{
    rw_record *const r = added(&s->book);
    int i, j;
    rw_real sum = 0;
    const int32_t tick = jumped(s, found->opposite_onset), reach = earliest(s);
    s->book.suspicion = (int8_t)(s->book.count - 1);
    r->suspicion = true;
    r->onset = command_time(s, tick < reach ? reach : tick);
    r->detected = now;
    pair_of((int)found->opposite - N, &i, &j);
    r->rotors = (rw_rotors)(BIT(i) | BIT(j));
    r->loss[0] = r->loss[1] = R(0.5) * (found->opposite_loss[0] + found->opposite_loss[1]);
    for (int pair = 0; pair < PAIRS; pair++) {
        rw_real odds;
        int place;
        pair_of(pair, &i, &j);
        if (!(opposite_of(v, i) & BIT(j)) || r->count == RW_SETS) continue;
        odds = found->log_odds[N + pair];
        for (place = r->count; place > 0 && r->share[place - 1] < odds; place--) {
            r->share[place] = r->share[place - 1];
            r->sets[place] = r->sets[place - 1];
        }
        r->share[place] = odds;
        r->sets[place] = (rw_rotors)(BIT(i) | BIT(j));
        r->count++;
    }
    const rw_real most = r->share[0];
    for (i = 0; i < r->count; i++) {
        r->share[i] = POWER_OF_E(r->share[i] - most);
        sum += r->share[i];
    }
    for (i = 0; i < r->count; i++) r->share[i] /= sum;
}

/* ---- Tick by tick. */

void rw_events_init(rw_events *s)
{
    memset(s, 0, sizeof *s);
    book_init(&s->book);
    s->tick = -1;
}

static void look(rw_events *s, const rw_found *found, rw_standing *now)
{
    for (int p = 0; p < RW_PLACES; p++) {
        now->active[p] = 0;
        now->share[p] = found->share[p];
        for (int k = 0; k < N; k++) {
            if (found->active[p * N + k]) now->active[p] |= BIT(k);
        }
    }
    now->onset = jumped(s, found->since);
}

void rw_events_tick(rw_events *s, const rw_vehicle *v, const rw_tick *tick, const rw_found *found)
{
    if (tick->restart && s->tick >= 0) landed(s);
    s->tick++;
    if (tick->restart || s->tick == 0) {
        s->first = s->tick;
        s->first_onset = tick->command_time;
    }
    s->time[slot(s->tick)] = tick->time;
    s->age[slot(s->tick)] = (rw_real)(tick->time - tick->command_time);
    if (found->announced) {
        settle(&s->book, s, &s->latest);
        if (s->announced) s->before = s->latest.active[0];
        onsets_now(s, found, tick->time);
        memcpy(s->then, s->courses, sizeof s->then);
        hidden_pairs(s, v, found->probability);
        s->book.asked = s->book.suspicion;
        s->announced = true;
    }
    if (s->announced) {
        const rw_rotors led = s->latest.active[0];
        look(s, found, &s->latest);
        if (found->announced || s->latest.active[0] != led) {
            s->latest.found = tick->time;
            for (int k = 0; k < N; k++) { /* what is estimated of rotors that no settled record holds begins here */
                if (!(s->before & BIT(k))) memset(&s->courses[k], 0, sizeof s->courses[k]);
            }
        }
    }
    if (found->opposite >= N && found->opposite < N + PAIRS) suspected(s, v, found, tick->time);
    if (tick->mode != RW_JUDGE) return;
    s->judged = s->latest;
    s->judged_time = tick->time;
    s->flown = true;
    for (int k = 0; k < N; k++) {
        s->theta[k] = found->theta[k];
        s->sd[k] = found->theta_sd[k];
        if (s->announced && ((s->before | s->latest.active[0]) & BIT(k))) {
            pushed(&s->courses[k], s->tick, s->theta[k], s->sd[k]);
        }
    }
}

/* ---- What it comes to. */

static bool named(const rw_event *e, rw_rotors set)
{
    for (int i = 0; i < e->alternative_count; i++) {
        if (e->alternatives[i] == set) return true;
    }
    return set == e->rotors;
}

static void name(rw_event *e, rw_rotors set)
{
    if (!named(e, set) && e->alternative_count < RW_ALTERNATIVES) e->alternatives[e->alternative_count++] = set;
}

/* The standard deviation of a loss with what the model of the vehicle is uncertain of: default/events.py, sd_of. */
static rw_real sd_of(const rw_vehicle *v, rw_real loss, rw_real sd)
{
    const rw_real share = v->coaxial ? CURVE_AND_COAXIAL_SHARE : CURVE_SHARE;
    const rw_real left = loss > 1 ? R(1e-9) : loss < 0 ? R(1) : R(1) - loss > R(1e-9) ? R(1) - loss : R(1e-9);
    const rw_real curve = share * loss * left / (left + share * loss);
    return ROOT(sd * sd + MODEL_SD * MODEL_SD + curve * curve);
}

static void told(const rw_record *r, const rw_events *s, const rw_vehicle *v, rw_event *e)
{
    const int first = lowest(r->rotors);
    const bool paired = N > 4 && two(r->rotors) && without(r->rotors, BIT(first)) == (without(r->rotors, BIT(first)) & opposite_of(v, first));
    bool own = false, hidden = false;
    rw_real most = 0;
    memset(e, 0, sizeof *e);
    e->kind = RW_LOSS_OF_EFFECTIVENESS;
    e->onset = r->onset;
    e->detected = r->detected;
    e->end = r->end;
    e->rotors = r->rotors;
    for (int k = 0, place = 0; k < N && place < RW_TOGETHER; k++) {
        rw_real loss, sd;
        if (!(r->rotors & BIT(k))) continue;
        loss = r->suspicion || r->end < RW_LASTS ? r->loss[place] : s->theta[k];
        sd = r->end < RW_LASTS ? r->sd[place] : s->sd[k];
        sd = r->suspicion ? loss / WITHIN_95 : sd_of(v, loss, sd); /* of a shared shift each may hold anything from nothing to all */
        e->loss[place] = loss;
        e->lower[place] = loss - WITHIN_95 * sd > 0 ? loss - WITHIN_95 * sd : 0;
        e->upper[place] = loss + WITHIN_95 * sd < 1 ? loss + WITHIN_95 * sd : 1;
        place++;
    }
    for (int i = 0; i < r->count; i++) {
        if (r->sets[i] == r->rotors) {
            e->probability = r->share[i];
            own = true;
        }
        if (r->share[i] > most) most = r->share[i];
    }
    if (!own) e->probability = most;
    for (int j = 0; j < N && !r->suspicion; j++) hidden |= (r->hiding & BIT(j)) && (rw_rotors)(BIT(j) | BIT(r->hider)) != r->rotors;
    if (!r->suspicion && !hidden && e->probability >= (paired ? CERTAIN_OPPOSITE : CLEAR_SHARE)) return;
    for (int j = 0; j < N && !r->suspicion; j++) {
        if (r->hiding & BIT(j)) name(e, (rw_rotors)(BIT(j) | BIT(r->hider)));
    }
    for (int i = 0; i < r->count; i++) {
        if (r->suspicion || r->share[i] >= CREDIBLE) name(e, r->sets[i]);
    }
    for (int i = 0; i < N && paired; i++) { /* all that only a manoeuvre could tell apart */
        const rw_rotors partners = opposite_of(v, i);
        for (int j = i + 1; j < N; j++) {
            if (partners & BIT(j)) name(e, (rw_rotors)(BIT(i) | BIT(j)));
        }
    }
}

int rw_events_losses(const rw_events *s, const rw_vehicle *v, rw_event *out)
{
    rw_book book = s->book;
    uint8_t order[RW_RECORDS];
    if (s->flown) settle(&book, s, &s->judged);
    for (int i = 0; i < book.count; i++) {
        int place = i;
        for (; place > 0 && book.records[order[place - 1]].detected > book.records[i].detected; place--) order[place] = order[place - 1];
        order[place] = (uint8_t)i;
    }
    for (int i = 0; i < book.count; i++) told(&book.records[order[i]], s, v, &out[i]);
    return book.count;
}
