/* Of what the export generates, as much as the rest of the library calls, to compile that without it. MIT. */
#ifndef RW_ESTIMATOR_H
#define RW_ESTIMATOR_H
#include "rw_front.h"
#ifdef __cplusplus
extern "C" {
#endif
typedef struct {
    char nothing;
} rw_estimator_state;
typedef struct {
    char nothing;
} rw_estimator_workspace;
typedef struct {
    rw_real theta[RW_ROTORS], theta_sd[RW_ROTORS], gives[RW_ROTORS], share[RW_PLACES], onsets[RW_PLACES];
    rw_real probability[RW_HYPOTHESES], log_odds[RW_HYPOTHESES];
    rw_real opposite_onset, opposite_loss[2];
    int32_t opposite;
    bool active[RW_PLACES * RW_ROTORS], announced;
} rw_estimator_out;
void rw_estimator_init(rw_estimator_state *state, rw_estimator_workspace *work);
void rw_estimator_step(rw_estimator_state *state, const rw_real *u, const rw_real *y, const bool *valid, rw_estimator_out *out,
                       rw_estimator_workspace *work);
#ifdef __cplusplus
}
#endif
#endif
