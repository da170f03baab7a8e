/* Flight logs of PX4 (ULog) and ArduPilot (DataFlash) through the diagnoser: a file's bytes in, an answer as JSON out.

     char *answer = rw_assess_log(data, size, "flight.ulg");
     ... free(answer);

   What a log is read for, and how: rotorwatch/logs. Memory comes from malloc, about as much as the file; nothing global changes. */
#ifndef RW_LOG_H
#define RW_LOG_H

#include "rw_engine.h"

#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

/* The answer to a log: {"verdict": ..., "events": [...], ...}, or {"error": "one sentence"} where it cannot be assessed. NULL only where
   there is no memory at all. name: of the file, shown in the answer. The caller frees it. */
char *rw_assess_log(const uint8_t *data, size_t size, const char *name);

#ifdef __cplusplus
}
#endif

/* Inside of the library from here on. */

#define RW_KINDS 10 /* of samples that a log is read for: RW_VOLTAGE to RW_RATES */
#define RW_SENTENCE 320

/* n samples of one kind in the order of time [s]: n x width values, NaN where unknown. */
typedef struct {
    size_t n, width;
    rw_time *time;
    double *value;
} rw_series;

typedef struct {
    char name[24];
    double value;
} rw_parameter;

/* A log as it is read. series: by kind; motors: RW_OUTPUTS; position: north, east, down. why: the sentence that refuses it, empty while there is none. */
typedef struct {
    const uint8_t *data;
    size_t size;
    rw_series series[RW_KINDS], position;
    rw_parameter *parameters;
    size_t parameter_count;
    const char *format, *autopilot, *motors; /* motors: the source of the outputs */
    bool pulses, warned_cut;                 /* outputs are in us, not shares; the log ends in the middle of a message */
    double pwm_min, pwm_max;                 /* limits of the outputs that the log names, 0: none */
    double mav_type;                         /* 0: unknown */
    rw_time end;                             /* of the log [s] */
    char frame[48], why[RW_SENTENCE];
    rw_vehicle vehicle;
    void **blocks; /* all memory, freed together */
    size_t block_count, block_room;
} rw_log;

/* rw_log.c. Every function that returns false has set `why`. */
bool rw_refuse(rw_log *log, const char *sentence, ...);
void *rw_reserve(rw_log *log, size_t count, size_t size); /* zeroed; NULL, refused, without any */
void rw_release(rw_log *log, size_t kept); /* give back all but the first blocks */
void rw_log_close(rw_log *log);
bool rw_series_new(rw_log *log, rw_series *s, size_t n, size_t width);
bool rw_series_settle(rw_log *log, rw_series *s, double limit); /* impossible values and times removed, as logs/series.py */
double rw_parameter_of(const rw_log *log, const char *name, double otherwise);
bool rw_parameter_add(rw_log *log, const char *name, size_t length, double value);
double rw_ranked(rw_log *log, const double *x, size_t n, size_t k); /* the k-th smallest; x (n,) without NaN; NaN for none */
double rw_quantile(rw_log *log, const double *x, size_t n, double share);
double rw_median(rw_log *log, const double *x, size_t n);
double rw_rate_hz(rw_log *log, const rw_series *s);
bool rw_whole(const rw_series *s, size_t row);
void rw_eigen(int n, double *a, double *vector); /* symmetric a (n, n): eigenvalues on its diagonal, eigenvectors in rows of `vector` */

/* The readers, their values that are damage, and the airframe. */
bool rw_without_damage(rw_log *log);
bool rw_outputs_flew(rw_log *log, const rw_time *starts, const rw_time *ends, size_t flights);
bool rw_ulog_read(rw_log *log);
bool rw_dataflash_read(rw_log *log);
bool rw_px4_airframe(rw_log *log);
bool rw_ardupilot_airframe(rw_log *log, const char *announced);

#endif
