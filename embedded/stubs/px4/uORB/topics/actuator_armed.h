/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <uORB/uORB.h>
struct actuator_armed_s {
	uint64_t timestamp;
	bool armed, prearmed, ready_to_arm, lockdown;
};
ORB_DECLARE(actuator_armed);
