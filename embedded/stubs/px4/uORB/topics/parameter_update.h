/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <uORB/uORB.h>
struct parameter_update_s {
	uint64_t timestamp;
	uint32_t instance;
};
ORB_DECLARE(parameter_update);
