/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
namespace px4
{
enum class params { ROTW_EN, ROTW_TEXT };
}
