"""The tools: the questions of an assistant, with types and bounds of every parameter. Each is one question to the desk."""

from __future__ import annotations

import base64
import json
import os
import sys
from collections.abc import Callable
from typing import Annotated, Any, Literal, TypeVar

from mcp.server.mcpserver import MCPServer
from mcp.server.mcpserver.exceptions import ToolError
from mcp.types import CallToolResult, ImageContent, TextContent, ToolAnnotations
from pydantic import BaseModel, Field, ValidationError

from rotorwatch.assistants import models, signal_rows
from rotorwatch.assistants.desk import MOST_HEALTHY, MOST_LISTED, Desk
from rotorwatch.assistants.fleet_access import MOST
from rotorwatch.assistants.folders import LONGEST
from rotorwatch.assistants.work import Failed
from rotorwatch.base import files
from rotorwatch.errors import RotorwatchError
from rotorwatch.fleet import listing
from rotorwatch.report import still

ROWS, MOST_ROWS = 40, 400  # of a series: by default, and at most
M = TypeVar("M", bound=BaseModel)
SORT = f"{', '.join(listing.ORDERS)}; with a leading - the largest, most severe or newest first"
READS = ToolAnnotations(read_only_hint=True, destructive_hint=False, idempotent_hint=True, open_world_hint=False)
Path = Annotated[str, Field(min_length=1, max_length=LONGEST)]
Log = Annotated[Path, Field(description="path of a log in an allowed folder (FILE#2: its second flight), or the id that list_logs shows")]
Vehicle = Annotated[Path | None, Field(description="vehicle file (.toml), for logs that do not name their frame")]
Baseline = Annotated[list[Path] | None, Field(max_length=MOST_HEALTHY, description="healthy flights of the same build")]
Number = Annotated[int | None, Field(ge=0, le=10_000, description="number of the event; default: the main one")]
Words = Annotated[str, Field(max_length=200, description="words that must all match; empty: all")]
Digest = Annotated[str, Field(pattern="^[0-9a-fA-F]{6,64}$", description="hash of a flight in the store, or its first digits")]
Seconds = Annotated[float | None, Field(ge=0.0, le=1e7, allow_inf_nan=False)]
SERIES = Literal[
    "loss", "command", "residual", "evidence", "attitude", "rates",
    "moment_attitude", "moment_rates", "moment_command", "moment_speed",
]  # fmt: skip


class Server(MCPServer):
    """Reports errors of a call in one sentence, and lists its tools without redundant parts of their schemas."""

    async def list_tools(self) -> list[Any]:
        """The tools, with schemas."""
        tools = [tool.model_copy(deep=True) for tool in await super().list_tools()]
        for tool in tools:
            _without_titles(tool.input_schema)
            _without_titles(tool.output_schema)
        return tools

    async def call_tool(self, name: str, arguments: dict[str, Any], context: Any = None) -> Any:
        """Call a tool. Unknown parameters are refused."""
        known = {tool.name: list(tool.input_schema.get("properties", {})) for tool in await super().list_tools()}
        if name not in known:
            return failed(Failed("No such tool; tools/list names them."))
        if unknown := set(arguments) - set(known[name]):
            text = f"{len(unknown)} parameter(s) that `{name}` does not have; it has {', '.join(known[name])}."
            return failed(Failed(text))
        try:
            return await super().call_tool(name, arguments, context)
        except ToolError as why:
            if isinstance(why.__cause__, ValidationError):
                return failed(Failed(_wrong_parameters(name, why.__cause__)))
            return failed(Failed(_own_error(why.__cause__ or why)))


def _wrong_parameters(tool: str, why: ValidationError) -> str:
    """The error in one sentence, without the values."""
    sentences = []
    for error in why.errors(include_url=False, include_input=False, include_context=False)[:3]:
        where = next((str(part) for part in error["loc"]), "")
        sentences.append(f"{where}: {error['msg'][:1].lower()}{error['msg'][1:]}")
    return f"`{tool}` has invalid parameters ({'; '.join(sentences)})."


def _own_error(why: BaseException) -> str:
    """The error in one sentence; details go to standard error."""
    if os.environ.get("ROTORWATCH_DEBUG"):
        import traceback

        traceback.print_exception(why)
    print(f"rotorwatch: {files.printable(f'{type(why).__name__}: {why}')}", file=sys.stderr, flush=True)
    return f"Internal error of rotorwatch ({type(why).__name__}); please report it with the server's output."


def failed(why: Failed) -> CallToolResult:
    """An answer that states why there is none."""
    content = {"error": why.sentence} | ({"quoted_from_log": why.reader} if why.reader else {})
    return CallToolResult(content=[TextContent(type="text", text=_text(content))], is_error=True)


