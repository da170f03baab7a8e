/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
#include <px4_platform_common/px4_work_queue/ScheduledWorkItem.hpp>
#include <uORB/Subscription.hpp>
namespace uORB
{
class SubscriptionCallbackWorkItem : public Subscription
{
public:
	SubscriptionCallbackWorkItem(px4::ScheduledWorkItem *, Topic topic) : Subscription(topic) {}
	bool registerCallback() { return true; }
};
}
