"""The build of the package: machine code of the default method goes into the wheel, so that no compiler is needed to run it.

`pip install .` and `pip install -e .` build for this computer, which takes some seconds; without a C compiler the package comes without
machine code, and Python runs the same lines, slowly. Environment: ROTORWATCH_SHIP=portable builds for every processor of this kind (wheels
that are given away); ROTORWATCH_SHIP=none builds nothing. CC: the compiler; a cross compiler makes a wheel for its kind of processor.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

BUILDING = ["numpy>=1.26"]
HERE = Path("rotorwatch") / "base" / "compiling" / "built"
DOCUMENTS = "glossary", "limits"  # what `rotorwatch mcp` gives as resources


def _paths() -> list[str]:
    """Where this build finds modules, without what changes that as Python starts: pip's own would take the sources out where they are
    installed in place already."""
    return [path for path in sys.path if not (Path(path) / "sitecustomize.py").exists()]


class ShippedCode(BuildHookInterface):
    """Hatchling's hook; see the file."""

    PLUGIN_NAME = "custom"

    @property
    def portable(self) -> bool:
        return os.environ.get("ROTORWATCH_SHIP") == "portable"

    def dependencies(self) -> list[str]:
        """What the translation of the definitions needs."""
        return [] if os.environ.get("ROTORWATCH_SHIP") == "none" else BUILDING

    def initialize(self, version: str, build_data: dict) -> None:
        """Build, and add the result to the wheel; of an editable installation put it beside the sources."""
        if self.target_name != "wheel":
            return
        if version != "editable":  # which reads them where they lie
            for path in (Path(self.root) / "docs" / f"{name}.md" for name in DOCUMENTS):
                if path.exists():
                    build_data["force_include"][str(path)] = f"rotorwatch/assistants/documents/{path.name}"
        if os.environ.get("ROTORWATCH_SHIP") == "none":
            return
        self._folder = Path(tempfile.mkdtemp(prefix="rotorwatch-ship-"))
        options = ["--portable"] if self.portable else []
        done = subprocess.run(
            [sys.executable, "-m", "rotorwatch.engine.bindings.shipping", str(self._folder / "built"), *options],
            env={**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(self.root) / "src"), *_paths()])},
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        if done.returncode:
            said = (done.stdout.strip() or done.stderr.strip() or "nothing said").splitlines()[-1]
            self.app.display_warning(f"No machine code in this package ({said}) Python runs instead, slowly.")
            return
        if version == "editable":
            beside = Path(self.root) / "src" / HERE
            shutil.rmtree(beside, ignore_errors=True)
            shutil.copytree(self._folder / "built", beside)
            return
        for path in sorted((self._folder / "built").iterdir()):
            build_data["force_include"][str(path)] = str(HERE / path.name)
        build_data["pure_python"] = False
        # Nothing in it depends on the version of Python.
        index = json.loads((self._folder / "built" / "definitions.json").read_text(encoding="utf-8"))
        kind = sysconfig.get_platform()
        if (built_for := index["engine"]["target"].split()[1]) != platform.machine().lower():  # by a cross compiler
            kind = kind.replace(platform.machine(), built_for)
        libraries = [path.read_bytes() for path in (self._folder / "built").glob("*.so")]
        if kind.startswith("linux") and not any(b"GLIBC_" in library for library in libraries):
            kind = kind.replace("linux", "musllinux_1_2")  # by CC=musl-gcc, for Alpine
        build_data["tag"] = f"py3-none-{kind.replace('-', '_').replace('.', '_')}"

    def finalize(self, version: str, build_data: dict, artifact_path: str) -> None:
        """What was built has been copied."""
        folder = getattr(self, "_folder", None)
        if folder:
            shutil.rmtree(folder, ignore_errors=True)
