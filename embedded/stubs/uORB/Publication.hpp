/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
#include <uORB/Subscription.hpp>
namespace uORB
{
template <class T> class Publication
{
public:
	explicit Publication(Topic) {}
	bool publish(const T &) { return true; }
};
}
