/* See RotorWatchDiagnoser.hpp. Nothing is allocated while flying. MIT. */
#include "RotorWatchDiagnoser.hpp"

#include <math.h>

namespace
{
// Below the controllers, the estimators, the drivers and (on NuttX) the commander and the logger: a step takes milliseconds.
#if defined(__PX4_NUTTX)
constexpr px4::wq_config_t DIAGNOSING {"wq:rotorwatch", 4096, -128};
#else
constexpr px4::wq_config_t DIAGNOSING {"wq:rotorwatch", 4096, -90};
#endif

rw_time seconds(hrt_abstime us)
{
	return static_cast<rw_time>(us) / 1000000;
}

uint64_t microseconds(rw_time s)
{
	return s < RW_LASTS && s > 0 ? static_cast<uint64_t>(s * 1000000) : 0;
}
} // namespace

#ifdef ROTORWATCH_MODULE_DESCRIPTOR
ModuleBase::Descriptor RotorWatchDiagnoser::desc{task_spawn, custom_command, print_usage};
#endif

RotorWatchDiagnoser::Worker::Worker(RotorWatchDiagnoser &owner) : px4::WorkItem("rotorwatch_work", DIAGNOSING), _owner(owner)
{
}

void RotorWatchDiagnoser::Worker::Run()
{
	_owner.diagnose();
}

RotorWatchDiagnoser::RotorWatchDiagnoser() : ModuleParams(nullptr), ScheduledWorkItem("rotorwatch", px4::wq_configurations::hp_default)
{
	rw_diagnoser_init(&_diagnoser, &rw_vehicle_default, &rw_plan_default);
	rw_texts_init(&_texts);
}

RotorWatchDiagnoser::~RotorWatchDiagnoser()
{
	ScheduleClear();
}

void RotorWatchDiagnoser::init()
{
	updateParams();
	ScheduleOnInterval(INTERVAL_US);
}

void RotorWatchDiagnoser::Run()
{
	if (should_exit()) {
		// Not before the worker has said that it does nothing any more: it is part of this object.
		if (!_stopping.load()) {
			_stopping.store(true);
			_worker.ScheduleNow();

		} else if (_stopped.load()) {
			ScheduleClear();
#ifdef ROTORWATCH_MODULE_DESCRIPTOR
			exit_and_cleanup(desc);
#else
			exit_and_cleanup();
#endif
		}

		return;
	}

	take();

	if (_head.load() != _tail.load()) {
		_worker.ScheduleNow();
	}
}

// Topics come when they are published, up to some milliseconds late: they are put in the order of their times.
void RotorWatchDiagnoser::put(Kind kind, hrt_abstime time, const float *x, unsigned count)
{
	unsigned at = _count++;

	for (; at > 0 && _new[at - 1].time > time; at--) {
		_new[at] = _new[at - 1];
	}

	_new[at].kind = kind;
	_new[at].time = time;

	for (unsigned k = 0; k < count; k++) {
		_new[at].x[k] = x[k];
	}
}

void RotorWatchDiagnoser::pass_on()
{
	for (unsigned i = 0; i < _count; i++) {
		const uint32_t tail = _tail.load();
		const uint32_t next = (tail + 1) % LINE;

		if (next == _head.load()) {
			_dropped.fetch_add(1);

		} else {
			_line[tail] = _new[i];
			_tail.store(next);
		}
	}

	_count = 0;
}

void RotorWatchDiagnoser::Mean::add(const float *xyz, hrt_abstime time)
{
	since = count == 0 ? time : since;
	late += static_cast<uint32_t>(time - since);
	count++;

	for (int k = 0; k < 3; k++) {
		sum[k] += xyz[k];
	}
}

hrt_abstime RotorWatchDiagnoser::Mean::take(float *mean)
{
	const hrt_abstime time = since + late / count;

	for (int k = 0; k < 3; k++) {
		mean[k] = sum[k] / static_cast<float>(count);
		sum[k] = 0.f;
	}

	late = 0;
	count = 0;
	return time;
}

