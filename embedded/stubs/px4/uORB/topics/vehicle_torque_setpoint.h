/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <uORB/uORB.h>
struct vehicle_torque_setpoint_s {
	uint64_t timestamp;
	uint64_t timestamp_sample;
	float xyz[3];
};
ORB_DECLARE(vehicle_torque_setpoint);
