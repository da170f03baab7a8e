/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include "WorkItem.hpp"
#include <drivers/drv_hrt.h>
namespace px4
{
class ScheduledWorkItem : public WorkItem
{
public:
	void ScheduleDelayed(uint32_t delay_us);
	void ScheduleOnInterval(uint32_t interval_us, uint32_t delay_us = 0);
	void ScheduleClear();

protected:
	ScheduledWorkItem(const char *name, const wq_config_t &config) : WorkItem(name, config) {}
	virtual ~ScheduledWorkItem() override;

private:
	virtual void Run() override = 0;
};
}
