"""The default estimator as a C99 project: header, source, example and CMakeLists, from its definition (engine/estimator/).

Its input is a tick, its output a `Result`; `export_diagnoser` adds ticks from samples and events from results.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rotorwatch import __version__, airframes
from rotorwatch.base.compiling import structs
from rotorwatch.base.compiling.translate import Translation
from rotorwatch.engine.definition import ESTIMATOR
from rotorwatch.engine.estimator import batch, estimator_sizes
from rotorwatch.engine.estimator.estimator import Estimator
from rotorwatch.engine.motion.tick_table import ASSESS
from rotorwatch.errors import ConfigError
from rotorwatch.export.export_diagnoser import plant_table, settings, text_of
from rotorwatch.export.projects import Exported, saved
from rotorwatch.flight.vehicle import Vehicle

BYTES = {"real": 8, "time": 8, "each": 8, "int": 4, "flag": 1, "mask": 2, "small": 2, "letter": 1, "byte": 1}


LOG_DT, FRAME = 0.05, "ardupilot-quad-x"  # s of a tick, airframe: where none is given


class Project(NamedTuple):
    """texts: file name -> text; state_bytes: in double precision; digest: of the definition and the vehicle."""

    texts: dict[str, str]
    state_bytes: int
    digest: str


def export_default(
    out: str | Path, *, vehicle: Vehicle | str | None = None, dt: float | None = None, variable_dt: bool = False, name: str = "default"
) -> Exported:
    """Write a C99 project of the default estimator into a folder, for ticks of dt seconds. Arguments as of `rotorwatch.export_c`. Raises
    ConfigError for a step of variable length, a paper's airframe and ticks that the estimator is not made for."""
    if variable_dt:
        raise ConfigError("The default estimator's ticks have one length, which --dt says: leave --variable-dt out.")
    if isinstance(vehicle, str) and vehicle in airframes.papers():
        raise ConfigError(f"default runs in hover thrusts of an autopilot's airframe; {vehicle} is a paper's.")
    craft = airframes.named(vehicle or FRAME) if not isinstance(vehicle, Vehicle) else vehicle
    made = compose_project(name, craft, dt or LOG_DT)
    return Exported(name, Path(out), saved(Path(out), name, made.texts), made.state_bytes, 0, made.digest)


def compose_project(name: str, vehicle: Vehicle, dt: float) -> Project:
    """The header and source NAME.h, NAME.c and an example, for a vehicle and ticks of dt seconds. Raises ConfigError for other ticks."""
    B = vehicle.effectiveness()
    translation = Translation((*ESTIMATOR, batch), estimator_sizes)
    values = settings(B, dt)
    plant = text_of(plant_table(vehicle, dt), "rw_plant", "rw_plant_default")
    text = translation.header("", name="estimator"), translation.source(f"{name}.h")
    config = "".join(f"#define RW_{size} {values[size]}\n" for size in translation.sizes)
    digest = hashlib.sha256("\0".join((*text, config, plant)).encode()).hexdigest()[:16]
    about = f"The default estimator: ticks of {dt:g} s of {B.shape[1]} rotors in, losses out."
    about += f" rotorwatch {__version__}, definition {digest}."
    header = text[0].replace("/*  */", f"/* {about} */").replace('#include "rw_config.h"\n', config)
    header = header.replace("#ifdef __cplusplus\n}", _DECLARED.format(NAME=name, inputs=_inputs(B.shape[1])) + "#ifdef __cplusplus\n}")
    source = text[1] + "\n" + plant.replace("const rw_plant", "static const rw_plant") + _DEFINED.format(NAME=name)
    texts = {f"{name}.h": header, f"{name}.c": source, "example.c": _example(name, B)}
    return Project({file: _prefixed(text, name) for file, text in texts.items()}, _bytes(Estimator, values), digest)


