/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <uORB/uORB.h>
namespace uORB
{
class PublicationBase
{
public:
	orb_id_t get_topic() const { return _meta; }

protected:
	PublicationBase(const orb_metadata *meta) : _meta(meta) {}
	bool put(const void *data);
	const orb_metadata *_meta;
};
template <typename T> class Publication : public PublicationBase
{
public:
	Publication(const orb_metadata *meta) : PublicationBase(meta) {}
	bool publish(const T &data) { return put(&data); }
};
}
