/* Flies recorded samples through the module as PX4 would: fly SAMPLES [ENABLE [TEXT [ACT]]]. A sample is 24 doubles: kind, time, validity and
   numbers, as in tests/onboard_law.py. Texts and events come out as lines. MIT. */
#include <cstdlib>
#include <cstring>
#include <uORB/topics/actuator_armed.h>
#include <uORB/topics/actuator_motors.h>
#include <uORB/topics/parameter_update.h>
#include <uORB/topics/rotorwatch_verdict.h>
#include <uORB/topics/vehicle_acceleration.h>
#include <uORB/topics/vehicle_angular_velocity.h>
#include <uORB/topics/vehicle_attitude.h>
#include <uORB/topics/vehicle_land_detected.h>
#include <uORB/topics/vehicle_local_position.h>
#include <uORB/topics/vehicle_thrust_setpoint.h>
#include <uORB/topics/vehicle_torque_setpoint.h>

#include "RotorWatchAllocation.hpp"
#include "rw_config.h"
#include "world.hpp"

#define STUB_TOPIC(name) extern "C" const struct orb_metadata __orb_##name = {#name, sizeof(name##_s)};
STUB_TOPIC(actuator_armed)
STUB_TOPIC(actuator_motors)
STUB_TOPIC(parameter_update)
STUB_TOPIC(rotorwatch_verdict)
STUB_TOPIC(vehicle_acceleration)
STUB_TOPIC(vehicle_angular_velocity)
STUB_TOPIC(vehicle_attitude)
STUB_TOPIC(vehicle_land_detected)
STUB_TOPIC(vehicle_local_position)
STUB_TOPIC(vehicle_thrust_setpoint)
STUB_TOPIC(vehicle_torque_setpoint)

extern "C" int rotorwatch_main(int argc, char *argv[]);

/* An effectiveness matrix as the control allocator has it, all ones. */
struct Stub {
	float at[6][16];
	Stub() { for (auto &row : at) for (float &x : row) { x = 1.f; } }
	float &operator()(int axis, int motor) { return at[axis][motor]; }
};

static const int WIDTH = 24;
static int verdict = 0;

namespace uORB
{
void reported(orb_id_t topic, const void *data);
void reported(orb_id_t topic, const void *data)
{
	if (topic != ORB_ID(rotorwatch_verdict)) { return; }

	const rotorwatch_verdict_s &v = *static_cast<const rotorwatch_verdict_s *>(data);
	verdict = v.verdict;
	static uint32_t revision = 0;

	if (v.revision != revision) {
		revision = v.revision;
		fprintf(World::out, "factors\t%.6f", static_cast<double>(v.timestamp) / 1e6);
		Stub matrix;
		rotorwatch_rely(v, matrix, RW_ROTORS);

		for (int k = 0; k < 12; k++) {
			for (int axis = 0; axis < 4; axis++) { fprintf(World::out, "\t%.6f", static_cast<double>(matrix(axis < 3 ? axis : 5, k))); }
		}

		fprintf(World::out, "\n");
	}

	if (v.news != rotorwatch_verdict_s::NEWS_NONE) {
		fprintf(World::out, "log\tRWEV\tTimeUS,Num,What,Kind,Rot,Alt,On,End,P,Lo,Hi,L1,L2,L3,L4\t%llu\t%d\t%d\t%d\t%d\t%d\t%.6f\t%.6f\t%g\t%g\t%g",
			static_cast<unsigned long long>(v.timestamp), v.number, v.news, v.kind, v.rotors, v.alternatives[0],
			static_cast<double>(v.onset) / 1e6, static_cast<double>(v.end) / 1e6, static_cast<double>(v.probability),
			static_cast<double>(v.loss_lower), static_cast<double>(v.loss_upper));

		for (int k = 0; k < 4; k++) { fprintf(World::out, "\t%g", static_cast<double>(v.loss[k])); }

		fprintf(World::out, "\n");

	} else {
		fprintf(World::out, "log\tRWLS\tTimeUS,Verd,Drop,L1,L2,L3,L4,L5,L6,L7,L8,L9,L10,L11,L12\t%llu\t%d\t%u",
			static_cast<unsigned long long>(v.timestamp), v.verdict, static_cast<unsigned>(v.dropped));

		for (int k = 0; k < 12; k++) { fprintf(World::out, "\t%g", static_cast<double>(v.rotor_loss[k])); }

		fprintf(World::out, "\n");
	}
}
} // namespace uORB

