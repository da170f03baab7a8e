/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <math.h>
#include <stdint.h>
#define PX4_OK 0
#define PX4_ERROR (-1)
#define PX4_ISFINITE(x) __builtin_isfinite(x)
