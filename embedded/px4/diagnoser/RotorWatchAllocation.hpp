/* What PX4's control allocator does with the effectiveness that is left (docs/px4.md). MIT. */
#pragma once

#include <uORB/topics/rotorwatch_verdict.h>

/* Scales the columns of the motors in an effectiveness matrix of six axes (roll, pitch, yaw, x, y, z), as
   `ActuatorEffectiveness::Configuration::effectiveness_matrices` has it, motors first. Without yaw where it has to be given up: the allocator
   drops an axis that no actuator moves. */
template <typename Matrix>
void rotorwatch_rely(const rotorwatch_verdict_s &verdict, Matrix &effectiveness, int motors)
{
	constexpr int axes = 6;
	constexpr int yaw = 2;

	if (verdict.control == rotorwatch_verdict_s::CONTROL_UNABLE) {
		return;
	}

	for (int motor = 0; motor < motors && motor < 12; motor++) {
		for (int axis = 0; axis < axes; axis++) {
			effectiveness(axis, motor) *= verdict.effectiveness[motor];
		}

		if (verdict.control == rotorwatch_verdict_s::CONTROL_LEVEL) {
			effectiveness(yaw, motor) = 0.f;
		}
	}
}