template <typename T> static T made(hrt_abstime time)
{
	T topic{};
	topic.timestamp = time;
	return topic;
}

template <typename T> static void vector(T topic, orb_id_t id, const double *x, double sign = 1)
{
	topic.timestamp_sample = topic.timestamp;

	for (int a = 0; a < 3; a++) { topic.xyz[a] = static_cast<float>(sign * x[a]); }

	World::publish(id, &topic);
}

static void see(const double *row, hrt_abstime t)
{
	const double *x = row + 3;

	switch (static_cast<int>(row[0])) {
	case 0: {
			auto topic = made<actuator_motors_s>(t);

			for (int k = 0; k < 12; k++) {
				const bool known = k < RW_ROTORS && ((static_cast<unsigned>(row[2]) >> k) & 1) != 0;
				topic.control[k] = known ? static_cast<float>(x[k]) : __builtin_nanf("");
			}

			World::publish(ORB_ID(actuator_motors), &topic);
			break;
		}

	case 1: vector(made<vehicle_acceleration_s>(t), ORB_ID(vehicle_acceleration), x); break;

	case 2: vector(made<vehicle_angular_velocity_s>(t), ORB_ID(vehicle_angular_velocity), x); break;

	case 3: {
			auto topic = made<vehicle_local_position_s>(t);
			topic.v_xy_valid = x[0] == x[0] && x[1] == x[1];
			topic.v_z_valid = x[2] == x[2];
			topic.vx = static_cast<float>(x[0]);
			topic.vy = static_cast<float>(x[1]);
			topic.vz = static_cast<float>(x[2]);
			World::publish(ORB_ID(vehicle_local_position), &topic);
			break;
		}

	case 4: {
			if (x[0] >= 0) {
				auto topic = made<vehicle_land_detected_s>(t);
				topic.landed = x[0] > 0.5;
				World::publish(ORB_ID(vehicle_land_detected), &topic);
			}

			if (x[1] >= 0) {
				auto topic = made<actuator_armed_s>(t);
				topic.armed = x[1] > 0.5;
				World::publish(ORB_ID(actuator_armed), &topic);
			}

			break;
		}

	case 5: {
			const double thrust[] = {0, 0, -x[3]};
			vector(made<vehicle_thrust_setpoint_s>(t), ORB_ID(vehicle_thrust_setpoint), thrust);
			vector(made<vehicle_torque_setpoint_s>(t), ORB_ID(vehicle_torque_setpoint), x);
			break;
		}

	case 6: {
			auto topic = made<vehicle_attitude_s>(t);

			for (int k = 0; k < 4; k++) { topic.q[k] = static_cast<float>(x[k]); }

			World::publish(ORB_ID(vehicle_attitude), &topic);
			break;
		}
	}
}

static int call(const char *word)
{
	char name[] = "rotorwatch", what[16];
	snprintf(what, sizeof what, "%s", word);
	char *words[] = {name, what, nullptr};
	return rotorwatch_main(2, words);
}

int main(int count, char **words)
{
	FILE *file = count > 1 ? fopen(words[1], "rb") : nullptr;

	if (file == nullptr) { return 2; }

	World::parameters[1] = count > 2 ? atoi(words[2]) : 1;
	World::parameters[2] = count > 3 ? atoi(words[3]) : 5;
	World::parameters[0] = count > 4 ? atoi(words[4]) : 0;
	const int started = call("start");
	fprintf(World::out, "size\t%d\t%u\n", started, World::items());
	double row[WIDTH];

	while (fread(row, sizeof row, 1, file) == 1) {
		World::now = static_cast<hrt_abstime>(row[1] * 1000000 + 0.5);
		see(row, World::now);
		World::run();
	}

	fclose(file);
	fprintf(World::out, "verdict\t%d\n", verdict);

	if (World::items() > 0) {
		call("status");
		call("stop");

		for (int k = 0; k < 3; k++) {
			World::now += 100000;
			World::run();
		}
	}

	fprintf(World::out, "left\t%u\n", World::items());
	return 0;
}
