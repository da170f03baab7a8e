#include "rw_text.h"
#include "rw_names.h"

#include <string.h>

int rw_diagnoser_text(const rw_diagnoser *d, rw_texts *t, rw_time now, int most, char *text)
{
    static const char *const names[] = RW_NAMES;
    rw_words words;
    int32_t place;
    rw_texts_look(t, d->engine.changes.known, d->engine.changes.count);
    place = rw_texts_due(t, now, most);
    if (place < 0) return 0;
    rw_words_init(&words);
    rw_words_event(&words, &t->reported[place].event, !t->reported[place].present, names[t->reported[place].event.kind]);
    memcpy(text, words.at, RW_TEXT);
    return (int)rw_texts_tell(t, place, now);
}
