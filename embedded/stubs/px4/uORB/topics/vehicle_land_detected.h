/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <uORB/uORB.h>
struct vehicle_land_detected_s {
	uint64_t timestamp;
	bool freefall, ground_contact, maybe_landed, landed, in_ground_effect;
};
ORB_DECLARE(vehicle_land_detected);
