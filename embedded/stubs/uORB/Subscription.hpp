/* Just enough of the autopilot's interface to compile the skeletons against. MIT. */
#pragma once
#include <cstdint>
#ifndef ORB_ID
#define ORB_ID(name) uORB::Topic{#name}
namespace uORB
{
struct Topic {
	const char *name;
};
class Subscription
{
public:
	explicit Subscription(Topic) {}
	template <class T> bool update(T *) { return true; }
	template <class T> bool copy(T *) { return true; }
};
}
#endif
