/* See RotorWatch.hpp. Everything is a member of the object: nothing is allocated while flying. MIT. */
#include "RotorWatch.hpp"

RotorWatch::RotorWatch() : px4::ScheduledWorkItem("rotorwatch", px4::wq_configurations::nav_and_controllers)
{
	ekf_init(&_state, &_workspace);
}

bool RotorWatch::init()
{
	return _rates.registerCallback();
}

void RotorWatch::Run()
{
	vehicle_angular_velocity_s rates{};

	if (!_rates.update(&rates)) {
		return;
	}

	vehicle_acceleration_s acceleration{};
	const bool accelerated = _acceleration.update(&acceleration);
	actuator_motors_s motors{};
	_motors.copy(&motors);

	rw_real u[ROTORS];

	for (int i = 0; i < ROTORS; i++) {
		const float command = motors.control[i] > 0.f ? motors.control[i] : 0.f; // NaN: not armed
		u[i] = (command / HOVER) * (command / HOVER); // thrust grows with the square of the speed
	}

	const rw_real y[4] = {rates.xyz[0], rates.xyz[1], rates.xyz[2], accelerated ? acceleration.xyz[2] : 0.f};
	const bool valid[4] = {true, true, true, accelerated};
	const rw_real dt = _last_us == 0 ? rw_real(0.004) : rw_real(rates.timestamp_sample - _last_us) * rw_real(1e-6);
	_last_us = rates.timestamp_sample;

	ekf_step(&_state, u, y, valid, dt, &_out, &_workspace);

	debug_array_s losses{};
	losses.timestamp = rates.timestamp;

	for (int i = 0; i < ROTORS; i++) {
		losses.data[i] = float(_out.theta[i]);
	}

	_losses.publish(losses);
}
