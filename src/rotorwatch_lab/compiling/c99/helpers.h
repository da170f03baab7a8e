/* What exported sources need of these operations; project.py copies the functions that are used. */

static inline real r_max(real a, real b) { return a > b || isnan(a) ? a : b; }

static inline real r_min(real a, real b) { return a < b || isnan(a) ? a : b; }

static inline bool r_eq(real a, real b) { return a <= b && a >= b; }

static inline real r_square(real a) { return a * a; }

static inline real r_sign(real a) { return a > 0 ? R(1.0) : a < 0 ? R(-1.0) : a; }

static inline bool r_finite(real a) { return isfinite(a); }

static inline int32_t i_abs(int32_t a) { return a < 0 ? (int32_t)(0u - (uint32_t)a) : a; }

static inline int64_t l_abs(int64_t a) { return a < 0 ? (int64_t)((uint64_t)0 - (uint64_t)a) : a; }

static inline int32_t i_div(int32_t a, int32_t b)
{
    return b == 0 ? -1 : b == -1 ? (int32_t)(0u - (uint32_t)a) : a / b;
}

static inline int32_t i_rem(int32_t a, int32_t b) { return b == 0 ? a : b == -1 ? 0 : a % b; }

static inline int64_t l_div(int64_t a, int64_t b)
{
    return b == 0 ? -1 : b == -1 ? (int64_t)((uint64_t)0 - (uint64_t)a) : a / b;
}

static inline int64_t l_rem(int64_t a, int64_t b) { return b == 0 ? a : b == -1 ? 0 : a % b; }

static inline int32_t i_of(real a)
{
    return isnan(a) ? 0 : a >= R(2147483647.0) ? INT32_MAX : a <= R(-2147483648.0) ? INT32_MIN : (int32_t)a;
}

static inline int64_t l_of(real a)
{
    return isnan(a) ? 0 : a >= R(9223372036854775807.0) ? INT64_MAX : a <= R(-9223372036854775808.0) ? INT64_MIN : (int64_t)a;
}

static inline int32_t i_clamp(int64_t a, int32_t most)
{
    return a < 0 ? 0 : a > most ? most : (int32_t)a;
}