void RotorWatchDiagnoser::take()
{
	vehicle_angular_velocity_s rates;

	if (_rates.update(&rates)) {
		_gyro.add(rates.xyz, rates.timestamp_sample);
	}

	vehicle_acceleration_s acceleration;

	if (_acceleration.update(&acceleration)) {
		_accel.add(acceleration.xyz, acceleration.timestamp_sample);
	}

	if (++_quarter < 4) {
		return;
	}

	_quarter = 0;

	// What is new of each topic. Outputs and what changes slowly come RW_OUTPUT_HZ times a second, gyro and accelerometer RW_MOTION_HZ times.
	_turn += RW_OUTPUT_HZ;

	if (_turn >= RW_MOTION_HZ) {
		_turn -= RW_MOTION_HZ;

		vehicle_land_detected_s landed;

		if (_landed.update(&landed)) {
			const float x = landed.landed ? 1.f : 0.f;
			put(Kind::LANDED, landed.timestamp, &x, 1);
		}

		actuator_armed_s armed;

		if (_armed.update(&armed)) {
			const float x = armed.armed ? 1.f : 0.f;
			put(Kind::ARMED, armed.timestamp, &x, 1);
		}

		actuator_motors_s motors;

		if (_motors.update(&motors)) {
			put(Kind::MOTORS, motors.timestamp, motors.control, SHOWN);
		}

		vehicle_torque_setpoint_s torque;
		vehicle_thrust_setpoint_s thrust;

		if (_torque.update(&torque) && _thrust.copy(&thrust)) {
			const float x[4] = {torque.xyz[0], torque.xyz[1], torque.xyz[2], -thrust.xyz[2]};
			put(Kind::CONTROL, torque.timestamp, x, 4);
		}

		vehicle_local_position_s position;

		if (_position.update(&position)) {
			const float x[3] = {position.v_xy_valid ? position.vx : NAN, position.v_xy_valid ? position.vy : NAN, position.v_z_valid ? position.vz : NAN};
			put(Kind::POSITION, position.timestamp, x, 3);
		}

		vehicle_attitude_s attitude;

		if (_attitude.update(&attitude)) {
			put(Kind::ATTITUDE, attitude.timestamp, attitude.q, 4);
		}
	}

	float mean[3];

	if (_gyro.count > 0) {
		const hrt_abstime time = _gyro.take(mean);
		put(Kind::RATES, time, mean, 3);
	}

	if (_accel.count > 0) {
		const hrt_abstime time = _accel.take(mean);
		put(Kind::ACCELERATION, time, mean, 3);
	}

	pass_on();
}

void RotorWatchDiagnoser::diagnose()
{
	if (_stopping.load()) {
		_stopped.store(true);
		return;
	}

	if (_parameters.updated()) {
		parameter_update_s update;
		_parameters.copy(&update);
		updateParams();
	}

	uint32_t head = _head.load();
	bool outputs = false;

	while (head != _tail.load()) {
		const Sample sample = _line[head];
		head = (head + 1) % LINE;
		_head.store(head);
		feed(sample);
		outputs = outputs || sample.kind == Kind::MOTORS;
	}

	if (outputs) {
		report(_fed);
	}
}

void RotorWatchDiagnoser::feed(const Sample &sample)
{
	// Topics are published up to some milliseconds after their time: one that comes behind a newer one counts as just after it.
	_fed = sample.time > _fed ? sample.time : _fed;
	const rw_time time = seconds(_fed);
	const rw_real x[4] = {sample.x[0], sample.x[1], sample.x[2], sample.x[3]};

	switch (sample.kind) {
	case Kind::LANDED:
		rw_diagnoser_state(&_diagnoser, time, sample.x[0] > 0.5f ? 1 : 0, -1);
		break;

	case Kind::ARMED:
		rw_diagnoser_state(&_diagnoser, time, -1, sample.x[0] > 0.5f ? 1 : 0);
		break;

	case Kind::MOTORS: {
			rw_real output[RW_ROTORS];

			for (int k = 0; k < RW_ROTORS; k++) {
				output[k] = sample.x[k] > 0.f ? sample.x[k] : 0.f; // NaN: not armed
			}

			rw_diagnoser_outputs(&_diagnoser, time, output, ALL);
			break;
		}

	case Kind::CONTROL:
		// Once allocation relies on it, outputs follow another mixer than that of the healthy vehicle.
		rw_diagnoser_control(&_diagnoser, time, x, !_acted);
		break;

	case Kind::POSITION:
		rw_diagnoser_velocity_ned(&_diagnoser, time, x);
		break;

	case Kind::ATTITUDE:
		rw_diagnoser_attitude(&_diagnoser, time, x);
		break;

	case Kind::RATES:
		rw_diagnoser_gyro(&_diagnoser, time, x, true);
		break;

	case Kind::ACCELERATION:
		rw_diagnoser_accel(&_diagnoser, time, x, true);
		break;
	}
}

void RotorWatchDiagnoser::report(hrt_abstime time)
{
	const int count = rw_diagnoser_poll(&_diagnoser, _notifications);

	for (int i = 0; i < count; i++) {
		publish(_notifications[i].event, _notifications[i].kind, _notifications[i].number);
	}

	char text[RW_TEXT];
	const int severity = rw_diagnoser_text(&_diagnoser, &_texts, seconds(time), static_cast<int>(_param_rotw_text.get()), text);

	if (severity > 0) {
		mavlink_vasprintf(severity, &_mavlink_log_pub, "%s", text);
	}

	if (count > 0 || time - _published >= PUBLISH_US) {
		const rw_event *events = nullptr;
		rw_diagnoser_events(&_diagnoser, &events);
		const int best = rw_diagnoser_main(&_diagnoser);
		publish(best < 0 ? nullptr : &events[best], rotorwatch_verdict_s::NEWS_NONE, 0);
		_published = time;
	}
}

