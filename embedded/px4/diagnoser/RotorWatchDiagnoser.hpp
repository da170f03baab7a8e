/* A PX4 module that runs the whole diagnoser: which rotor has lost effectiveness, how much, since when and how sure. MIT.
 *
 * Where it goes, what to add and what the pilot sees: docs/px4.md. For PX4 1.15 to 1.17.
 *
 * A work item of the queue wq:hp_default adds up gyro and accelerometer, and puts samples into a line RW_MOTION_HZ times a second; another
 * one, in a queue of its own and of low priority, diagnoses. Memory is taken by `rotorwatch start` alone, and only where ROTW_EN is 1. It only reports: control
 * allocation may follow it (RotorWatchAllocation.hpp, ROTW_ACT).
 */
#pragma once

#include <drivers/drv_hrt.h>
#include <parameters/param.h>
#include <px4_platform_common/atomic.h>
#include <px4_platform_common/defines.h>
#include <px4_platform_common/module.h>
#include <px4_platform_common/module_params.h>
#include <px4_platform_common/px4_work_queue/ScheduledWorkItem.hpp>
#include <systemlib/mavlink_log.h>
#include <uORB/Publication.hpp>
#include <uORB/Subscription.hpp>
#include <uORB/SubscriptionInterval.hpp>
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

#include "rw_diagnoser.h"
#include "rw_text.h"

class RotorWatchDiagnoser;

// PX4 1.17 has a module base without a template (CMakeLists.txt looks which one there is).
#ifdef ROTORWATCH_MODULE_DESCRIPTOR
using RotorWatchModule = ModuleBase;
#else
using RotorWatchModule = ModuleBase<RotorWatchDiagnoser>;
#endif

class RotorWatchDiagnoser : public RotorWatchModule, public ModuleParams, public px4::ScheduledWorkItem
{
public:
	RotorWatchDiagnoser();
	~RotorWatchDiagnoser() override;

#ifdef ROTORWATCH_MODULE_DESCRIPTOR
	static Descriptor desc;
#endif

	static int task_spawn(int argc, char *argv[]);
	static int custom_command(int argc, char *argv[]);
	static int print_usage(const char *reason = nullptr);
	int print_status() override;

	void init();

private:
	static constexpr unsigned INTERVAL_US = 250000u / RW_MOTION_HZ; // gyro and accelerometer are read four times for a sample
	static constexpr unsigned PUBLISH_US = 200000u;
	static constexpr unsigned NUMBERS = RW_ROTORS > 4 ? RW_ROTORS : 4;
	// Half a second: two samples of motion each time, five others each time the outputs are read.
	static constexpr unsigned LINE = RW_MOTION_HZ + 5 * RW_OUTPUT_HZ / 2 + 16;
	static constexpr int SHOWN = RW_ROTORS < 12 ? RW_ROTORS : 12; // rotors that PX4's topics have room for
	static constexpr rw_rotors ALL = static_cast<rw_rotors>((1u << RW_ROTORS) - 1u);

	enum class Kind : uint8_t { LANDED, ARMED, MOTORS, CONTROL, POSITION, ATTITUDE, RATES, ACCELERATION };
	static constexpr unsigned KINDS = 8;

	struct Sample {
		hrt_abstime time;
		float x[NUMBERS];
		Kind kind;
	};

	// Adds up what a sensor says between two samples.
	struct Mean {
		float sum[3] {};
		hrt_abstime since{0};
		uint32_t late{0}; // [us] of all, after the first
		unsigned count{0};

		void add(const float *xyz, hrt_abstime time);
		hrt_abstime take(float *mean); // its time
	};

	// What diagnoses: it runs when there are samples.
	class Worker : public px4::WorkItem
	{
	public:
		explicit Worker(RotorWatchDiagnoser &owner);

	private:
		void Run() override;
		RotorWatchDiagnoser &_owner;
	};

	// The one that takes samples.
	void Run() override;
	void take();
	void put(Kind kind, hrt_abstime time, const float *x, unsigned count);
	void pass_on();

	// The worker's.
	void diagnose();
	void feed(const Sample &sample);
	void report(hrt_abstime time);
	void publish(const rw_event *event, uint8_t news, uint16_t number);
	void rely(rotorwatch_verdict_s &verdict);

	uORB::Subscription _rates{ORB_ID(vehicle_angular_velocity)};
	uORB::Subscription _acceleration{ORB_ID(vehicle_acceleration)};
	uORB::Subscription _motors{ORB_ID(actuator_motors)};
	uORB::Subscription _torque{ORB_ID(vehicle_torque_setpoint)};
	uORB::Subscription _thrust{ORB_ID(vehicle_thrust_setpoint)};
	uORB::Subscription _attitude{ORB_ID(vehicle_attitude)};
	uORB::Subscription _position{ORB_ID(vehicle_local_position)};
	uORB::Subscription _landed{ORB_ID(vehicle_land_detected)};
	uORB::Subscription _armed{ORB_ID(actuator_armed)};
	uORB::SubscriptionInterval _parameters{ORB_ID(parameter_update), 1000000};
	uORB::Publication<rotorwatch_verdict_s> _verdict{ORB_ID(rotorwatch_verdict)};
	orb_advert_t _mavlink_log_pub{nullptr};

	Worker _worker{*this};
	px4::atomic_bool _stopping{false}; // the worker shall do nothing any more
	px4::atomic_bool _stopped{false}; // and has said so
	Mean _gyro{};
	Mean _accel{};
	unsigned _quarter{0};
	unsigned _turn{0};

	// What came since the last time, in the order of its time; and the line of samples: one item puts, the other one takes.
	Sample _new[KINDS] {};
	unsigned _count{0};
	Sample _line[LINE] {};
	px4::atomic<uint32_t> _head{0};
	px4::atomic<uint32_t> _tail{0};
	px4::atomic<uint32_t> _dropped{0};

	rw_diagnoser _diagnoser{};
	rw_texts _texts{};
	rw_notification _notifications[2 * RW_EVENTS] {};
	rw_real _factors[4 * RW_ROTORS] {}; // not used: PX4 inverts by itself
	int32_t _relied{0};
	uint8_t _control{RW_TURNS};
	bool _acted{false}; // allocation relies on less than a healthy vehicle
	hrt_abstime _published{0};
	hrt_abstime _fed{0}; // time of the newest sample that was fed

	DEFINE_PARAMETERS(
		(ParamInt<px4::params::ROTW_TEXT>) _param_rotw_text,
		(ParamBool<px4::params::ROTW_ACT>) _param_rotw_act
	)
};
