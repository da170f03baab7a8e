/* See RotorWatchDiagnoser.hpp. Everything is a member of the object: nothing is allocated while flying. MIT. */
#include "RotorWatchDiagnoser.hpp"

#include <math.h>

static rw_time seconds(hrt_abstime us)
{
	return static_cast<rw_time>(us) / 1000000;
}

static uint64_t microseconds(rw_time s)
{
	return s < RW_LASTS && s > 0 ? static_cast<uint64_t>(s * 1000000) : 0;
}

RotorWatchDiagnoser::RotorWatchDiagnoser() : ModuleParams(nullptr), ScheduledWorkItem("rotorwatch", px4::wq_configurations::lp_default)
{
	rw_diagnoser_init(&_diagnoser, &rw_vehicle_default, &rw_plan_default);
}

RotorWatchDiagnoser::~RotorWatchDiagnoser()
{
	ScheduleClear();
}

bool RotorWatchDiagnoser::init()
{
	if (!_param_rotw_en.get()) {
		return false;
	}

	ScheduleOnInterval(INTERVAL_US);
	return true;
}

void RotorWatchDiagnoser::Run()
{
	if (should_exit()) {
		ScheduleClear();
		exit_and_cleanup();
		return;
	}

	feed();

	const hrt_abstime now = hrt_absolute_time();
	const int count = rw_diagnoser_poll(&_diagnoser, _notifications);

	for (int i = 0; i < count; i++) {
		notify(_notifications[i]);
		publish(_notifications[i].event, _notifications[i].kind, _notifications[i].number);
	}

	if (count > 0 || now - _published >= PUBLISH_US) {
		const rw_event *events = nullptr;
		rw_diagnoser_events(&_diagnoser, &events);
		const int best = rw_diagnoser_main(&_diagnoser);
		publish(best < 0 ? nullptr : &events[best], rotorwatch_verdict_s::NEWS_NONE, 0);
		_published = now;
	}
}

void RotorWatchDiagnoser::feed()
{
	// What is new of each topic, in the order of its time: topics come when they are published, up to some milliseconds late.
	enum Kind { LANDED, ARMED, MOTORS, POSITION, ATTITUDE, RATES, ACCELERATION, KINDS };

	struct {
		hrt_abstime time;
		Kind kind;
	} samples[KINDS];

	int count = 0;

	const auto put = [&](hrt_abstime time, Kind kind) {
		int at = count++;

		for (; at > 0 && samples[at - 1].time > time; at--) {
			samples[at] = samples[at - 1];
		}

		samples[at].time = time;
		samples[at].kind = kind;
	};

	vehicle_land_detected_s landed{};
	actuator_armed_s armed{};
	actuator_motors_s motors{};
	vehicle_local_position_s position{};
	vehicle_attitude_s attitude{};
	vehicle_angular_velocity_s rates{};
	vehicle_acceleration_s acceleration{};

	if (_landed.update(&landed)) { put(landed.timestamp, LANDED); }

	if (_armed.update(&armed)) { put(armed.timestamp, ARMED); }

	if (_motors.update(&motors)) { put(motors.timestamp, MOTORS); }

	if (_position.update(&position)) { put(position.timestamp, POSITION); }

	if (_attitude.update(&attitude)) { put(attitude.timestamp, ATTITUDE); }

	if (_rates.update(&rates)) { put(rates.timestamp_sample, RATES); }

	if (_acceleration.update(&acceleration)) { put(acceleration.timestamp, ACCELERATION); }

	for (int i = 0; i < count; i++) {
		_fed = samples[i].time > _fed ? samples[i].time : _fed;
		const rw_time time = seconds(_fed);

		switch (samples[i].kind) {
		case LANDED:
			rw_diagnoser_state(&_diagnoser, time, landed.landed ? 1 : 0, -1);
			break;

		case ARMED:
			rw_diagnoser_state(&_diagnoser, time, -1, armed.armed ? 1 : 0);
			break;

		case MOTORS: {
				rw_real output[RW_ROTORS];

				for (int k = 0; k < RW_ROTORS; k++) {
					output[k] = motors.control[k] > 0.f ? motors.control[k] : 0.f; // NaN: not armed
				}

				rw_diagnoser_outputs(&_diagnoser, time, output, ALL);
				break;
			}

		case POSITION: {
				const rw_real unknown = rw_real(NAN);
				const rw_real velocity[3] = {position.v_xy_valid ? position.vx : unknown, position.v_xy_valid ? position.vy : unknown,
							     position.v_z_valid ? position.vz : unknown
							    };
				rw_diagnoser_velocity_ned(&_diagnoser, time, velocity);
				break;
			}

		case ATTITUDE: {
				const rw_real q[4] = {attitude.q[0], attitude.q[1], attitude.q[2], attitude.q[3]};
				rw_diagnoser_attitude(&_diagnoser, time, q);
				break;
			}

		case RATES: {
				const rw_real rate[3] = {rates.xyz[0], rates.xyz[1], rates.xyz[2]};
				rw_diagnoser_gyro(&_diagnoser, time, rate, true);
				break;
			}

		case ACCELERATION: {
				const rw_real force[3] = {acceleration.xyz[0], acceleration.xyz[1], acceleration.xyz[2]};
				rw_diagnoser_accel(&_diagnoser, time, force, true);
				break;
			}

		case KINDS:
			break;
		}
	}
}

