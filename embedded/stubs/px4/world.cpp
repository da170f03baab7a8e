/* See world.hpp. MIT. */
#include "world.hpp"

#include <cstdarg>
#include <cstring>
#include <map>
#include <parameters/param.h>
#include <px4_platform_common/log.h>
#include <px4_platform_common/module.h>
#include <set>
#include <string>
#include <systemlib/mavlink_log.h>
#include <uORB/Publication.hpp>
#include <uORB/SubscriptionCallback.hpp>
#include <vector>

hrt_abstime World::now;
int32_t World::parameters[3] = {0, 1, 5};
FILE *World::out = stdout;

namespace
{
struct Topic {
	std::vector<char> data;
	unsigned generation{0};
};
struct Timer {
	hrt_abstime next, interval;
};
std::map<orb_id_t, Topic> topics;
std::map<px4::WorkItem *, Timer> timers;
std::set<px4::WorkItem *> alive;
std::vector<px4::WorkItem *> waiting;
} // namespace

hrt_abstime hrt_absolute_time() { return World::now; }
param_t param_find(const char *name) { return strcmp(name, "ROTW_ACT") == 0 ? 0 : strcmp(name, "ROTW_EN") == 0 ? 1 : 2; }
int param_get(param_t param, void *val)
{
	if (param > 2) { return -1; }

	memcpy(val, &World::parameters[param], sizeof(int32_t));
	return 0;
}

void World::publish(orb_id_t topic, const void *data)
{
	Topic &t = topics[topic];
	t.data.assign(static_cast<const char *>(data), static_cast<const char *>(data) + topic->o_size);
	t.generation++;
}
namespace uORB
{
bool Subscription::advertised() { return topics.count(_meta) > 0; }
bool Subscription::updated() { return advertised() && topics[_meta].generation != _last_generation; }
bool Subscription::update(void *dst) { return updated() && copy(dst); }
bool Subscription::copy(void *dst)
{
	if (!advertised()) { return false; }

	memcpy(dst, topics[_meta].data.data(), _meta->o_size);
	_last_generation = topics[_meta].generation;
	return true;
}
bool SubscriptionInterval::updated() { return World::now >= _last_update + _interval_us && _subscription.updated(); }
bool SubscriptionInterval::update(void *dst) { return updated() && copy(dst); }
bool SubscriptionInterval::copy(void *dst)
{
	_last_update = World::now;
	return _subscription.copy(dst);
}
bool SubscriptionCallbackWorkItem::registerCallback() { return _work_item != nullptr; }
void SubscriptionCallbackWorkItem::unregisterCallback() {}
void reported(orb_id_t topic, const void *data) __attribute__((weak));
bool PublicationBase::put(const void *data)
{
	World::publish(_meta, data);

	if (reported != nullptr) { reported(_meta, data); }

	return true;
}
} // namespace uORB

namespace px4
{
WorkItem::WorkItem(const char *name, const wq_config_t &) : _item_name(name) { alive.insert(this); }
WorkItem::~WorkItem()
{
	alive.erase(this);
	timers.erase(this);
}
void WorkItem::ScheduleNow() { waiting.push_back(this); }
ScheduledWorkItem::~ScheduledWorkItem() {}
void ScheduledWorkItem::ScheduleDelayed(uint32_t delay_us) { timers[this] = {World::now + delay_us, 0}; }
void ScheduledWorkItem::ScheduleOnInterval(uint32_t interval_us, uint32_t delay_us) { timers[this] = {World::now + delay_us, interval_us}; }
void ScheduledWorkItem::ScheduleClear() { timers.erase(this); }
} // namespace px4

unsigned World::items() { return static_cast<unsigned>(alive.size()); }
void World::run()
{
	for (auto &one : std::map<px4::WorkItem *, Timer>(timers)) {
		if (one.second.next <= now && timers.count(one.first) > 0) {
			Timer &timer = timers[one.first];
			timer.next = (now - timer.next < 500000 ? timer.next : now) + (timer.interval > 0 ? timer.interval : 1u << 30);
			waiting.push_back(one.first);
		}
	}

	while (!waiting.empty()) {
		px4::WorkItem *const item = waiting.front();
		waiting.erase(waiting.begin());

		if (alive.count(item) > 0) { item->Run(); }
	}
}

void mavlink_vasprintf(int severity, orb_advert_t *, const char *fmt, ...)
{
	char text[128];
	va_list list;
	va_start(list, fmt);
	vsnprintf(text, sizeof text, fmt, list);
	va_end(list);
	fprintf(World::out, "text\t%.6f\t%d\t%s\n", static_cast<double>(World::now) / 1e6, severity, text);
}
void px4_log_modulename(int, const char *, const char *format, ...)
{
	char text[256];
	va_list list;
	va_start(list, format);
	vsnprintf(text, sizeof text, format, list);
	va_end(list);
	fprintf(World::out, "console\t%s\n", text);
}
void PRINT_MODULE_DESCRIPTION(const char *) {}
void PRINT_MODULE_USAGE_NAME(const char *, const char *) {}
void PRINT_MODULE_USAGE_COMMAND_DESCR(const char *, const char *) {}
