"""Write the table of docs/methods/index.md from the discovered methods: run it after adding one."""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path

from rotorwatch import airframes
from rotorwatch.base import discovery
from rotorwatch.errors import ConfigError

PAGE = Path(__file__).parent / "methods" / "index.md"
START, END = "<!-- table made by docs/make_methods.py -->\n", "<!-- end of the table -->\n"


def plants() -> dict:
    """One example of each plant, by name."""
    from rotorwatch_lab.systems import helicopter, linear_hover, port_hamiltonian_attitude, rate_dynamics, rigid_body

    return {
        "rate_dynamics": rate_dynamics.RateDynamics.of(airframes.paper("niermeyer-hexa")),
        "rigid_body": rigid_body.RigidBody.of(airframes.paper("uaf-02e")),
        "port_hamiltonian_attitude": port_hamiltonian_attitude.PortHamiltonianAttitude.of(airframes.paper("rot-hexa")),
        "linear_hover": linear_hover.LinearHover.of(airframes.paper("f450")),
        "helicopter": helicopter.Helicopter(airframes.paper("ruav-40kg")),
    }


def defined_for(kind: type, examples: dict) -> list[str]:
    """Names of the plants that the method takes."""
    found = []
    for name, plant in examples.items():
        try:
            kind(plant, 0.01)
        except ConfigError:
            continue
        found.append(name)
    return found


def table() -> str:
    """A row for each method, name and long name (its docstring up to a colon); below, the methods that do not take every plant."""
    examples = plants()
    lines = ["| name | method |", "|---|---|"]
    limited: dict[str, list[str]] = {}
    for name, kind in discovery.estimators().items():
        module = sys.modules[kind.__module__].__doc__ or ""
        about = " ".join(module.split("\n\n")[0].split()).partition(":")[0].rstrip(".")
        takes = ["wrench_balance"] if name == "default" else defined_for(kind, examples)
        if len(takes) < len(examples):
            limited.setdefault(", ".join(f"`{plant}`" for plant in takes), []).append(f"`{name}`")
        page = PAGE.parent / f"{name}.md"
        link = f"[`{name}`]({name}.md)" if page.exists() else f"`{name}`"
        lines.append(f"| {link} | {about} |")
    but = "; ".join(f"{', '.join(names)}: {found}" for found, names in limited.items())
    return "\n".join(lines) + "\n\n" + textwrap.fill(f"All take every plant, except {but}." if but else "All take every plant.", 140) + "\n"


def filled(page: str) -> str:
    """The page with the table as it is now."""
    return page[: page.index(START) + len(START)] + table() + page[page.index(END) :]


if __name__ == "__main__":
    PAGE.write_text(filled(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
