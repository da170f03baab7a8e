/* An event in plain words, as the pilot reads it: the text of a mavlink STATUSTEXT, and its severity. Rotors count from 1 in words. */
#ifndef RW_TEXT_H
#define RW_TEXT_H

#include "rw_report.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Characters of a text with the 0 at its end. */
#define RW_TEXT 51

/* MAV_SEVERITY of mavlink. */
enum rw_severity { RW_CRITICAL = 2, RW_WARNING = 4, RW_NOTICE = 5 };

/* A lasting fault is critical, one of several explanations a warning, what is over or taken back a notice. */
enum rw_severity rw_text_severity(const rw_news *news);

/* "rotorwatch: rotor 3 lost 32 % (28-36)" into text[RW_TEXT]; returns its length. */
int rw_text_words(const rw_news *news, char *text);

/* The verdict in a word or two: "healthy so far". */
const char *rw_text_verdict(enum rw_verdict verdict);

#ifdef __cplusplus
}
#endif

#endif