void RotorWatchDiagnoser::publish(const rw_event *event, uint8_t news, uint16_t number)
{
	rotorwatch_verdict_s verdict{};
	verdict.timestamp = hrt_absolute_time();
	verdict.verdict = static_cast<uint8_t>(rw_diagnoser_verdict(&_diagnoser));
	verdict.kind = rotorwatch_verdict_s::KIND_NONE;
	verdict.news = news;
	verdict.number = number;
	verdict.dropped = _dropped.load();

	if (event != nullptr) {
		verdict.kind = event->kind;
		verdict.rotors = event->rotors;

		for (int i = 0; i < 4 && i < event->alternative_count; i++) {
			verdict.alternatives[i] = event->alternatives[i];
		}

		verdict.onset = microseconds(event->onset);
		verdict.detected = microseconds(event->detected);
		verdict.end = microseconds(event->end);
		verdict.loss_lower = static_cast<float>(event->lower[0]);
		verdict.loss_upper = static_cast<float>(event->upper[0]);
		verdict.probability = static_cast<float>(event->probability);

		constexpr int most = RW_TOGETHER < 4 ? RW_TOGETHER : 4;

		for (int k = 0; k < most; k++) {
			verdict.loss[k] = static_cast<float>(event->loss[k]);
		}
	}

	for (int k = 0; k < 12; k++) {
		verdict.rotor_loss[k] = NAN;
	}

	for (int k = 0; k < SHOWN; k++) {
		verdict.rotor_loss[k] = static_cast<float>(rw_diagnoser_loss(&_diagnoser, k));
	}

	rely(verdict);
	_verdict.publish(verdict);
}

void RotorWatchDiagnoser::rely(rotorwatch_verdict_s &verdict)
{
	const rw_reliance &reliance = *rw_diagnoser_reliance(&_diagnoser);
	verdict.control = rotorwatch_verdict_s::CONTROL_TURNS;

	for (int k = 0; k < 12; k++) {
		verdict.effectiveness[k] = 1.f;
	}

	if (!_param_rotw_act.get()) {
		return;
	}

	if (reliance.revision != _relied) {
		_relied = reliance.revision;
		_control = static_cast<uint8_t>(rw_diagnoser_factors(&_diagnoser, _factors));
		_acted = false;

		for (int k = 0; k < RW_ROTORS; k++) {
			_acted = _acted || reliance.effectiveness[k] < 1;
		}
	}

	verdict.control = _control;
	verdict.revision = static_cast<uint32_t>(reliance.revision);
	verdict.left_out = reliance.left_out;
	verdict.left_out_odds = static_cast<float>(reliance.odds);

	for (int k = 0; k < SHOWN; k++) {
		verdict.effectiveness[k] = static_cast<float>(reliance.effectiveness[k]);
	}
}

int RotorWatchDiagnoser::print_status()
{
	// What was published last: this is called from another thread than the worker's.
	static const char *const words[] = {"not assessed", "healthy so far", "fault found", "ambiguous"};
	uORB::Subscription last{ORB_ID(rotorwatch_verdict)};
	rotorwatch_verdict_s verdict{};

	if (!last.copy(&verdict)) {
		PX4_INFO("no outputs of the motors yet");
		return 0;
	}

	PX4_INFO("%s, %u samples dropped", words[verdict.verdict & 3], static_cast<unsigned>(verdict.dropped));

	for (int k = 0; k < SHOWN; k++) {
		PX4_INFO("rotor %d: loss %d %%", k + 1, static_cast<int>(100.f * verdict.rotor_loss[k] + 0.5f));
	}

	return 0;
}

int RotorWatchDiagnoser::task_spawn(int argc, char *argv[])
{
	int32_t enabled = 0;
	param_get(param_handle(px4::params::ROTW_EN), &enabled);

	if (enabled == 0) {
		PX4_INFO("not started: ROTW_EN is 0");
		return PX4_OK;
	}

	RotorWatchDiagnoser *instance = new RotorWatchDiagnoser();

	if (instance == nullptr) {
		PX4_ERR("no memory for the diagnoser");
		return PX4_ERROR;
	}

#ifdef ROTORWATCH_MODULE_DESCRIPTOR
	desc.object.store(instance);
	desc.task_id = task_id_is_work_queue;
#else
	_object.store(instance);
	_task_id = task_id_is_work_queue;
#endif
	instance->init();
	return PX4_OK;
}

int RotorWatchDiagnoser::custom_command(int argc, char *argv[])
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
#ifdef ROTORWATCH_MODULE_DESCRIPTOR
	return ModuleBase::main(RotorWatchDiagnoser::desc, argc, argv);
#else
	return RotorWatchDiagnoser::main(argc, argv);
#endif
}
