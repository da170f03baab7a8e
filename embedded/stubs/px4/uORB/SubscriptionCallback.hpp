/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <px4_platform_common/px4_work_queue/ScheduledWorkItem.hpp>
#include <uORB/SubscriptionInterval.hpp>
namespace uORB
{
class SubscriptionCallbackWorkItem : public SubscriptionInterval
{
public:
	SubscriptionCallbackWorkItem(px4::WorkItem *work_item, const orb_metadata *meta, uint8_t instance = 0) :
		SubscriptionInterval(meta, 0, instance), _work_item(work_item) {}
	virtual ~SubscriptionCallbackWorkItem() {}
	bool registerCallback();
	void unregisterCallback();

private:
	px4::WorkItem *_work_item;
};
}
