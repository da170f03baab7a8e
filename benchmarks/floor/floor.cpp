// The four methods written by hand, as functions that a table is handed to.
#include <new>

#include "ekf.hpp"
#include "mhe.hpp"
#include "tsukf.hpp"

using namespace floor_;

template <class Filter>
static void run(std::int32_t rows, void *state, const double *u, const double *y, const std::uint8_t *valid, Kept *kept)
{
    Filter &filter = *static_cast<Filter *>(state);
    for (std::int32_t k = 0; k < rows; ++k)
        filter.step(u + NU * k, y + NY * k, valid + NY * k, kept[k]);
}

#define METHOD(name, Filter)                                                                                             \
    extern "C" std::int64_t name##_bytes() { return sizeof(Filter); }                                                    \
    extern "C" void name##_init(void *state) { (new (state) Filter)->init(); }                                           \
    extern "C" void name##_run(std::int32_t rows, void *state, const double *u, const double *y, const std::uint8_t *v,  \
                               Kept *kept)                                                                               \
    {                                                                                                                    \
        run<Filter>(rows, state, u, y, v, kept);                                                                         \
    }

METHOD(ekf, Ekf)
METHOD(ukf, Ukf)
METHOD(tsukf, Tsukf)
METHOD(mhe, Mhe)
