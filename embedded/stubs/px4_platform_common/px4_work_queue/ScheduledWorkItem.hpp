/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
namespace px4
{
struct wq_config_t {
	const char *name;
};
namespace wq_configurations
{
static constexpr wq_config_t nav_and_controllers{"wq:nav_and_controllers"};
static constexpr wq_config_t lp_default{"wq:lp_default"};
}
class ScheduledWorkItem
{
public:
	ScheduledWorkItem(const char *, const wq_config_t &) {}
	virtual ~ScheduledWorkItem() = default;

protected:
	virtual void Run() = 0;
	void ScheduleOnInterval(unsigned) {}
	void ScheduleClear() {}
};
}
