/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
#include <cstdint>
struct debug_array_s {
	uint64_t timestamp;
	float data[58];
};
