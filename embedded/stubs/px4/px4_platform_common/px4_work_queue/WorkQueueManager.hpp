/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <stdint.h>
namespace px4
{
struct wq_config_t {
	const char *name;
	uint16_t stacksize;
	int8_t relative_priority; // to the highest
};
namespace wq_configurations
{
static constexpr wq_config_t rate_ctrl{"wq:rate_ctrl", 3150, 0};
static constexpr wq_config_t nav_and_controllers{"wq:nav_and_controllers", 2240, -13};
static constexpr wq_config_t hp_default{"wq:hp_default", 2800, -18};
static constexpr wq_config_t lp_default{"wq:lp_default", 3500, -50};
}
}
