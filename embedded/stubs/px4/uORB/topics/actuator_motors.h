/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <uORB/uORB.h>
struct actuator_motors_s {
	uint64_t timestamp;
	uint64_t timestamp_sample;
	float control[12];
	uint16_t reversible_flags;
	static constexpr uint8_t NUM_CONTROLS = 12;
};
ORB_DECLARE(actuator_motors);
