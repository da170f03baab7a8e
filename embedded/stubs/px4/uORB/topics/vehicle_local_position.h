/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <uORB/uORB.h>
struct vehicle_local_position_s {
	uint64_t timestamp;
	uint64_t timestamp_sample;
	float x, y, z;
	float vx, vy, vz;
	bool xy_valid, z_valid, v_xy_valid, v_z_valid;
};
ORB_DECLARE(vehicle_local_position);
