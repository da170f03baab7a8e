"""A ground station of MAVSDK, in a process of its own: `python mavsdk_station.py PORT`. Prints what it receives as JSON lines, until it is
ended."""

import json
import sys
import time

from mavsdk import ComponentType, Configuration, Mavsdk, log_subscribe
from mavsdk.plugins.component_metadata.component_metadata import ComponentMetadata
from mavsdk.plugins.events.events import Events
from mavsdk.plugins.mavlink_direct.mavlink_direct import MavlinkDirect
from mavsdk.plugins.telemetry.telemetry import Telemetry


def say(**reported):
    print(json.dumps(reported), flush=True)


def main(port):
    log_subscribe(lambda *_: True)  # its own lines do not belong among ours
    station = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    station.add_any_connection(f"udpout://127.0.0.1:{port}")
    system = station.first_autopilot(20.0)
    direct, events, metadata, telemetry = MavlinkDirect(system), Events(system), ComponentMetadata(system), Telemetry(system)
    events.subscribe_events(
        lambda e, _: say(event=e.event_name, namespace=e.event_namespace, message=e.message, level=int(e.log_level), compid=e.compid)
    )
    metadata.subscribe_metadata_available(lambda m, _: say(metadata=m.json_metadata, type=int(m.type), compid=m.compid))
    for name in ("HEARTBEAT", "SYS_STATUS", "STATUSTEXT"):
        direct.subscribe_message(name, lambda m, _: say(name=m.message_name, compid=m.component_id, **json.loads(m.fields_json)))
    telemetry.subscribe_battery(lambda battery, _: say(volts=battery.voltage_v))
    metadata.request_component(191)
    time.sleep(60.0)


if __name__ == "__main__":
    main(int(sys.argv[1]))