def _text(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))


def answered(model: type[M], make: Callable[[], Any]) -> CallToolResult:
    """The value of `make` as an answer of that type: structured, and the same as text; or why there is none."""
    try:
        value = make()
    except RotorwatchError as why:
        return failed(Failed(str(why)))
    except Exception as why:
        return failed(Failed(_own_error(why)))
    if isinstance(value, Failed):
        return failed(value)
    data, picture = value if isinstance(value, tuple) else (value, None)
    structured = model.model_validate(data).model_dump(mode="json", exclude_defaults=True)
    content: list[Any] = [TextContent(type="text", text=_text(structured))]
    if picture is not None:
        image = ImageContent(type="image", data=base64.b64encode(picture).decode(), mime_type="image/png")
        content.insert(0, image)
    return CallToolResult(content=content, structured_content=structured)


def register(server: MCPServer, desk: Desk) -> None:
    """Register the tools with the server."""

    def tool(title: str) -> Callable:
        return server.tool(title=title, annotations=READS)

    @tool("Which logs are there?")
    def list_logs(search: Words = "", limit: Annotated[int, Field(ge=1, le=MOST_LISTED)] = 15) -> Annotated[CallToolResult, models.Logs]:
        """List the flight logs in the allowed folders, the newest first."""
        return answered(models.Logs, lambda: desk.list_logs(search, limit))

    @tool("Which rotor lost thrust, and why did it fall?")
    def diagnose(log: Log, vehicle: Vehicle = None) -> Annotated[CallToolResult, models.Diagnosis]:
        """Assess a flight: verdict, which rotor lost effectiveness, how much, since when, how sure; why control was lost; what to do next.
        Its sentences can be passed on as they are."""
        return answered(models.Diagnosis, lambda: desk.ask("diagnose", log, vehicle=vehicle))

    @tool("Was it damaged from take-off?")
    def compare_with_healthy(
        log: Log,
        baseline: Annotated[list[Path], Field(min_length=1, max_length=MOST_HEALTHY, description="healthy flights of the same build")],
        vehicle: Vehicle = None,
    ) -> Annotated[CallToolResult, models.Compared]:
        """Assess a flight against healthy flights of the same build: finds damage that was there from take-off. In sentences healthy-1 is
        the first of `baseline`."""
        return answered(models.Compared, lambda: desk.ask("compare", log, baseline, vehicle))

    @tool("What is the evidence for an event?")
    def event(
        log: Log, number: Number = None, vehicle: Vehicle = None, baseline: Baseline = None
    ) -> Annotated[CallToolResult, models.Event]:
        """Show one event of a diagnosis with all that is known of it: evidence, causes, alternatives, and what the autopilot's own checks
        found. Give the same vehicle and baseline as to the diagnosis."""
        return answered(models.Event, lambda: desk.ask("event", log, baseline or (), vehicle, number=number))

    @tool("The numbers behind a picture")
    def get_series(
        log: Log,
        what: Annotated[SERIES, Field(description="moment_*: around a loss of control or a desync; others: the whole flight")] = "loss",
        rotor: Annotated[
            int | None, Field(ge=1, le=64, description="of loss and command: only this rotor; loss with its 95 % interval")
        ] = None,
        start_s: Seconds = None,
        end_s: Seconds = None,
        most: Annotated[int, Field(ge=2, le=MOST_ROWS, description="rows")] = ROWS,
        vehicle: Vehicle = None,
        baseline: Baseline = None,
    ) -> Annotated[CallToolResult, models.Series]:
        """Samples over time of losses, commands, residuals, evidence, attitude, rates or motor speeds, thinned so that peaks stay. 400 rows
        are up to 9,000 tokens."""
        more = {"what": what, "rotor": rotor, "start_s": start_s, "end_s": end_s, "most": most}
        return answered(models.Series, lambda: desk.ask("series", log, baseline or (), vehicle, **more))

    @tool("A picture of the flight")
    def picture(
        log: Log,
        what: Annotated[Literal["auto", "moment", "flight"], Field(description="moment: of a loss of control or desync")] = "auto",
        vehicle: Vehicle = None,
        baseline: Baseline = None,
    ) -> Annotated[CallToolResult, models.Picture]:
        """A PNG: the moment in which control was lost (attitude, commands, motor speeds), or the loss of every rotor over the flight."""
        return answered(models.Picture, lambda: desk.ask("picture", log, baseline or (), vehicle, what=what))

    @tool("What does a log hold?")
    def info(log: Log) -> Annotated[CallToolResult, models.Log]:
        """Say what a log holds: autopilot, airframe, signals and their rates, messages of the autopilot, and whether it can be assessed."""
        return answered(models.Log, lambda: desk.ask("info", log))

    @tool("What should be logged next time?")
    def what_to_log(log: Log) -> Annotated[CallToolResult, models.WhatToLog]:
        """Say what a log lacks for a diagnosis, which question has no answer without it, and which setting logs it next time."""
        return answered(models.WhatToLog, lambda: desk.ask("what_to_log", log))

    @tool("What does a vehicle survive?")
    def survive(
        vehicle: Annotated[Path, Field(description="name of an airframe, such as ardupilot-hexa-x, or a vehicle file (.toml)")],
        loss: Annotated[list[Annotated[float, Field(gt=0.0, le=1.0)]], Field(min_length=1, max_length=3)] = [1.0],  # noqa: B006
        mass_kg: Annotated[float | None, Field(gt=0.0, le=1e4, allow_inf_nan=False)] = None,
        thrust_to_weight: Annotated[float | None, Field(gt=1.0, le=50.0, allow_inf_nan=False)] = None,
        arm_m: Annotated[float | None, Field(gt=0.0, le=100.0, allow_inf_nan=False, description="centre to the outermost rotor")] = None,
    ) -> Annotated[CallToolResult, models.Survival]:
        """Say what is left of a vehicle after the loss of any rotor and of any two: full control, hover without yaw, only spinning, or no
        hover. Takes up to a minute."""
        more = {"loss": tuple(loss), "mass_kg": mass_kg, "thrust_to_weight": thrust_to_weight, "arm_m": arm_m}
        return answered(models.Survival, lambda: desk.ask("survive", vehicle=vehicle, **more))

    @tool("What is the status of the fleet?")
    def fleet(search: Words = "", limit: Annotated[int, Field(ge=1, le=MOST)] = 6) -> Annotated[CallToolResult, models.Fleet]:
        """List the aircraft of the fleet's store, those first that need attention: state, last verdict, what is new, weak rotors."""
        return answered(models.Fleet, lambda: desk.fleet.aircraft(search, limit))

    @tool("Search the flights of the fleet")
    def fleet_flights(
        search: Words = "",
        aircraft: Annotated[str | None, Field(min_length=1, max_length=200, description="only of this aircraft: its name or key")] = None,
        verdict: Annotated[str, Field(max_length=60, description="one, or several with commas between")] = "",
        since: Annotated[str, Field(max_length=40, description="UTC, such as 2026-05-01 or 2026-05-01T14:30")] = "",
        until: Annotated[str, Field(max_length=40, description="that day or minute included")] = "",
        min_loss: Annotated[float, Field(ge=0.0, le=1.0, description="of the worst loss")] = 0.0,
        min_duration: Annotated[float, Field(ge=0.0, le=1e9, description="s")] = 0.0,
        sort: Annotated[str, Field(max_length=20, description=SORT)] = listing.NEWEST,
        limit: Annotated[int, Field(ge=1, le=MOST)] = 8,
        offset: Annotated[int, Field(ge=0, le=10**9)] = 0,
    ) -> Annotated[CallToolResult, models.Flights]:
        """List flights of the fleet's store; search in names, verdicts, headlines, frames and aircraft."""
        wanted = {"search": search, "verdict": verdict, "since": since, "until": until}
        wanted |= {"min_loss": min_loss, "min_duration": min_duration}
        return answered(models.Flights, lambda: desk.fleet.flights(sort, aircraft, limit, offset, **wanted))

    @tool("A stored diagnosis")
    def fleet_flight(flight: Digest) -> Annotated[CallToolResult, models.Diagnosis]:
        """Show the diagnosis that the fleet's store holds of a flight; its log is not read."""
        return answered(models.Diagnosis, lambda: desk.stored(flight))

    @tool("An event of a stored diagnosis")
    def fleet_event(flight: Digest, number: Number = None) -> Annotated[CallToolResult, models.Event]:
        """Show one event, with its evidence, of a diagnosis that the fleet's store holds."""
        return answered(models.Event, lambda: desk.stored_event(flight, number))


def _without_titles(schema: Any) -> None:
    """Remove the titles that Pydantic derives from the names of fields and types: a third of the schemas."""
    if isinstance(schema, dict):
        if isinstance(schema.get("title"), str):
            del schema["title"]
        for part in schema.values():
            _without_titles(part)
    elif isinstance(schema, list):
        for part in schema:
            _without_titles(part)


assert set(SERIES.__args__) == {*signal_rows.WHOLE, *signal_rows.MOMENT} and still.KINDS == ("auto", "moment", "flight")
