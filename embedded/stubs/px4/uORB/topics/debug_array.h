/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <uORB/uORB.h>
struct debug_array_s {
	uint64_t timestamp;
	uint16_t id;
	char name[10];
	float data[58];
};
ORB_DECLARE(debug_array);
