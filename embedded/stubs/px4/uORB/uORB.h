/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <stdint.h>
struct orb_metadata {
	const char *o_name;
	const uint16_t o_size;
};
typedef const struct orb_metadata *orb_id_t;
typedef void *orb_advert_t;
#define ORB_ID(_name) &__orb_##_name
#define ORB_DECLARE(_name) extern "C" const struct orb_metadata __orb_##_name __EXPORT
