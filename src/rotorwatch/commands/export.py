"""The command that exports an estimator or the control allocation as C."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from rotorwatch.commands.tools import OUT, common, flag, option, say
from rotorwatch.errors import ConfigError


@click.command("export-c", short_help="Write an estimator or the control allocation as C99.")
@option("--estimator", "Estimator to export.", metavar="NAME")
@option("--allocator", "Export the control allocation: estimate, bounds, posterior or pseudo-inverse.", metavar="WAY")
@flag("--diagnoser", "Export the whole default diagnosis: samples in, events out.")
@flag("--log-reader", "Export the diagnosis with readers of ULog and DataFlash: a log in, JSON out.")
@flag("--page", "Log reader: compile it to WebAssembly as well, with a page that assesses logs in a browser.")
@option("--vehicle", "Vehicle file (TOML) or an airframe's name; default: the method's paper's.", metavar="FILE|NAME")
@option("-o --out", "Folder to write into.", required=True, type=OUT, metavar="DIR")
@option("--dt", "Length of a step.", type=click.FloatRange(0, min_open=True), metavar="S")
@flag("--variable-dt", "Pass the step length as an argument.")
@option("--rate-hz", "Diagnoser: rate of the motor outputs [50].", type=click.FloatRange(0, min_open=True), metavar="HZ")
@option("--control-hz", "Diagnoser: rate of the rate controller's output, if fed.", type=click.FloatRange(0), metavar="HZ")
@option("--sensor-hz", "Diagnoser: rate of gyro and accelerometer [100].", type=click.FloatRange(0, min_open=True), metavar="HZ")
@option("--prefix", "Diagnoser: prefix of its names [rw].", metavar="NAME")
@common
def export_c(
    estimator, allocator, diagnoser, log_reader, page, vehicle, out, dt, variable_dt, rate_hz, control_hz, sensor_hz, prefix, quiet
) -> None:
    """Write an estimator, the control allocation (docs/control.md), or the whole diagnosis, for a flight controller or for logs, as C99
    that needs nothing but libm (docs/export.md)."""
    from rotorwatch.base import discovery, files
    from rotorwatch.export.export_default import FRAME, export_default
    from rotorwatch.flight import vehicle_file

    if (estimator is not None) + (allocator is not None) + diagnoser + log_reader != 1:
        raise ConfigError("Give one of --estimator NAME, --allocator WAY, --diagnoser and --log-reader.")
    given: dict[str, Any] = {"rate_hz": rate_hz, "control_hz": control_hz, "gyro_hz": sensor_hz, "accel_hz": sensor_hz}
    given = {key: value for key, value in (given | {"prefix": prefix}).items() if value is not None}
    if given and not diagnoser:
        raise ConfigError("--rate-hz, --control-hz, --sensor-hz and --prefix belong to --diagnoser.")
    if page and not log_reader:
        raise ConfigError("--page belongs to --log-reader.")
    if log_reader and (vehicle is not None or dt is not None or variable_dt):
        raise ConfigError("A log names its vehicle and rates: leave --vehicle, --dt and --variable-dt out.")
    if diagnoser and (dt is not None or variable_dt):
        raise ConfigError("The diagnoser's ticks follow from --rate-hz: leave --dt and --variable-dt out.")
    if allocator is not None and (dt is not None or variable_dt):
        raise ConfigError("The control allocation has no length of a step: leave --dt and --variable-dt out.")
    if allocator not in (None, "estimate", "bounds", "posterior", "pseudo-inverse"):
        raise ConfigError(f"--allocator {allocator}: give estimate, bounds, posterior or pseudo-inverse.")
    files.folder(out, "--out")
    if log_reader:
        from rotorwatch.export.export_log_reader import export_log_reader

        click.echo("\n".join(map(str, export_log_reader(out, page=page))))
        return
    craft = vehicle
    if vehicle is not None and (Path(vehicle).suffix == ".toml" or Path(vehicle).exists()):
        craft = vehicle_file.read(vehicle)
    if diagnoser:
        from rotorwatch.export.export_diagnoser import export_diagnoser

        click.echo("\n".join(map(str, export_diagnoser(out, vehicle=craft or FRAME, **given))))
        return
    if estimator == "default":
        written = export_default(out, vehicle=craft, dt=dt, variable_dt=variable_dt)
    elif allocator is None:
        published = discovery.first("rotorwatch.api", "The export of a published method", "export_c")
        written = published.export_c(estimator, out, vehicle=craft, dt=dt, variable_dt=variable_dt)
    else:
        control = discovery.first("rotorwatch.api", "The export of the control allocation", "export_c")
        plain = allocator == "pseudo-inverse"
        by, method = ("estimate", allocator) if plain else (allocator, "bounded")
        written = control.export_allocator(out, vehicle=craft or FRAME, by=by, method=method)
    click.echo("\n".join(str(path) for path in written.files))
    if not quiet:
        say(f"{written.name}: {written.state_bytes} bytes of state, {written.workspace_bytes} of workspace, definition {written.digest}")
