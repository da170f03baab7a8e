/* A PX4 module that runs the whole diagnoser: which rotor has lost effectiveness, how much, since when and how sure. MIT.
 *
 * Put this folder into src/modules/rotorwatch, its message into msg/ (and its name into msg/CMakeLists.txt), write the library beside it
 * (see CMakeLists.txt), say CONFIG_MODULES_ROTORWATCH=y in the board's configuration and `rotorwatch start` in its start-up script. It runs
 * in the low-priority work queue, RW_MOTION_HZ times a second, and only tells: nothing here commands the vehicle.
 */
#pragma once

#include <drivers/drv_hrt.h>
#include <parameters/param.h>
#include <px4_platform_common/module.h>
#include <px4_platform_common/module_params.h>
#include <px4_platform_common/px4_work_queue/ScheduledWorkItem.hpp>
#include <systemlib/mavlink_log.h>
#include <uORB/Publication.hpp>
#include <uORB/Subscription.hpp>
#include <uORB/topics/actuator_armed.h>
#include <uORB/topics/actuator_motors.h>
#include <uORB/topics/rotorwatch_verdict.h>
#include <uORB/topics/vehicle_acceleration.h>
#include <uORB/topics/vehicle_angular_velocity.h>
#include <uORB/topics/vehicle_attitude.h>
#include <uORB/topics/vehicle_land_detected.h>
#include <uORB/topics/vehicle_local_position.h>

#include "rw_diagnoser.h"

class RotorWatchDiagnoser : public ModuleBase<RotorWatchDiagnoser>, public ModuleParams, public px4::ScheduledWorkItem
{
public:
	RotorWatchDiagnoser();
	~RotorWatchDiagnoser() override;

	static int task_spawn(int argc, char *argv[]);
	static int custom_command(int argc, char *argv[]);
	static int print_usage(const char *reason = nullptr);
	int print_status() override;

	bool init();

private:
	static constexpr unsigned INTERVAL_US = 1000000u / RW_MOTION_HZ;
	static constexpr unsigned PUBLISH_US = 200000u;
	static constexpr rw_rotors ALL = static_cast<rw_rotors>((1u << RW_ROTORS) - 1u);

	void Run() override;
	void feed();
	void notify(const rw_notification &notification);
	void publish(const rw_event *event, uint8_t notification, uint16_t number);

	uORB::Subscription _rates{ORB_ID(vehicle_angular_velocity)};
	uORB::Subscription _acceleration{ORB_ID(vehicle_acceleration)};
	uORB::Subscription _motors{ORB_ID(actuator_motors)};
	uORB::Subscription _attitude{ORB_ID(vehicle_attitude)};
	uORB::Subscription _position{ORB_ID(vehicle_local_position)};
	uORB::Subscription _landed{ORB_ID(vehicle_land_detected)};
	uORB::Subscription _armed{ORB_ID(actuator_armed)};
	uORB::Publication<rotorwatch_verdict_s> _verdict{ORB_ID(rotorwatch_verdict)};
	orb_advert_t _mavlink_log_pub{nullptr};

	rw_diagnoser _diagnoser{};
	rw_notification _notifications[2 * RW_EVENTS] {};
	hrt_abstime _published{0};
	hrt_abstime _fed{0}; // time of the newest sample that was fed

	DEFINE_PARAMETERS(
		(ParamBool<px4::params::ROTW_EN>) _param_rotw_en,
		(ParamInt<px4::params::ROTW_TEXT>) _param_rotw_text
	)
};
