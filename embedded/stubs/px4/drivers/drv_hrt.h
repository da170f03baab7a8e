/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <stdint.h>
typedef uint64_t hrt_abstime;
__BEGIN_DECLS
__EXPORT hrt_abstime hrt_absolute_time(void);
__END_DECLS
namespace time_literals
{
static constexpr hrt_abstime operator""_s(unsigned long long seconds) { return hrt_abstime(seconds) * 1000000ull; }
static constexpr hrt_abstime operator""_ms(unsigned long long milliseconds) { return hrt_abstime(milliseconds) * 1000ull; }
static constexpr hrt_abstime operator""_us(unsigned long long microseconds) { return hrt_abstime(microseconds); }
}
