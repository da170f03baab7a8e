/* A PX4 work item that runs an exported estimator at the rate of the gyro. MIT.
 *
 * Put this folder into src/modules/rotorwatch, `rotorwatch export-c --estimator ekf --vehicle mine.toml --variable-dt -o .`
 * beside it, and add the module to the board's configuration. Thrusts are in hover thrusts of one rotor.
 */
#pragma once

#include <px4_platform_common/px4_work_queue/ScheduledWorkItem.hpp>
#include <uORB/Publication.hpp>
#include <uORB/Subscription.hpp>
#include <uORB/SubscriptionCallback.hpp>
#include <uORB/topics/actuator_motors.h>
#include <uORB/topics/debug_array.h>
#include <uORB/topics/vehicle_acceleration.h>
#include <uORB/topics/vehicle_angular_velocity.h>

#include "ekf.h"

class RotorWatch : public px4::ScheduledWorkItem
{
public:
	RotorWatch();

	bool init();

private:
	void Run() override;

	static constexpr int ROTORS = sizeof(ekf_out{}.theta) / sizeof(rw_real);
	static constexpr float HOVER = 0.5f; // command at which one rotor carries its share

	uORB::SubscriptionCallbackWorkItem _rates{this, ORB_ID(vehicle_angular_velocity)};
	uORB::Subscription _acceleration{ORB_ID(vehicle_acceleration)};
	uORB::Subscription _motors{ORB_ID(actuator_motors)};
	uORB::Publication<debug_array_s> _losses{ORB_ID(debug_array)};

	ekf_state _state{};
	ekf_workspace _workspace{};
	ekf_out _out{};
	uint64_t _last_us{0};
};
