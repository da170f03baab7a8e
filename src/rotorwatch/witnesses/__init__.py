"""What else testifies of a flight, beside the estimator. Each looks at what only it can see; the answer's ledger merges what all of them
say.

hindsight.py             losses in the blind time, once the flight's gains and noise are known
excitation_response.py   what the response to an excitation of the commands says
attainable.py            every thrust and moment that a vehicle can still give, and its margins in hover
null_space.py            commands that move nothing, and the noise that their effect is seen in
near_ground.py           losses that the ground explains as well
leaning.py               a lasting push from the side at rest: contact, however slowly it began
reports.py               what the autopilot itself reported, and five limits that are its own
battery.py               whether the battery's voltage fell by more than its current explains
upset/                   vehicles that left control, and why
esc/                     ESC telemetry: the cause of a loss, stopped rotors, slow motors
aerobatic/               vehicles that never hover
healthy/                 healthy flights of the vehicle, or any healthy vehicle, for damage from take-off
"""
