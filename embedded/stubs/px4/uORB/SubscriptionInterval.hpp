/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <drivers/drv_hrt.h>
#include <uORB/Subscription.hpp>
namespace uORB
{
class SubscriptionInterval
{
public:
	SubscriptionInterval(const orb_metadata *meta, uint32_t interval_us = 0, uint8_t instance = 0) : _subscription{meta, instance}, _interval_us(interval_us) {}
	bool updated();
	bool update(void *dst);
	bool copy(void *dst);

protected:
	Subscription _subscription;
	uint64_t _last_update{0};
	uint32_t _interval_us{0};
};
}
