/* What the pilot is shown of the events, as texts for a ground station: few, each of which says something new.

     static rw_texts t;
     rw_texts_init(&t);
     ... after each poll:
     char text[RW_TEXT];
     const int severity = rw_diagnoser_text(&d, &t, now, RW_NOTICE, text);
     if (severity > 0) send(severity, text);

   An event is reported once, again when it has become another one, and once more when it is over or taken back; at most one text in 5 s. */
#ifndef RW_TEXT_H
#define RW_TEXT_H

#include "rw_diagnoser.h"

#ifdef __cplusplus
extern "C" {
#endif

/* The text that is due `now` s, into text[RW_TEXT]. Returns its severity, that of MAVLink: RW_CRITICAL, RW_WARNING, RW_NOTICE or RW_INFO;
   0 where there is none. most: severity of the least grave events that are reported at all, 0 for none; of what was reported, the end is reported, too. */
int rw_diagnoser_text(const rw_diagnoser *d, rw_texts *t, rw_time now, int most, char *text);

#ifdef __cplusplus
}
#endif

#endif
