/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
#include <cstdint>
typedef uint64_t hrt_abstime;
hrt_abstime hrt_absolute_time();
