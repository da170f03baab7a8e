/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
#include <cstdint>
struct vehicle_angular_velocity_s {
	uint64_t timestamp, timestamp_sample;
	float xyz[3];
};
