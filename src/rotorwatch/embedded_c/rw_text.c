#include "rw_text.h"

#include <math.h>
#include <string.h>

/* Texts grow in here. It holds more than may be sent, so that a long one is cut at the end alone. */
enum { ROOM = 64 };
typedef struct {
    char at[ROOM];
    int length;
} words;

static void add(words *w, const char *more)
{
    for (; *more && w->length < ROOM - 1; more++) w->at[w->length++] = *more;
    w->at[w->length] = 0;
}

static void number(words *w, int value)
{
    char digits[4] = {0, 0, 0, 0};
    int at = 3;
    for (; at > 0 && (value > 0 || at == 3); value /= 10) digits[--at] = (char)('0' + value % 10);
    add(w, &digits[at]);
}

/* A share, 0 to 1, in percent. */
static void percent(words *w, rw_real share) { number(w, (int)lrint(100.0 * (double)share)); }

/* "1+3" */
static void numbers(words *w, rw_rotors rotors)
{
    bool more = false;
    for (int k = 0; k < RW_ROTORS; k++) {
        if (!((rotors >> k) & 1)) continue;
        if (more) add(w, "+");
        number(w, k + 1);
        more = true;
    }
}

static bool several(rw_rotors rotors) { return (rotors & (rotors - 1u)) != 0; }

static bool is_over(const rw_event *e) { return e->kind != RW_CONTACT && e->end < RW_LASTS; }

enum rw_severity rw_text_severity(const rw_news *news)
{
    if (news->kind == RW_WITHDRAWN || news->event->kind == RW_CONTACT || is_over(news->event)) return RW_NOTICE;
    return news->event->alternative_count ? RW_WARNING : RW_CRITICAL;
}

int rw_text_words(const rw_news *news, char *text)
{
    const rw_event *e = news->event;
    words w = {{0}, 0}, others = {{0}, 0};
    add(&w, "rotorwatch: ");
    if (e->rotors) {
        add(&w, several(e->rotors) ? "rotors " : "rotor ");
        numbers(&w, e->rotors);
        add(&w, " ");
    }
    if (e->kind == RW_LOSS_OF_EFFECTIVENESS) {
        add(&w, "lost ");
        percent(&w, e->loss[0]);
        for (int k = 0, place = 0; k < RW_ROTORS; k++) {
            if (!((e->rotors >> k) & 1) || place++ == 0 || place > RW_TOGETHER) continue;
            add(&w, "/");
            percent(&w, e->loss[place - 1]);
        }
        add(&w, " %");
        if (!several(e->rotors)) {
            add(&w, " (");
            percent(&w, e->lower[0]);
            add(&w, "-");
            percent(&w, e->upper[0]);
            add(&w, ")");
        }
    } else {
        add(&w, e->kind == RW_CONTACT ? "knock or contact" : "output overridden");
    }
    if (news->kind == RW_WITHDRAWN) add(&w, " taken back");
    else if (is_over(e)) add(&w, " is over");
    else if (e->alternative_count && e->kind != RW_CONTACT) {
        add(&others, " or ");
        for (int i = 0; i < e->alternative_count; i++) {
            if (i) add(&others, ",");
            numbers(&others, e->alternatives[i]);
        }
        add(&w, w.length + others.length < RW_TEXT ? others.at : " or others");
    }
    if (w.length >= RW_TEXT) w.length = RW_TEXT - 1;
    memcpy(text, w.at, (size_t)w.length);
    text[w.length] = 0;
    return w.length;
}

const char *rw_text_verdict(enum rw_verdict verdict)
{
    switch (verdict) {
    case RW_HEALTHY: return "healthy so far";
    case RW_FAULT: return "fault found";
    case RW_AMBIGUOUS: return "ambiguous";
    case RW_NOT_JUDGED: break;
    }
    return "not judged yet";
}
