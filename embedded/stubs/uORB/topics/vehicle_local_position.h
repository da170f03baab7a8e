/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
#include <cstdint>
struct vehicle_local_position_s {
	uint64_t timestamp;
	bool v_xy_valid, v_z_valid;
	float vx, vy, vz;
};