void RotorWatchDiagnoser::notify(const rw_notification &notification)
{
	char text[RW_TEXT];
	const int severity = rw_diagnoser_words(&notification, text);

	if (severity > _param_rotw_text.get()) {
		return;
	}

	if (severity == RW_CRITICAL) {
		mavlink_log_critical(&_mavlink_log_pub, "%s", text);

	} else if (severity == RW_WARNING) {
		mavlink_log_warning(&_mavlink_log_pub, "%s", text);

	} else {
		mavlink_log_info(&_mavlink_log_pub, "%s", text);
	}
}

void RotorWatchDiagnoser::publish(const rw_event *event, uint8_t notification_kind, uint16_t number)
{
	rotorwatch_verdict_s verdict{};
	verdict.timestamp = hrt_absolute_time();
	verdict.verdict = static_cast<uint8_t>(rw_diagnoser_verdict(&_diagnoser));
	verdict.kind = rotorwatch_verdict_s::KIND_NONE;
	verdict.news = notification_kind;
	verdict.number = number;

	if (event != nullptr) {
		verdict.kind = event->kind;
		verdict.rotors = event->rotors;

		for (int i = 0; i < 4 && i < event->alternative_count; i++) {
			verdict.alternatives[i] = event->alternatives[i];
		}

		verdict.onset = microseconds(event->onset);
		verdict.detected = microseconds(event->detected);
		verdict.end = microseconds(event->end);
		verdict.loss = static_cast<float>(event->loss[0]);
		verdict.loss_lower = static_cast<float>(event->lower[0]);
		verdict.loss_upper = static_cast<float>(event->upper[0]);
		verdict.probability = static_cast<float>(event->probability);
	}

	for (int k = 0; k < 12; k++) {
		verdict.rotor_loss[k] = k < RW_ROTORS ? static_cast<float>(rw_diagnoser_loss(&_diagnoser, k)) : NAN;
	}

	_verdict.publish(verdict);
}

int RotorWatchDiagnoser::print_status()
{
	PX4_INFO("%s", rw_diagnoser_verdict_text(&_diagnoser));
	for (int k = 0; k < RW_ROTORS; k++) {
		PX4_INFO("rotor %d: loss %.0f %%", k + 1, 100 * static_cast<double>(rw_diagnoser_loss(&_diagnoser, k)));
	}

	return 0;
}

int RotorWatchDiagnoser::task_spawn(int, char *[])
{
	RotorWatchDiagnoser *instance = new RotorWatchDiagnoser();

	if (instance == nullptr) {
		PX4_ERR("no memory for the diagnoser");
		return PX4_ERROR;
	}

	_object.store(instance);
	_task_id = task_id_is_work_queue;

	if (instance->init()) {
		return PX4_OK;
	}

	PX4_INFO("not started: ROTW_EN is 0");
	delete instance;
	_object.store(nullptr);
	_task_id = -1;
	return PX4_ERROR;
}

int RotorWatchDiagnoser::custom_command(int, char *[])
{
	return print_usage("unknown command");
}

int RotorWatchDiagnoser::print_usage(const char *reason)
{
	if (reason != nullptr) {
		PX4_WARN("%s\n", reason);
	}

	PRINT_MODULE_DESCRIPTION("Tells which rotor has lost effectiveness, how much, since when and how sure.");
	PRINT_MODULE_USAGE_NAME("rotorwatch", "system");
	PRINT_MODULE_USAGE_COMMAND("start");
	PRINT_MODULE_USAGE_DEFAULT_COMMANDS();
	return 0;
}

extern "C" __EXPORT int rotorwatch_main(int argc, char *argv[])
{
	return RotorWatchDiagnoser::main(argc, argv);
}
