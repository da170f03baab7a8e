/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
#include <cstdint>
struct vehicle_acceleration_s {
	uint64_t timestamp;
	float xyz[3];
};