_DECLARED = """
/* {inputs} */
typedef rw_estimator {NAME}_state;
typedef rw_result {NAME}_out;

/* The state before the first tick. */
void {NAME}_init({NAME}_state *state);

/* One tick. y: commanded wrench of roll, pitch, yaw, thrust [hover thrusts]; valid: which of it can be believed; the others may hold
   anything. */
void {NAME}_step({NAME}_state *state, const rw_real *u, const rw_real *y, const bool *valid, {NAME}_out *out);

/* A tick for each row. */
void {NAME}_run(int32_t rows, {NAME}_state *state, const rw_real *u, const rw_real *y, const bool *valid, {NAME}_out *out);

"""
_DEFINED = """
void {NAME}_init({NAME}_state *state)
{{
    rw_estimator_init(state);
    rw_estimator_begin(state, &rw_plant_default);
}}

void {NAME}_step({NAME}_state *state, const rw_real *u, const rw_real *y, const bool *valid, {NAME}_out *out)
{{
    rw_batch_run(&rw_plant_default, state, 1, u, y, valid, out);
}}

void {NAME}_run(int32_t rows, {NAME}_state *state, const rw_real *u, const rw_real *y, const bool *valid, {NAME}_out *out)
{{
    rw_batch_run(&rw_plant_default, state, rows, u, y, valid, out);
}}
"""


def _inputs(n: int) -> str:
    return f"""u: thrust_1 to thrust_{n} [hover thrust], p_dot, q_dot, r_dot [rad/s^2], {n} x load factor, p, q, r [rad/s],
   side force forward, right [m/s^2], full thrust of a rotor [hover thrust], expo of the thrust curve, its standard deviation,
   speed along the thrust axis [m/s; NaN where it is not known], mode (0 on the ground, 1 learn, 2 assess), restart (1 at the first tick
   of a flight, 2 at a contact)"""


def _prefixed(text: str, name: str) -> str:
    """The text with prefixed names, so that several of these, and a diagnoser, can be in one firmware."""
    text = re.sub(r"\brw_(?!real\b|time\b)", f"{name}_", text)
    return re.sub(r"\bRW_(?!LASTS\b)", f"{name.upper()}_", text)


def _example(name: str, B: np.ndarray) -> str:
    """A main that hovers for a thousand ticks, and prints the losses."""
    n = B.shape[1]
    thrust, zeros = np.ones(n), [0.0] * 3
    u = [*thrust, *zeros, n, *zeros, 0.0, 0.0, 2.5, 0.65, 0.0, 0.0, ASSESS, 0.0]

    def numbers(values: Any) -> str:
        return ", ".join(f"(rw_real){float(v)!r}" for v in values)

    return f"""/* A thousand ticks of {name} in hover. */
#include "{name}.h"

#include <stdio.h>

int main(void)
{{
    static const rw_real u[{n + 15}] = {{{numbers(u)}}};
    static const rw_real y[4] = {{{numbers(B @ thrust)}}};
    static const bool valid[4] = {{true, true, true, true}};
    static {name}_state state;
    static {name}_out out;

    {name}_init(&state);
    for (int k = 0; k < 1000; ++k)
        {name}_step(&state, u, y, valid, &out);
    printf("announced %d, losses", (int)out.announced);
    for (int k = 0; k < {n}; ++k)
        printf(" %.6f", (double)out.theta[k]);
    printf("\\n");
    return 0;
}}
"""


def _bytes(kind: type[structs.Struct], values: dict[str, Any]) -> int:
    """Size of a struct with these values of the sizes, without gaps."""
    usual = {size: values[name] for name, size in vars(estimator_sizes).items() if name.isupper() and name in values}
    total = 0
    for name, field in kind.declared():
        inner, shape = (field.kind, field.shape) if isinstance(field, structs.Array) else (field, ())
        if not isinstance(inner, str) and not (isinstance(inner, type) and issubclass(inner, structs.Struct)):
            inner = structs.SCALARS[kind.__annotations__[name]]
        one = BYTES[inner] if isinstance(inner, str) else _bytes(inner, values)
        total += one * int(np.prod([usual.get(size, size) for size in shape]))
    return total
