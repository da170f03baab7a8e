/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include "WorkQueueManager.hpp"
struct World; // what the test sets and reads: world.hpp
namespace px4
{
class WorkItem
{
public:
	WorkItem() = delete;
	WorkItem(const WorkItem &) = delete;
	WorkItem &operator=(const WorkItem &) = delete;
	void ScheduleNow();
	const char *ItemName() const { return _item_name; }
	virtual ~WorkItem();

protected:
	explicit WorkItem(const char *name, const wq_config_t &config);
	friend struct ::World;
	virtual void Run() = 0;
	const char *_item_name;
};
}
