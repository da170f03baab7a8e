"""Evidence beside the estimator: each module examines one source and registers itself; answer/ledger.py merges their claims.

witness.py               the interface of a witness, and all that are registered
hindsight.py             losses in the blind time, once the flight's gains and noise are known
excitation_response.py   the response to an excitation of the commands
attainable.py            every thrust and moment that a vehicle can still give, and its margins in hover
null_space.py            commands that move nothing, and the noise that their effect is seen in
near_ground.py           losses that the ground explains as well
rivals.py                what becomes of losses beside what else explains the motion
comparing.py             a loss compared with what else explains the motion that followed
odds.py                  weights and probabilities of these explanations
ends.py                  whether a loss was over, by the motion after it
pushes.py                what the side force says of a push
remainder.py             losses in the motion that known losses leave
leaning.py               a lasting lateral force at rest: contact, however slowly it began
stepped.py               losses that grew in a step
oscillation.py           outputs that oscillate: frequency, axis, gain
reports.py               the autopilot's own reports, and quantities beyond five of its limits
battery.py               whether the battery's voltage fell by more than its current explains
upset/                   vehicles that departed controlled flight, and why
esc/                     ESC telemetry: the cause of a loss, stopped rotors, slow motors
aerobatic/               vehicles that never hover
balance/                 rotors out of balance, by their vibration once per turn
healthy/                 comparison with healthy flights, of the vehicle or of any build, for damage from take-off
"""
