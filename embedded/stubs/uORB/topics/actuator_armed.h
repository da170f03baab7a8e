/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
#include <cstdint>
struct actuator_armed_s {
	uint64_t timestamp;
	bool armed;
};
