/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
#include <cstdint>
struct vehicle_attitude_s {
	uint64_t timestamp;
	float q[4];
};
