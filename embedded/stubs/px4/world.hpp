/* What a test sets and reads of the declared PX4: a clock, topics, parameters, texts, and the work queues, which run while they are let. MIT. */
#pragma once
#include <drivers/drv_hrt.h>
#include <px4_platform_common/px4_work_queue/ScheduledWorkItem.hpp>
#include <uORB/uORB.h>
#include <cstdio>

struct World {
	static hrt_abstime now;
	static int32_t parameters[3]; // in the order of px4::params
	static FILE *out;

	// Publishes a topic's data, as large as its metadata say.
	static void publish(orb_id_t topic, const void *data);

	// Runs all items that are due up to now, in their order.
	static void run();
	static unsigned items();
};
