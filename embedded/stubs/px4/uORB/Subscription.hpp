/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <uORB/uORB.h>
namespace uORB
{
class Subscription
{
public:
	Subscription(const orb_metadata *meta = nullptr, uint8_t instance = 0) : _meta(meta) {}
	~Subscription() {}
	bool advertised();
	bool updated();
	bool update(void *dst);
	bool copy(void *dst);

protected:
	const orb_metadata *_meta;
	unsigned _last_generation{0};
};
}
